"""Latest values in shared memory: a real writer and a real reader, each a process of its own."""

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
from edge_samples import (
    BASELINE,
    ROOT,
    FakeModel,
    ended,
    make_contract,
    make_pad_contract,
    make_scan,
    make_wrench_result,
)

from edge.errors import SinkError
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.sinks.registry import open_sink
from edge.sinks.shm import SharedMemorySink
from edge.sinks.shm_layout import HEADER, HEARTBEAT_AT, IN_MEMORY, MEMBERS, SLOTS, Layout, offsets_of, struct_of

sys.path.append(str(ROOT / "examples"))
import shm_read
from shm_read import attach

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="shared memory is a folder on Linux alone")

CONTRACT = make_contract(interval_factor=1.6)
READS = int(os.environ.get("EDGE_SHM_READS", "20000"))
ENVIRONMENT = os.environ | {
    "PYTHONPATH": f"{ROOT}:{ROOT / 'tests/sinks'}:{ROOT / 'tests/support'}:{ROOT / 'examples'}",
    "PYTHONUNBUFFERED": "",
}
VERSION_1 = {
    "checksum": (0, "I"),
    "reserved": (4, "I"),
    "sequence": (8, "Q"),
    "time_ns": (16, "q"),
    "scan": (24, "q"),
    "device_time_ns": (32, "q"),
    "reused_from": (40, "q"),
    "source": (48, "i"),
    "state": (52, "i"),
    "contact": (56, "i"),
    "taps_used": (60, "i"),
    "has_pattern": (64, "i"),
    "has_deviation": (68, "i"),
    "another_tap": (72, "i"),
    "filled": (76, "i"),
    "dead": (80, "Q"),
    "fresh": (88, "Q"),
    "renewed": (96, "Q"),
    "force_counts": (104, "d"),
    "force_n": (112, "d"),
    "area_mm2": (120, "d"),
    "centroid_x_mm": (128, "d"),
    "centroid_y_mm": (136, "d"),
    "interval_mm": (144, "d"),
    "expected_rmse_mm": (152, "d"),
    "baseline_age_s": (160, "d"),
    "run_time_us": (168, "d"),
    "latency_us": (176, "d"),
    "sensor": (184, "256s"),
    "model": (440, "64s"),
    "wrench_origin": (504, "i"),
    "has_traction": (508, "i"),
    "force_x_n": (512, "d"),
    "force_y_n": (520, "d"),
    "force_z_n": (528, "d"),
    "torque_x_n_mm": (536, "d"),
    "torque_y_n_mm": (544, "d"),
    "torque_z_n_mm": (552, "d"),
    "centre_of_pressure_x_mm": (560, "d"),
    "centre_of_pressure_y_mm": (568, "d"),
}
"""Byte and struct's character of what programs in the field read, as version 1 was published."""
PATIENCE_S = 30
WRITE = """
import sys, time
from dataclasses import replace
import numpy as np
from edge.sinks.shm import SharedMemorySink
from test_shm import CONTRACT, make_result
result = make_result(press_counts=3000)
sink = SharedMemorySink(sys.argv[1], CONTRACT)
number = 0
while True:
    for sensor in ("left/4", "right/4"):
        counts, now_ns = np.full((3, 4, 4), number % 60_000), time.monotonic_ns()
        scan = replace(result.scan, sensor=sensor, number=number, counts=counts, time_ns=now_ns)
        pattern = np.full((40, 40), number % 60_000, np.float32)
        sink.write(replace(result, scan=scan, pattern=pattern, deviation=pattern, force_counts=number), {})
    number == 0 and print("writes", flush=True)
    number += 1
"""


def make_result(number=0, *, contract=CONTRACT, press_counts=0, **of_the_scan):
    runtime = Runtime(FakeModel(contract), source="emulated", baselines={"4": BASELINE}, unix_time_s=lambda: 1012.34)
    return runtime.push(make_scan(number, press_counts=press_counts, **of_the_scan))


def latest(memory: memoryview, sensor: str) -> bytes | None:
    """Of any source and age: made up as they are here."""
    return shm_read.latest(memory, sensor, oldest_s=math.inf, pretend=True)


def heartbeat_ns(memory: memoryview) -> int:
    return memory.cast("Q")[HEARTBEAT_AT // 8]


def writing(memory: memoryview, within_s: float = 0.5) -> bool:
    """Whether the writer lives."""
    return time.monotonic_ns() - heartbeat_ns(memory) < within_s * 1e9


def fields(half: bytes) -> dict:
    names = [name for name, _ in MEMBERS]
    return dict(zip(names, struct_of(MEMBERS).unpack_from(half), strict=True))


def values(half: bytes, name: str) -> np.ndarray:
    kind, shape, at = Layout(4, 4, 40, 40).maps[name]
    return np.frombuffer(half, kind, int(np.prod(shape)), at).reshape(shape)


@pytest.fixture
def name():
    name = f"test-{os.getpid()}-{time.monotonic_ns()}"
    yield name
    Path("/dev/shm", name).unlink(missing_ok=True)


@pytest.fixture
def sink(name):
    sink = SharedMemorySink(name, CONTRACT)
    yield sink
    sink.close()


@pytest.fixture
def start_writer(name):
    writers = []

    def start():
        command = [sys.executable, "-c", WRITE, name]
        writer = subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE)
        writers.append(writer)
        assert writer.stdout is not None and writer.stdout.readline() == b"writes\n"
        return writer

    yield start
    for writer in writers:
        writer.kill()
        writer.wait()
        writer.stdout.close()


class TestWhatIsThere:
    def test_all_of_a_contact(self, sink, name):
        result = make_result(7, press_counts=3000, stale=(0, 15))
        sink.write(result, {})
        half = latest(attach(name), "4")
        assert half is not None
        said = fields(half)
        assert said["sensor"].rstrip(b"\0") == b"4" and said["model"].rstrip(b"\0") == b"fake"
        assert (said["time_ns"], said["scan"], said["device_time_ns"], said["sequence"]) == (80_000_000, 7, -1, 1)
        # emulated, contact
        assert (said["source"], said["state"], said["contact"], said["taps_used"]) == (3, 4, 1, 1)
        assert (said["has_pattern"], said["has_deviation"], said["reused_from"], said["filled"]) == (1, 1, -1, 0)
        assert (said["dead"], said["fresh"], said["renewed"]) == (0, 0xFFFF, 0x7FFE)
        assert (said["force_counts"], said["area_mm2"]) == (3000.0, pytest.approx(22.09))
        assert (said["centroid_x_mm"], said["centroid_y_mm"]) == pytest.approx(result.centroid_mm)
        assert said["interval_mm"] == pytest.approx(result.interval_mm)
        assert said["run_time_us"] == pytest.approx(result.run_time_us)
        assert said["baseline_age_s"] == pytest.approx(12.34)
        assert np.isnan(said["force_n"]) and np.isnan(said["latency_us"])
        for map_name in ("pattern", "deviation", "zeroed"):
            np.testing.assert_array_equal(values(half, map_name), getattr(result, map_name))
        np.testing.assert_array_equal(values(half, "counts"), result.scan.counts)

    def test_nothing_is_left_of_a_pattern_that_is_over(self, sink, name):
        sink.write(make_result(0, press_counts=3000), {})
        sink.write(make_result(1), {})
        half = latest(attach(name), "4")
        assert half is not None
        said = fields(half)
        assert (said["scan"], said["state"], said["contact"], said["has_pattern"]) == (1, 3, 0, 0)
        assert np.isnan(values(half, "pattern")).all() and np.isnan(values(half, "deviation")).all()

    def test_a_sensor_without_a_baseline_has_no_zeroed_counts(self, sink, name):
        sink.write(make_result(0, sensor="6", absent=(3,)), {})
        half = latest(attach(name), "6")
        assert half is not None
        assert (fields(half)["state"], fields(half)["contact"]) == (1, -1)
        assert np.isnan(values(half, "zeroed")).all()
        assert values(half, "counts")[:, 0, 3].tolist() == [-1, -1, -1]

    def test_dead_taxels_are_told(self, sink, name):
        sink.write(replace(make_result(), dead={0: "stuck", 15: "silent"}, filled="neighbours"), {})
        half = latest(attach(name), "4")
        assert half is not None and (fields(half)["dead"], fields(half)["filled"]) == (0x8001, 2)

    def test_memory_that_nobody_wrote_is_no_sensor(self, sink, name):
        assert latest(attach(name), "") is None and latest(attach(name), "4") is None

    def test_each_sensor_has_its_own_and_names_of_any_script_fit(self, sink, name):
        names = ["left/4", "右" * 64, "x" * 64]
        for number, sensor in enumerate(names):
            sink.write(make_result(number, sensor=sensor), {})
        memory = attach(name)
        assert [unpack_from("<q", latest(memory, sensor) or b"", 24)[0] for sensor in names] == [0, 1, 2]
        assert latest(memory, "right/4") is None

    def test_a_sensor_too_many_is_refused(self, sink):
        for number in range(SLOTS):
            sink.write(make_result(sensor=str(number)), {})
        with pytest.raises(SinkError, match=rf"room for {SLOTS} sensors, and one-more is one more"):
            sink.write(make_result(sensor="one-more"), {})

    def test_a_model_without_deviation_and_with_a_long_name(self, sink, name):
        result = make_result(press_counts=3000, contract=make_contract())
        sink.write(replace(result, model="é" * 40), {})
        half = latest(attach(name), "4")
        assert half is not None and fields(half)["has_deviation"] == 0
        assert fields(half)["model"].rstrip(b"\0").decode() == "é" * 32


class TestLayout:
    def test_every_number_lies_at_a_multiple_of_its_size(self):
        sizes = {"I": 4, "i": 4, "Q": 8, "q": 8, "d": 8}
        for table in (HEADER, MEMBERS):
            offsets = offsets_of(table)
            assert not [field for field, kind in table if offsets[field] % sizes.get(kind, 8)]
        for layout in (Layout(4, 4, 40, 40), Layout(3, 5, 9, 5)):
            assert not [at for _, _, at in layout.maps.values() if at % 8]
            assert layout.half_bytes % 64 == 0 and layout.slot_bytes % 64 == 0
        assert struct_of(HEADER).size <= HEARTBEAT_AT

    def test_what_readers_of_version_1_know_lies_where_it_did(self):
        offsets, kinds = offsets_of(MEMBERS), dict(MEMBERS)
        assert {name: (offsets[name], kinds[name]) for name in VERSION_1} == VERSION_1
        assert [field.byte for field in IN_MEMORY] == [offsets[field.names[0]] for field in IN_MEMORY], "no gap"
        choices = {field.name: field.kind.words for field in IN_MEMORY if field.kind.words}
        assert choices == {
            "source": ("device", "replay", "emulated"),
            "state": ("zeroing", "incomplete", "idle", "contact", "dropped"),
            "filled": ("rest", "neighbours"),
            "wrench_origin": ("nominal", "calibrated"),
        }

    def test_the_header_tells_where_maps_lie(self, sink, name):
        memory = attach(name)
        layout, offsets = Layout(4, 4, 40, 40), offsets_of(HEADER)
        told = dict(zip((field for field, _ in HEADER), struct_of(HEADER).unpack_from(memory), strict=True))
        assert {map_name: told[f"{map_name}_at"] for map_name in layout.maps} == {
            map_name: at for map_name, (_, _, at) in layout.maps.items()
        }
        assert (told["writer_pid"], told["pattern_unit"].rstrip(b"\0")) == (os.getpid(), b"mm")
        assert len(memory) == layout.total_bytes and offsets["writer_pid"] == 64

    def test_the_documented_tables_are_the_layout(self):
        page = (ROOT / "docs" / "middleware.md").read_text()
        documented = re.findall(r"^\| (\d+) \| `(\w+)` \| (\w+(?:\[\d+\])?) \|", page, re.MULTILINE)
        names = {"I": "u32", "i": "i32", "Q": "u64", "q": "i64", "d": "f64"}
        tables = [
            (str(offsets_of(table)[field]), field, names.get(kind) or f"char[{kind[:-1]}]")
            for table in (HEADER, MEMBERS)
            for field, kind in table
        ]
        heartbeat = (str(HEARTBEAT_AT), "heartbeat_ns", "i64")
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
            assert half is not None
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

    def test_without_traction_the_header_says_so(self, sink, name):
        assert unpack_from("<3I", attach(name), offsets_of(HEADER)["traction_at"]) == (0, 0, 0)

    @pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
    def test_the_documented_reader_in_c_reads(self, sink, name, tmp_path):
        page = (ROOT / "docs" / "middleware.md").read_text()
        (tmp_path / "read.c").write_text(page.partition("```c\n")[2].partition("```")[0])
        if subprocess.run(["gcc", "-E", "-"], input=b"#include <zlib.h>", capture_output=True).returncode:
            pytest.skip("there is no zlib.h")
        command = ["gcc", "-Wall", "-Wextra", "-Werror", "-O2", "read.c", "-lz", "-o", "read"]
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
        assert read("4", 10, age_ns=50_000_000, source="device") == (1, "")
        assert read("4", 11, age_ns=-60_000_000_000, source="device") == (1, "")


class TestReading:
    def test_no_read_is_torn_and_none_goes_back(self, name, start_writer):
        """As many reads as wanted, and on, however little the writer is given of the processor, until it wrote much."""
        start_writer()
        memory, newest, torn, backwards = attach(name), {"left/4": -1, "right/4": -1}, 0, 0
        kinds = [(kind, shape, at) for kind, shape, at in Layout(4, 4, 40, 40).maps.values()][1:]
        reads, end_s = count(), time.monotonic() + PATIENCE_S
        while (read := next(reads)) < READS or min(newest.values()) <= 1000:
            assert time.monotonic() < end_s, f"the writer wrote {newest} meanwhile"
            sensor = ("left/4", "right/4")[read % 2]
            half = latest(memory, sensor)
            assert half is not None
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
        """As a processor that orders nothing may show it: the newest sequence, and values from before."""
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

    def test_broken_memory_is_given_up(self, sink, name):
        sink.write(make_result(), {})
        with Path("/dev/shm", name).open("r+b") as file:
            file.seek(192 + 64 + 13696 + 500)
            file.write(b"\xff")
        assert latest(attach(name), "4") is None

    def test_a_half_that_is_being_written_hides_nothing(self, sink, name):
        """A writer killed half-way leaves the newest whole value."""
        sink.write(make_result(5), {})
        with Path("/dev/shm", name).open("r+b") as file:  # of sequence 2
            file.seek(192 + 64)
            file.write(b"\xff" * 5000)
        half = latest(attach(name), "4")
        assert half is not None and fields(half)["scan"] == 5

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
        for source in ("emulated", "replay"):
            sink.write(replace(result, source=source), {})
            assert shm_read.latest(memory, "4", **young) is None
            assert shm_read.latest(memory, "4", **young, pretend=True) is not None

    @pytest.mark.parametrize(
        ("words", "line"), [(["--pretend"], r"\d+ counts, [\d.]+ mm at most"), ([], "nothing to .*")]
    )
    def test_the_example_prints_what_it_acts_on_until_the_memory_is_gone(self, name, start_writer, words, line):
        start_writer()
        command = [sys.executable, str(ROOT / "examples" / "shm_read.py"), name, "left/4", *words]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with ended(subprocess.Popen(command, env=ENVIRONMENT, text=True, **pipes)) as reader:
            while not re.fullmatch(line, told := reader.stdout.readline().rstrip()):
                assert told == "nothing to act on", "of the writer, which had no turn for 50 ms"
            Path("/dev/shm", name).unlink()
            _, errors = reader.communicate()
        assert reader.returncode == 1
        assert re.fullmatch(rf".*No such file .*: expected what edge-sr --sink shm:{name} writes\n", errors)

    def test_the_example_says_how_it_is_called(self):
        command = [sys.executable, str(ROOT / "examples" / "shm_read.py")]
        for words in ([], ["skin"], ["skin", "4", "--now"]):
            done = subprocess.run([*command, *words], env=ENVIRONMENT, capture_output=True, text=True)
            assert done.returncode == 1 and done.stderr == f"{shm_read.USAGE}\n"


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
        for act in (
            sink.wait,
            lambda: sink.tell(Event(0, "lost", None, "gone"), {}),
            lambda: sink.write(make_result(), {}),
        ):
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
        with pytest.raises(
            SinkError, match=rf"{name} is written by process {writer.pid}: end it, or choose another name"
        ):
            SharedMemorySink(name, CONTRACT)
        assert writing(attach(name), within_s=5)
        assert not list(Path("/dev/shm").glob(f".{name}*"))

    def test_what_another_program_left_there_stays(self, name):
        path = Path("/dev/shm", name)
        path.write_bytes(b"mine" * 100)
        with pytest.raises(SinkError, match=r"another program's shared memory"):
            SharedMemorySink(name, CONTRACT)
        assert path.read_bytes() == b"mine" * 100

    @pytest.mark.parametrize("bad", ["a/b", "../x", ".x", "a b", "x" * 101])
    def test_a_name_must_be_a_plain_one(self, bad):
        with pytest.raises(SinkError, match=r"cannot be a name: expected letters"):
            open_sink(f"shm:{bad}", CONTRACT)

    def test_nobody_else_may_read_it(self, sink, name):
        assert Path("/dev/shm", name).stat().st_mode & 0o777 == 0o600

    def test_without_shared_memory_it_says_so(self, tmp_path):
        with pytest.raises(SinkError, match=r"needs Linux"):
            SharedMemorySink("x", CONTRACT, folder=tmp_path / "none")
