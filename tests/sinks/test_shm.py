"""Latest values in shared memory: a real writer and a real reader, each a process of its own."""

import math
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from struct import unpack_from

import numpy as np
import pytest
from edge_samples import ROOT, make_pad_contract, make_wrench_result
from shm_samples import fields, latest, make_result, name, sink, values

from edge.errors import SinkError
from edge.sinks import shm
from edge.sinks.shm import HEADER, IN_MEMORY, MEMBERS, SLOTS, Layout, SharedMemorySink, offsets_of

sys.path.append(str(ROOT / "examples"))
from shm_read import attach

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="shared memory is a folder on Linux alone")

__all__ = ["name", "sink"]
VERSION_1 = (
    "checksum:I reserved:I sequence:Q time_ns:q scan:q device_time_ns:q reused_from:q source:i state:i contact:i "
    "taps_used:i has_pattern:i has_deviation:i another_tap:i filled:i dead:Q fresh:Q renewed:Q force_counts:d "
    "force_n:d area_mm2:d centroid_x_mm:d centroid_y_mm:d interval_mm:d expected_rmse_mm:d baseline_age_s:d "
    "run_time_us:d latency_us:d sensor:256s model:64s wrench_origin:i has_traction:i force_x_n:d force_y_n:d "
    "force_z_n:d torque_x_n_mm:d torque_y_n_mm:d torque_z_n_mm:d centre_of_pressure_x_mm:d centre_of_pressure_y_mm:d"
)
"""Names and struct's characters of what programs in the field read, as version 1 was published: without gaps."""


class TestWhatIsThere:
    def test_all_of_a_contact(self, sink, name):
        result = make_result(7, press_counts=3000, stale=(0, 15))
        sink.write(result, {})
        half = latest(attach(name), "4")
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

    def test_what_is_over_or_was_not_read_is_not_there(self, sink, name):
        sink.write(make_result(0, press_counts=3000), {})
        sink.write(replace(make_result(1), dead={0: "stuck", 15: "silent"}, filled="neighbours"), {})
        sink.write(make_result(0, sensor="6", absent=(3,)), {})
        over, zeroing = (latest(attach(name), sensor) or b"" for sensor in "46")
        said = [fields(over)[key] for key in ("scan", "state", "contact", "has_pattern", "dead", "filled")]
        assert said == [1, 3, 0, 0, 0x8001, 2]
        assert np.isnan(values(over, "pattern")).all() and np.isnan(values(over, "deviation")).all()
        assert (fields(zeroing)["state"], fields(zeroing)["contact"]) == (1, -1)
        assert np.isnan(values(zeroing, "zeroed")).all() and values(zeroing, "counts")[:, 0, 3].tolist() == [-1] * 3

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


REASONS = ("stuck", "unfamiliar", "unexplained", "sensor", "uncertain", "beyond", "pad", "baseline")


class TestLayout:
    def test_what_readers_of_version_1_know_lies_where_it_did(self):
        offsets, known = offsets_of(MEMBERS), [tuple(one.split(":")) for one in VERSION_1.split()]
        assert list(MEMBERS)[: len(known)] == known and offsets[known[-1][0]] == 568
        assert [field.byte for field in IN_MEMORY] == [offsets[field.names[0]] for field in IN_MEMORY], "no gap"
        choices = {field.name: field.kind.words for field in IN_MEMORY if field.kind.words}
        assert choices == {
            "source": ("device", "replay", "emulated"),
            "state": ("zeroing", "incomplete", "idle", "contact", "dropped", "baseline_in_doubt"),
            "filled": ("rest", "neighbours"),
            "wrench_origin": ("nominal", "calibrated"),
            "untrusted_reason": REASONS,
        }

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
        assert read("4", 10, age_ns=50_000_000, source="device") == (1, "")
        assert read("4", 11, age_ns=-60_000_000_000, source="device") == (1, "")
