"""Readers and writers of shared memory that come, die and meet."""

import re
import signal
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from itertools import count
from pathlib import Path
from struct import unpack_from

import numpy as np
import pytest
import shm_samples
from edge_samples import ROOT, ended
from shm_samples import CONTRACT, fields, heartbeat_ns, latest, make_result, name, sink, start_writer, writing

from edge.api import Event, SinkError
from edge.sinks.shm import Layout, SharedMemorySink

sys.path.append(str(ROOT / "examples"))
import shm_read
from shm_read import attach

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="shared memory is a folder on Linux alone")

__all__ = ["name", "sink", "start_writer"]
READS = 5_000
PATIENCE_S = 30


class TestReading:
    def test_no_read_is_torn_and_none_goes_back(self, name, start_writer):
        """Reads go on beyond their number until the writer wrote much, however little processor time it gets."""
        start_writer()
        memory, newest, torn, backwards = attach(name), {"left/4": -1, "right/4": -1}, 0, 0
        kinds = [(kind, shape, at) for kind, shape, at in Layout(4, 4, 40, 40).maps.values()][1:]
        reads, end_s = count(), time.monotonic() + PATIENCE_S
        while (read := next(reads)) < READS or min(newest.values()) <= 1000:
            assert time.monotonic() < end_s, f"the writer wrote {newest} meanwhile"
            sensor = ("left/4", "right/4")[read % 2]
            half = latest(memory, sensor)
            (number,) = unpack_from("<q", half, 24)
            wanted = [np.array(number % 60_000, kind).tobytes() for kind, _, _ in kinds]
            if any(
                half[at : at + 4 * int(np.prod(shape))] != want * int(np.prod(shape))
                for want, (_, shape, at) in zip(wanted, kinds, strict=True)
            ):
                torn += 1
            backwards += number < newest[sensor]
            newest[sensor] = number
        assert (torn, backwards) == (0, 0)

    def test_what_was_overwritten_while_it_was_copied_is_read_again(self, sink, name, monkeypatch):
        """A processor without ordering may show the newest sequence with values from before."""
        for number in range(3):
            sink.write(make_result(number, press_counts=3000 + 100 * number), {})
        memory, copies = attach(name), []
        checks = zlib.crc32

        def check(content):
            copies.append(checks(content))
            return copies[-1] ^ (len(copies) < 3)

        monkeypatch.setattr("shm_read.zlib.crc32", check)
        half = latest(memory, "4")
        assert half is not None and fields(half)["scan"] == 2 and len(copies) == 3

    @pytest.mark.parametrize(
        ("at", "broken", "scan"),
        [
            (192 + 64 + 13696 + 500, 1, None),  # in the newest half
            (192 + 64, 5000, 5),  # of a writer that was killed half-way in the other: the newest whole value stays
        ],
    )
    def test_broken_memory_is_given_up_and_hides_nothing_that_is_whole(self, sink, name, at, broken, scan):
        sink.write(make_result(5), {})
        with Path("/dev/shm", name).open("r+b") as file:
            file.seek(at)
            file.write(b"\xff" * broken)
        half = latest(attach(name), "4")
        assert (half and fields(half)["scan"]) == scan

    def test_only_what_is_young_and_of_a_device_is_acted_on(self, sink, name):
        memory, now_ns = attach(name), time.monotonic_ns()
        result = replace(make_result(7, press_counts=3000, time_ns=now_ns), source="device")
        young = {"oldest_s": 60.0}
        sink.write(result, {})
        half = shm_read.latest(memory, "4", **young)
        assert half is not None and fields(half)["scan"] == 7
        assert shm_read.latest(memory, "4", oldest_s=0.0) is None
        for time_ns in (now_ns - 60_000_000_000, now_ns + 60_000_000_000):  # the latter is of another machine
            sink.write(replace(result, scan=replace(result.scan, time_ns=time_ns)), {})
            assert shm_read.latest(memory, "4", **young) is None
            refused = shm_read.refusal(shm_read.newest(memory)["4"], **young)
            assert re.fullmatch(r"the newest reading is -?(60|59)\.\d\d s old, expected under 60", refused)
        for source in ("emulated", "replay"):
            sink.write(replace(result, source=source), {})
            assert shm_read.latest(memory, "4", **young) is None
            refused = shm_read.refusal(shm_read.newest(memory)["4"], **young)
            assert refused.startswith(f"its source is {source}, not a device: --pretend")
            assert shm_read.latest(memory, "4", **young, pretend=True) is not None

    def test_a_baseline_in_doubt_is_nothing_to_act_on(self, sink, name):
        memory, result = attach(name), make_result(7, press_counts=3000)
        scan = replace(result.scan, time_ns=time.monotonic_ns())
        sink.write(replace(result, scan=scan, source="device", state="baseline_in_doubt", trusted=False), {})
        assert "baseline is in doubt" in str(shm_read.refusal(shm_read.newest(memory)["4"], oldest_s=60))

    def test_a_depth_that_is_not_to_be_believed_is_not_shown(self, sink, name):
        memory, result = attach(name), make_result(7, press_counts=3000)
        untrusted = replace(result, trusted=False, untrusted_reason="unfamiliar")
        for shown, line in (
            (replace(result, trusted=True), r"\d+ counts, [\d.]+ mm at most"),
            (result, r"\d+ counts, pattern not checked"),
            (untrusted, r"\d+ counts, pattern not to be .*"),
        ):
            sink.write(shown, {})
            assert re.fullmatch(line, shm_read.described(memory, latest(memory, "4")))

    @pytest.mark.parametrize(
        ("words", "line"),
        [
            (["left/4", "--pretend"], r"\d+ counts, pattern not checked"),
            (["5"], "nothing to act on: no sensor 5, but left/4.*"),
        ],
    )
    def test_the_example_prints_what_it_acts_on_until_the_memory_is_gone(self, name, start_writer, words, line):
        start_writer()
        command = [sys.executable, str(ROOT / "examples" / "shm_read.py"), name, *words]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with ended(subprocess.Popen(command, env=shm_samples.ENVIRONMENT, text=True, **pipes)) as reader:
            while not re.fullmatch(line, told := reader.stdout.readline().rstrip()):
                assert told.startswith("nothing to act on: the newest reading is")  # its writer had no turn for 50 ms
            Path("/dev/shm", name).unlink()
            _, errors = reader.communicate()
        assert reader.returncode == 1
        assert re.fullmatch(rf".*No such file .*: expected what edge-sr --sink shm:{name} writes\n", errors)


class TestWriters:
    def test_the_end_is_seen_and_the_name_is_free(self, name):
        sink = SharedMemorySink(name, CONTRACT)
        memory = attach(name)
        assert writing(memory)
        sink.close()
        assert not writing(memory)
        with pytest.raises(FileNotFoundError):
            attach(name)
        sink.close()

    def test_a_name_that_another_took_meanwhile_stays(self, name):
        sink = SharedMemorySink(name, CONTRACT)
        Path("/dev/shm", name).unlink()
        other = SharedMemorySink(name, CONTRACT)
        sink.close()
        assert writing(attach(name), within_s=60)
        other.close()
        with pytest.raises(FileNotFoundError):
            attach(name)

    def test_a_writer_that_waits_gives_signs_of_life(self, name):
        now_ns = time.monotonic_ns()
        sink = SharedMemorySink(name, CONTRACT, clock_ns=lambda: now_ns)
        memory = attach(name)
        gone = Event(0, "lost", None, "gone")
        for act in (sink.wait, lambda: sink.tell(gone, {}), lambda: sink.write(make_result(), {})):
            now_ns -= 1_000_000
            act()
            assert heartbeat_ns(memory) == now_ns
        assert writing(memory, within_s=60)
        now_ns -= 60_000_000_000
        sink.wait()
        assert not writing(memory, within_s=60)
        sink.close()

    def test_one_that_was_killed_is_seen_and_its_place_taken(self, name, start_writer):
        writer = start_writer()
        memory = attach(name)
        assert writing(memory, within_s=5)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        (last,) = unpack_from("<q", latest(memory, "left/4") or b"", 24)
        stopped = heartbeat_ns(memory)
        time.sleep(0.05)
        assert heartbeat_ns(memory) == stopped and not writing(memory, within_s=0.05)
        sink = SharedMemorySink(name, CONTRACT)
        assert heartbeat_ns(memory) == 0, "who still looks at the old memory must see that it ended"
        assert unpack_from("<q", latest(memory, "left/4") or b"", 24) == (last,)
        assert latest(attach(name), "left/4") is None
        sink.close()

    def test_two_cannot_write_one(self, name, start_writer):
        writer = start_writer()
        with pytest.raises(SinkError, match=rf"{name} is written by process {writer.pid}: end it"):
            SharedMemorySink(name, CONTRACT)
        assert writing(attach(name), within_s=5)
        assert not list(Path("/dev/shm").glob(f".{name}*"))

    def test_what_another_program_left_there_stays(self, name):
        path = Path("/dev/shm", name)
        path.write_bytes(b"mine" * 100)
        with pytest.raises(SinkError, match=r"another program's shared memory"):
            SharedMemorySink(name, CONTRACT)
        assert path.read_bytes() == b"mine" * 100

    def test_nobody_else_may_read_it(self, sink, name):
        assert Path("/dev/shm", name).stat().st_mode & 0o777 == 0o600

    def test_without_shared_memory_it_says_so(self, tmp_path):
        with pytest.raises(SinkError, match=r"needs Linux"):
            SharedMemorySink("x", CONTRACT, folder=tmp_path / "none")
