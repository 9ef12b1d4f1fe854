"""`edge-sr convert`: all that a recording holds is in the new file, and nothing is replaced, lost or left behind."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import ROOT, fake_source, make_scan
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_samples import SURE, TURNED, arrays_of, make_results, odd_scans, record_into, same_scan

from edge.api import PadPose, Result, Scan, TimedPose
from edge.cli import main as cli
from edge.perception.record_fields import MAPS
from edge.sinks.json_records import record
from edge.sinks.registry import open_sink
from edge.sinks.ros2.map_messages import image, recorded_map
from edge.sinks.ros2.messages import GRID, IMAGE
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.recording.formats import load_recording

OLD = Path(__file__).parent / "first_version"


def convert(*words: object) -> int:
    return cli.main(["convert", *map(str, words)])


def scans_of(path: Path) -> list[Scan]:
    with ReplayLink([path], paced=False) as link:
        scans = []
        while not link.ended:
            scans += link.read(0.0)
        return scans


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


def test_arrays_hold_scans_results_maps_baselines_and_poses(made):
    path, results = made
    arrays = arrays_of(path)
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


def test_each_key_of_a_record_is_an_array_or_named_as_left_out(made, capsys):
    path, results = made
    arrays = arrays_of(path)
    left_out = set(re.findall(r"\w+", capsys.readouterr().out.partition("not in it: ")[2]))
    table = (ROOT / "docs" / "recordings.md").read_text().partition("| `.mcap`, [`.npz`]")[2].partition("\n")[0]
    assert not left_out & arrays.keys()
    for name in record(results[-1], {}).keys() - arrays.keys() - {"poses"}:  # these of models that take them alone
        assert name in left_out and name in table


def test_an_earlier_releases_maps_as_images_are_converted_alike(made, tmp_path):
    path, _ = made
    with path.open("rb") as file, (tmp_path / "old.mcap").open("wb") as old:
        writer = Writer(old)
        writer.start("ros2")
        reader = make_reader(file)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        known = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            kind, definition, data = schema.name, schema.data, message.data
            if kind == GRID.name:
                data = image(recorded_map(kind, data), "emulated/4", message.log_time)
                kind, definition = IMAGE.name, IMAGE.definition.encode()
            if channel.topic not in known:
                number = writer.register_schema(kind, "ros2msg", definition)
                known[channel.topic] = writer.register_channel(channel.topic, "cdr", number, channel.metadata)
            writer.add_message(known[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    new, old = (arrays_of(one) for one in (path, tmp_path / "old.mcap"))
    assert new.keys() == old.keys() and new["pattern"].any() and new["deviation"].any()
    assert all((new[field.name] == old[field.name]).all() for field in MAPS if field.name in new)


def test_scans_poses_and_baselines_survive_the_way_out_and_back(made, tmp_path):
    path, _ = made
    before = load_recording(path)
    for name in ("1.npz", "2.mcap", "3.npz"):
        assert convert(path, tmp_path / name) == 0
        path = tmp_path / name
        after = load_recording(path)
        assert after.origin == "emulated" and dict(after.mountings) == dict(before.mountings) == {"4": TURNED}
        assert after.baselines.keys() == before.baselines.keys()
        for one, other in zip(before.baselines.values(), after.baselines.values(), strict=True):
            assert one.id == other.id and (one.counts == other.counts).all()
        for one, other in zip(before.tracks, after.tracks, strict=True):
            assert one.sensor == other.sensor
            assert (one.counts == other.counts).all() and (one.time_ns == other.time_ns).all()
        assert before.poses == after.poses != []


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


def test_a_csv_becomes_a_recording_at_its_rate(tmp_path):
    source = write_recording(tmp_path / "finger.csv", make_counts(6), rate_hz=None)
    new = tmp_path / "new.mcap"
    assert convert(source, new, "--rate-hz", 50) == 0
    scans = scans_of(new)
    assert [scan.time_ns for scan in scans] == [number * 20_000_000 for number in range(6)]
    assert all((scan.counts == counts).all() for scan, counts in zip(scans, make_counts(6), strict=True))


def test_files_of_version_0_1_are_read(tmp_path):
    """Its maps were in mm, and no channel stated that."""
    assert convert(OLD / "press.npz", tmp_path / "a.mcap") == 0
    assert convert(OLD / "press.mcap", tmp_path / "b.npz") == 0
    before, after = np.load(OLD / "press.npz"), np.load(tmp_path / "b.npz")
    np.testing.assert_allclose(after["pattern"], before["pattern"], atol=2e-7)
    assert before["has_pattern"].sum() == after["has_pattern"].sum() > 0
    assert ((after["baseline"] == "") == (before["baseline"] == "")).all() and len(set(after["baseline"])) == 2
    for one, other in zip(scans_of(OLD / "press.npz"), scans_of(tmp_path / "a.mcap"), strict=True):
        assert same_scan(other, one)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("press.mcap new.mcap", 2, "press.mcap and new.mcap have the same format"),
        (
            "text.npz new.csv",
            2,
            "text.npz becomes no .csv: edge-sr convert text.npz text.mcap; edge-sr convert text.mcap",
        ),
        ("bag new.mcap", 2, "bag is a folder, expected a recording"),
        ("press.mcap taken.npz", 5, "taken.npz exists: give another name, or delete it first"),
        ("press.mcap none/new.npz", 5, "cannot write none/new.npz: No such file"),
        ("text.mcap new.npz", 2, "text.mcap: not an MCAP file"),
        ("text.npz new.mcap", 2, "text.npz: not a whole .npz archive"),
        ("press.mcap new.npz --rate-hz 9", 2, "--rate-hz is for a .csv alone: press.mcap has times of its own"),
    ],
)
def test_what_cannot_be_converted_is_one_line_and_makes_nothing(words, code, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    record_into(Path("press.mcap"), make_results([make_scan()]))
    for name in ("text.mcap", "text.npz", "taken.npz"):
        Path(name).write_text("text")
    Path("bag").mkdir()
    before = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert convert(*words.split()) == code
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == before


RUN = """
import resource, signal, sys
from edge.cli import main as cli
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(cli.main(["convert", *sys.argv[2:]]))
"""


@pytest.mark.parametrize(
    ("source", "new"), [("press.mcap", "new.npz"), ("old.npz", "new.mcap"), ("press.mcap", "new.csv")]
)
def test_a_full_disk_leaves_nothing(source, new, tmp_path):
    scans = [make_scan(number, press_counts=3000, noise=number) for number in range(300)]
    record_into(tmp_path / "press.mcap", make_results(scans))
    arrays_of(tmp_path / "press.mcap")
    (tmp_path / "press.npz").rename(tmp_path / "old.npz")
    command = [sys.executable, "-B", "-c", RUN, "10000", source, new]  # bytecode would be cut off, too
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (5, "") and f"cannot write {new}: File too large" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.npz", "press.mcap"]


def test_ctrl_c_leaves_nothing(tmp_path):
    write_recording(tmp_path / "long.csv", np.tile(make_counts(100), (100, 1, 1, 1)), rate_hz=100)
    command = [sys.executable, "-c", RUN, str(10**9), "long.csv", "new.mcap"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while not list(tmp_path.glob(".new.mcap.*/new.mcap")) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, b"") and b"Traceback" not in err
    assert [path.name for path in tmp_path.glob("*new*")] == [] and not list(tmp_path.glob(".new*"))
