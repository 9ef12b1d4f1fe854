"""`edge-sr convert`: all that a recording holds is in the new file, and nothing is replaced, lost or left behind."""

import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from edge_samples import ROOT, fake_source, make_scan
from mcap_samples import SURE, TURNED, arrays_of, make_results, messages_alone, odd_scans, record_into

from edge.api import PadPose, Result, TimedPose
from edge.cli import main as cli
from edge.perception.record_fields import MAPS
from edge.sinks.json_records import record
from edge.sinks.registry import open_sink
from edge.sinks.ros2.messages import GRID, IMAGE
from firmware_bridge.recording.formats import load_recording


def convert(*words: object) -> int:
    return cli.main(["convert", *map(str, words)])


@pytest.fixture
def made(tmp_path) -> tuple[Path, list[Result]]:
    """A recording of two sensors with all that scans may have, one of them mounted turned, with poses."""
    results = make_results(odd_scans(), source="emulated", mountings={"4": TURNED})
    path = tmp_path / "press.mcap"
    sink = open_sink(f"mcap:{path}", SURE, fake_source(mountings={"4": TURNED}, unix_offset_ns=10**18))
    for number, result in enumerate(results):
        if number % 4 == 0:
            pose = PadPose(number, -number / 3, 10 * number, 0.4, 0.5)
            sink.pose([TimedPose(pose, result.scan.time_ns, "4", True, result.scan.time_ns)])
        sink.write(result, {"scans": number})
    sink.close()
    return path, results


def test_arrays_hold_all_but_what_is_named_as_left_out(made, capsys):
    path, results = made
    arrays = arrays_of(path)
    left_out = set(re.findall(r"\w+", capsys.readouterr().out.partition("not in it: ")[2]))
    table = (ROOT / "docs" / "recordings.md").read_text().partition("| [`.npz`]")[2].partition("\n")[0]
    assert not left_out & arrays.keys()
    for name in record(results[-1], {}).keys() - arrays.keys() - {"poses"}:  # these of models that take them alone
        assert name in left_out and name in table
    results = sorted(results, key=lambda one: one.scan.time_ns)
    order = np.argsort(arrays["time_ns"], kind="stable")
    rows = {name: array[order] for name, array in arrays.items() if array.shape[:1] == (len(results),)}
    for row, result in enumerate(results):
        scan = result.scan
        known = [rows[name][row] for name in ("sensor", "scan", "time_ns")]
        assert known == [scan.sensor, scan.number, scan.time_ns]
        assert rows["device_time_ns"][row] == (-1 if scan.device_ns is None else scan.device_ns)
        assert (rows["counts"][row] == scan.counts).all()
        assert (rows["state"][row], rows["source"][row], rows["model"][row]) == (result.state, "emulated", result.model)
        assert rows["has_pattern"][row] == (result.pattern is not None)
        assert rows["contact"][row] == (-1 if result.contact is None else result.contact)
        for name in ("force_counts", "force_n", "area_mm2", "centroid_mm", "interval_mm", "baseline_age_s"):
            value = np.nan if (value := getattr(result, name)) is None else value
            np.testing.assert_allclose(rows[name][row], value, atol=0.06)
        assert rows["baseline"][row] == ("" if result.baseline is None else result.baseline.id)
        if result.baseline is not None:
            assert (rows["baseline_counts"][row] == result.baseline.counts).all()
        for field in MAPS:
            values = getattr(result, field.attribute)
            if values is not None:
                np.testing.assert_allclose(rows[field.name][row], values, rtol=1e-6)
            elif field.name in rows:
                assert not rows[field.name][row].any()
    assert set(arrays["origin"]) == {"emulated"} and arrays["pose_sensor"].tolist() == ["4"] * 6
    assert arrays["pose"][1].tolist() == [4.0, -4 / 3, 40.0, 0.4, 0.5]


def test_a_csv_has_the_id_maps_order_and_says_what_is_missing(made, tmp_path, capsys):
    path, results = made
    assert convert(path, tmp_path / "press.csv") == 0
    out = capsys.readouterr().out
    files = {name: tmp_path / f"press-{name.replace('/', '-')}.csv" for name in ("4", "left/6")}
    for sensor, file in files.items():
        own = [result.scan for result in results if result.scan.sensor == sensor]
        whole = [scan for scan in own if scan.complete]
        again = load_recording(file)
        counts = np.array([scan.counts for scan in whole])
        placed = TURNED.place_counts(again.tracks[0].counts) if sensor == "4" else again.tracks[0].counts
        assert (placed == counts).all() and again.origin == "emulated"
        assert f"{file}: {len(whole)} scans of sensor {sensor}, " in out
    assert out.count("scans are left out: a taxel gave no reading") == 1 and "not in it: all but counts, times" in out
    assert load_recording(files["4"]).poses[0].pose == PadPose(0, 0, 0)
    assert not load_recording(files["left/6"]).poses


def test_two_sensors_whose_names_make_one_file_name_get_numbers(tmp_path):
    scans = [make_scan(number, sensor=name) for number in range(3) for name in ("a/b", "a-b")]
    path = record_into(tmp_path / "press.mcap", make_results(scans))
    assert convert(path, tmp_path / "press.csv") == 0
    assert [len(load_recording(tmp_path / f"press-{number}.csv").tracks[0].counts) for number in (1, 2)] == [3, 3]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("press.mcap new.mcap", 2, "new.mcap: expected a name that ends in .npz or .csv"),
        ("text.csv new.npz", 2, "text.csv is no .mcap: edge-sr replay text.csv --sink mcap:text.mcap makes one"),
        ("text new.npz", 2, "text: a recording ends in .csv, .npz or .mcap"),
        ("bag.mcap new.npz", 2, "bag.mcap is a folder, expected a recording"),
        ("press.mcap taken.npz", 5, "taken.npz exists: give another name, or delete it first"),
        ("press.mcap none/new.npz", 5, "cannot write none/new.npz: No such file"),
        ("text.mcap new.npz", 2, "text.mcap: not an MCAP file"),
        ("images.mcap new.npz", 2, "images.mcap: its maps are images, as of earlier releases"),
    ],
)
def test_what_cannot_be_converted_is_one_line_and_makes_nothing(words, code, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    record_into(Path("press.mcap"), make_results([make_scan(press_counts=3000)]))
    messages_alone(Path("press.mcap"), Path("images.mcap"), kinds={GRID.name: IMAGE.name})
    for name in ("text.mcap", "taken.npz"):
        Path(name).write_text("text")
    Path("bag.mcap").mkdir()
    before = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert convert(*words.split()) == code
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == before


def test_a_full_disk_and_ctrl_c_leave_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scans = [make_scan(number, press_counts=3000, noise=number) for number in range(300)]
    record_into(tmp_path / "press.mcap", make_results(scans))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for new in ("new.npz", "new.csv"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        try:
            assert convert("press.mcap", new) == 5
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        out, err = capsys.readouterr()
        assert out == "" and f"cannot write {new}: File too large" in err
        assert [path.name for path in tmp_path.iterdir()] == ["press.mcap"]
    command = [sys.executable, "-m", "edge", "convert", "press.mcap", "new.npz"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while not any(path.stat().st_size for path in tmp_path.glob(".new.npz.*/new.npz")) and process.poll() is None:
            time.sleep(0.001)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (-signal.SIGINT, b"", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["press.mcap"]
