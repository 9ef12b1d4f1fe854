"""Latest values in shared memory: their layout, readers and writers that come, die and meet."""

import math
import os
import re
import shutil
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
from edge_samples import ROOT, ended, make_pad_contract, make_wrench_result
from shm_samples import CONTRACT, fields, heartbeat_ns, latest, make_result, name, sink, values, writer, writing
from sink_samples import every_kind

from edge.api import Event, SinkError
from edge.sinks import shm
from edge.sinks.shm import HEADER, IN_MEMORY, MEMBERS, SLOTS, Layout, SharedMemorySink, offsets_of

sys.path.append(str(ROOT / "examples"))
import shm_read
from shm_read import attach

__all__ = ["name", "sink", "writer"]
VERSION_1 = (
    "checksum:I reserved:I sequence:Q time_ns:q scan:q device_time_ns:q reused_from:q source:i state:i contact:i "
    "taps_used:i has_pattern:i has_deviation:i another_tap:i filled:i dead:Q fresh:Q renewed:Q force_counts:d "
    "force_n:d area_mm2:d centroid_x_mm:d centroid_y_mm:d interval_mm:d expected_rmse_mm:d baseline_age_s:d "
    "run_time_us:d latency_us:d sensor:256s model:64s wrench_origin:i has_traction:i force_x_n:d force_y_n:d "
    "force_z_n:d torque_x_n_mm:d torque_y_n_mm:d torque_z_n_mm:d centre_of_pressure_x_mm:d centre_of_pressure_y_mm:d"
)
"""Names and struct's characters of what programs in the field read, as version 1 was published: without gaps."""


CHOICES = {
    "source": ("device", "replay", "emulated"),
    "state": ("zeroing", "incomplete", "idle", "contact", "dropped", "baseline_in_doubt"),
    "filled": ("rest", "neighbours"),
    "wrench_origin": ("nominal", "calibrated"),
    "untrusted_reason": ("stuck", "unfamiliar", "unexplained", "sensor", "uncertain", "beyond", "pad", "baseline"),
}


class TestWhatIsThere:
    def test_all_of_a_contact(self, sink, name):
        result = make_result(7, press_counts=3000, stale=(0, 15))
        sink.write(result, {})
        half = latest(attach(name), "4")
        said = fields(half)
        assert said["sensor"].rstrip(b"\0") == b"4" and said["model"].rstrip(b"\0") == b"fake"
        assert (said["time_ns"], said["scan"], said["device_time_ns"], said["sequence"]) == (80_000_000, 7, -1, 1)
        assert (said["has_deviation"], said["reused_from"], said["taps_used"]) == (1, -1, 1)
        assert (said["dead"], said["fresh"], said["renewed"]) == (0, 0xFFFF, 0x7FFE)
        assert (said["force_counts"], said["area_mm2"]) == (3000.0, pytest.approx(22.09))
        assert (said["centroid_x_mm"], said["centroid_y_mm"]) == pytest.approx(result.centroid_mm)
        assert said["interval_mm"] == pytest.approx(result.interval_mm)
        assert said["run_time_us"] == pytest.approx(result.run_time_us)
        assert said["baseline_age_s"] == pytest.approx(12.34)
        assert np.isnan(said["force_n"]) and np.isnan(said["latency_us"])
        np.testing.assert_array_equal(values(half, "counts"), result.scan.counts)

    def test_each_kind_of_result_hides_the_one_before(self, sink, name):
        """A later result of a sensor, without a pattern, hides the earlier one."""
        for result in every_kind():
            sink.write(result, {})
            half = shm_read.newest(attach(name))[result.scan.sensor]
            said = fields(half)
            source, state = said["source"] - 1, said["state"] - 1
            assert (CHOICES["source"][source], CHOICES["state"][state]) == (result.source, result.state)
            unknown = {None: -1, False: 0, True: 1}
            assert (said["trusted"], said["contact"]) == (unknown[result.trusted], unknown[result.contact])
            assert (said["dead"], said["filled"]) == ((8, 2) if result.dead else (0, 0))
            assert said["scan"] == result.scan.number and bool(said["has_pattern"]) == (result.pattern is not None)
            assert said["force_counts"] == result.force_counts or np.isnan(said["force_counts"])
            for map_name in ("pattern", "deviation", "zeroed"):
                shown, made = values(half, map_name), getattr(result, map_name)
                assert np.isnan(shown).all() if made is None else np.array_equal(shown, made)
            assert ((values(half, "counts") == -1).all(axis=0) == ~result.scan.fresh).all()

    def test_each_sensor_has_its_own_and_one_too_many_is_refused(self, sink, name):
        names = ["left/4", "右" * 64, "x" * 64, *map(str, range(SLOTS - 3))]
        assert latest(attach(name), "") is None and latest(attach(name), "left/4") is None, "nobody wrote it"
        for number, sensor in enumerate(names):
            sink.write(make_result(number, sensor=sensor), {})
        memory = attach(name)
        assert [fields(latest(memory, sensor) or b"")["scan"] for sensor in names] == [*range(SLOTS)]
        assert latest(memory, "right/4") is None
        with pytest.raises(SinkError, match=rf"room for {SLOTS} sensors, and one-more is one more"):
            sink.write(make_result(sensor="one-more"), {})


class TestLayout:
    def test_what_readers_of_version_1_know_lies_where_it_did(self):
        offsets, known = offsets_of(MEMBERS), [tuple(one.split(":")) for one in VERSION_1.split()]
        assert list(MEMBERS)[: len(known)] == known and offsets[known[-1][0]] == 568
        assert [field.byte for field in IN_MEMORY] == [offsets[field.names[0]] for field in IN_MEMORY], "no gap"
        assert {field.name: field.kind.words for field in IN_MEMORY if field.kind.words} == CHOICES

    def test_the_header_tells_where_maps_lie(self, sink, name):
        memory = attach(name)
        layout, offsets = Layout(4, 4, 40, 40), offsets_of(HEADER)
        told = dict(zip((field for field, _ in HEADER), shm.struct_of(HEADER).unpack_from(memory), strict=True))
        assert {one: told[f"{one}_at"] for one in layout.maps} == {one: at for one, (_, _, at) in layout.maps.items()}
        assert (told["writer_pid"], told["pattern_unit"].rstrip(b"\0")) == (os.getpid(), b"mm")
        assert len(memory) == layout.total_bytes and offsets["writer_pid"] == 64

    def test_the_documented_tables_are_the_layout(self):
        page = (ROOT / "docs" / "middleware.md").read_text()
        documented = re.findall(r"^\| (\d+) \| `(\w+)` \| (\w+(?:\[\d+\])?) \|", page, re.MULTILINE)
        names = {"I": "u32", "i": "i32", "i4x": "i32", "Q": "u64", "q": "i64", "d": "f64"}
        tables = [
            (str(offsets_of(table)[field]), field, names.get(kind) or f"char[{kind[:-1]}]")
            for table in (HEADER, MEMBERS)
            for field, kind in table
        ]
        heartbeat = (str(shm.HEARTBEAT_AT), "heartbeat_ns", "i64")
        assert documented == [*tables[: len(HEADER)], heartbeat, *tables[len(HEADER) :]]

    def test_a_wrench_and_its_traction_are_there_while_they_hold(self, name):
        sink = SharedMemorySink(name, make_pad_contract(interval_factor=1.6))
        memory, layout = attach(name), Layout(4, 4, 40, 40, (3, 8, 8))
        at, height, width = unpack_from("<3I", memory, offsets_of(HEADER)["traction_at"])
        kind, shape, place = layout.maps["traction"]
        assert (at, height, width) == (place, 8, 8)
        told = {}
        for number, press in enumerate((20_000, 0)):
            result = make_wrench_result(number, press)
            sink.write(result, {})
            half = latest(memory, "4")
            told[press] = fields(half), np.frombuffer(half, kind, math.prod(shape), at).reshape(shape), result
        sink.close()
        said, traction, result = told[20_000]
        names = [f"{what}_{axis}_{unit}" for what, unit in (("force", "n"), ("torque", "n_mm")) for axis in "xyz"]
        assert [said[one] for one in names] == [*result.wrench.force_n, *result.wrench.torque_n_mm]
        centre = (said["centre_of_pressure_x_mm"], said["centre_of_pressure_y_mm"])
        assert centre == result.wrench.centre_of_pressure_mm
        assert (said["wrench_origin"], said["has_traction"]) == (1, 1)
        np.testing.assert_array_equal(traction, result.traction)
        said, traction, _ = told[0]
        assert np.isnan(traction).all() and all(math.isnan(said[one]) for one in names)
        assert (said["wrench_origin"], said["has_traction"]) == (0, 0) and math.isnan(said["centre_of_pressure_x_mm"])

    @pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
    def test_the_documented_reader_in_c_reads(self, sink, name, tmp_path):
        if subprocess.run(["gcc", "-E", "-"], input=b"#include <zlib.h>", capture_output=True).returncode:
            pytest.skip("there is no zlib.h")
        command = ["gcc", "-Wall", "-Wextra", "-Werror", "-O2", ROOT / "examples" / "shm_read.c", "-lz", "-o", "read"]
        subprocess.run(command, cwd=tmp_path, check=True)

        def read(sensor, number, *words, age_ns=0, **changes):
            result = make_result(number, press_counts=3000, sensor=sensor, time_ns=time.monotonic_ns() - age_ns)
            sink.write(replace(result, **changes), {})
            done = subprocess.run([tmp_path / "read", name, "4", *words], capture_output=True, text=True)
            return done.returncode, done.stdout

        assert read("right/4", 6, "pretend") == (1, "")  # another
        told = 0, "state 4 scan 7 force_counts 3000.0\n"
        assert any(read("4", 7, "pretend") == told for _ in range(20))  # where the processor is free within 50 ms
        assert any(read("4", 7, source="device") == told for _ in range(20))
        assert read("4", 9) == (1, "")  # emulated
        assert read("4", 9, source="device", state="baseline_in_doubt", trusted=False) == (1, "")
        assert read("4", 10, age_ns=50_000_000, source="device") == (1, "")
        assert read("4", 11, age_ns=-60_000_000_000, source="device") == (1, "")


READS = 5_000
PATIENCE_S = 30


class TestReading:
    def test_no_read_is_torn_and_none_goes_back(self, name, writer):
        """Reads go on beyond their number until the writer wrote much, however little processor time it gets."""
        memory, newest, torn, backwards = attach(name), {"left/4": -1, "right/4": -1}, 0, 0
        reads, end_s = count(), time.monotonic() + PATIENCE_S
        while (read := next(reads)) < READS or min(newest.values()) <= 1000:
            assert time.monotonic() < end_s, f"the writer wrote {newest} meanwhile"
            sensor = ("left/4", "right/4")[read % 2]
            half = latest(memory, sensor)
            (number,) = unpack_from("<q", half, 24)
            maps = [values(half, map_name) for map_name in ("counts", "pattern", "deviation")]
            torn += not all((shown == number % 60_000).all() for shown in maps)
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
    def test_broken_memory_is_given_up_and_hides_no_whole_scan(self, sink, name, at, broken, scan):
        sink.write(make_result(5), {})
        with Path("/dev/shm", name).open("r+b") as file:
            file.seek(at)
            file.write(b"\xff" * broken)
        half = latest(attach(name), "4")
        assert (half and fields(half)["scan"]) == scan

    def test_only_what_is_young_and_of_a_device_is_acted_on(self, sink, name):
        memory, now_ns = attach(name), time.monotonic_ns()
        result = replace(make_result(7, press_counts=3000, time_ns=now_ns), source="device")
        old, early = (replace(result.scan, time_ns=now_ns + 60_000_000_000 * sign) for sign in (-1, 1))
        for changes, why in (
            ({}, None),
            ({"scan": old}, r"the newest reading is (60|59)\.\d\d s old, expected under 60"),
            ({"scan": early}, r"the newest reading is -(60|59)\.\d\d s old, expected under 60"),  # of another machine
            ({"source": "emulated"}, "its source is emulated, not a device: --pretend"),
            ({"source": "replay"}, "its source is replay, not a device: --pretend"),
            ({"state": "baseline_in_doubt", "trusted": False}, ".*baseline is in doubt"),
        ):
            sink.write(replace(result, **changes), {})
            refused = shm_read.refusal(shm_read.newest(memory)["4"], oldest_s=60.0)
            assert refused is None if why is None else re.match(why, refused)
            taken = shm_read.latest(memory, "4", oldest_s=60.0)
            assert (taken is None) == (why is not None)
            assert "source" not in changes or shm_read.latest(memory, "4", oldest_s=60.0, pretend=True) is not None
        sink.write(result, {})
        assert shm_read.latest(memory, "4", oldest_s=0.0) is None

    def test_the_example_prints_what_it_acts_on_until_memory_is_gone(self, name, writer):
        command = [sys.executable, str(ROOT / "examples" / "shm_read.py"), name, "left/4", "--pretend"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with ended(subprocess.Popen(command, text=True, **pipes)) as reader:
            while not re.fullmatch(r"\d+ counts, pattern not checked", told := reader.stdout.readline().rstrip()):
                assert told.startswith("nothing to act on: the newest reading is")  # its writer had no turn for 50 ms
            Path("/dev/shm", name).unlink()
            _, errors = reader.communicate()
        assert reader.returncode == 1
        assert re.fullmatch(rf".*No such file .*: expected what edge-sr --sink shm:{name} writes\n", errors)


class TestWriters:
    def test_the_end_is_seen_and_the_name_is_free(self, name):
        sink = SharedMemorySink(name, CONTRACT)
        memory = attach(name)
        assert writing(memory) and Path("/dev/shm", name).stat().st_mode & 0o777 == 0o600, "nobody else may read it"
        sink.close()
        assert not writing(memory)
        with pytest.raises(FileNotFoundError):
            attach(name)
        sink.close()

        # A name that another took meanwhile stays.
        sink = SharedMemorySink(name, CONTRACT)
        Path("/dev/shm", name).unlink()
        other = SharedMemorySink(name, CONTRACT)
        sink.close()
        assert writing(attach(name), within_s=60)
        other.close()
        with pytest.raises(FileNotFoundError):
            attach(name)

    def test_a_writer_that_waits_gives_signs_of_life(self, name):
        sink = SharedMemorySink(name, CONTRACT)
        memory = attach(name)
        gone = Event(0, "lost", None, "gone")
        for act in (sink.wait, lambda: sink.tell(gone, {}), lambda: sink.write(make_result(), {})):
            begun_ns = time.monotonic_ns()
            act()
            assert begun_ns <= heartbeat_ns(memory) <= time.monotonic_ns()
        sink.close()

    def test_one_that_was_killed_is_seen_and_its_place_taken(self, name, writer):
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

    def test_two_cannot_write_one(self, name, writer):
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
