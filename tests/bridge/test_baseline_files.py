"""Files of baselines: saved, loaded, written by hand and refused."""

import json

import numpy as np
import pytest
from edge_samples import BASELINE, REST
from hostile_samples import one_line

from firmware_bridge.errors import RecordingError
from firmware_bridge.zeroing.baseline import LAST_UNIX_S, Baseline, load_baselines, save_baselines


def made(counts: np.ndarray = REST, sensor: str = "4", created_unix_s: float = 1_000.0) -> Baseline:
    return Baseline.of(sensor, counts, created_unix_s, 100, "start-up")


def with_cell(cell: object) -> list:
    counts: list = REST.tolist()
    counts[1][2][3] = cell
    return counts


def test_the_id_stands_for_sensor_counts_and_time():
    others = [made(sensor="6"), made(REST + 1), made(created_unix_s=1_001.0)]
    assert len({BASELINE.id, *(other.id for other in others)}) == 4
    assert made().id == BASELINE.id == "d148ecd3"


def test_saved_baselines_come_back(tmp_path):
    path = tmp_path / "zero.json"
    saved = [made(), made(REST + 0.5, "6", 123.456), made(sensor="8", created_unix_s=float("nan"))]
    path.write_text("old")
    save_baselines(str(path), saved)
    loaded = load_baselines(str(path))
    assert list(loaded) == ["4", "6", "8"]
    for baseline, got in zip(saved, loaded.values(), strict=True):
        assert (got.counts == baseline.counts).all() and (got.id, got.scans) == (baseline.id, 100)
        np.testing.assert_equal(got.created_unix_s, baseline.created_unix_s)
        assert got.origin == "file"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["zero.json", "zero.json.bak"]
    assert (tmp_path / "zero.json.bak").read_text() == "old"
    with pytest.raises(ValueError, match="each sensor once"):
        save_baselines(path, [made(), made()])


def test_a_baseline_of_another_order_of_taxels_is_refused(tmp_path):
    orders = {"4": tuple(reversed(range(16)))}
    save_baselines(tmp_path / "zero.json", [made()], orders)
    assert list(load_baselines(tmp_path / "zero.json", orders)) == ["4"]
    with pytest.raises(RecordingError, match="the taxels of sensor 4 lay in another order"):
        load_baselines(tmp_path / "zero.json")


@pytest.mark.parametrize(
    ("cell", "created_unix_s", "scans"),
    [(16_000, 1_790_000_000, 100), (0, LAST_UNIX_S, 1), (65_535.9, 1e-6, 2**31 - 1)],
)
def test_a_baseline_written_by_hand_as_the_docs_say_needs_no_id(tmp_path, cell, created_unix_s, scans):
    path = tmp_path / "zero.json"
    entry = {"sensor": "4", "created_unix_s": created_unix_s, "scans": scans, "counts": with_cell(cell)}
    path.write_text(json.dumps({"format": "tactile-baseline", "version": 1, "baselines": [entry]}))
    baseline = load_baselines(path)["4"]
    assert baseline.counts[1, 2, 3] == np.float32(cell) and (baseline.created_unix_s, baseline.scans) == (
        created_unix_s,
        scans,
    )


def test_saving_where_nothing_can_be_written(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "no" / "zero.json", tmp_path / "folder"):
        with pytest.raises(RecordingError, match=rf"{path.name}: cannot be written: "):
            save_baselines(path, [made()])
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"format": "other"}, "'format': \"other\", expected 'tactile-baseline'"),
        ({"version": 2}, "'version': 2, expected 1"),
        ({"baselines": []}, "'baselines'"),
        ({"baselines": {}}, "'baselines'"),
        ({"baselines": [{}, 1]}, r"'baselines': \[{}, 1\], expected a list of at least one object"),
        ({"sensor": ""}, "'sensor'"),
        ({"sensor": 4}, "'sensor'"),
        ({"sensor": "4\x1b[2J"}, "'sensor'"),
        ({"sensor": "x" * 65}, "'sensor'"),
        ({"created_unix_s": 0}, "'created_unix_s'"),
        ({"created_unix_s": True}, "'created_unix_s'"),
        ({"created_unix_s": "5"}, "'created_unix_s'"),
        ({"created_unix_s": float("inf")}, "'created_unix_s'"),
        ({"created_unix_s": 10**400}, "'created_unix_s'"),
        ({"created_unix_s": 1e300}, "'created_unix_s'"),
        ({"scans": 0}, "'scans'"),
        ({"scans": 1.0}, "'scans'"),
        ({"scans": 2**31}, "'scans'"),
        ({"counts": None}, "'counts': null"),
        ({"counts": [[[]], [[]], [[]]]}, "'counts'"),
        ({"counts": REST.tolist()[:2]}, "'counts'"),
        ({"counts": REST.ravel().tolist()}, "'counts'"),
        ({"counts": [REST.tolist()] * 3}, "'counts'"),
        ({"counts": [[[1, 2], [3]], [[4]], [[5]]]}, "'counts'"),
        ({"counts": with_cell(65_536)}, "'counts'"),
        ({"counts": with_cell(-1)}, "'counts'"),
        ({"counts": with_cell(10**400)}, "'counts'"),
        ({"counts": with_cell(float("nan"))}, "'counts'"),
        ({"counts": with_cell("1")}, "'counts'"),
        ({"counts": with_cell(False)}, "'counts'"),
        ({"counts": with_cell(16_000)}, "'id': .*the file was changed"),
        ({"id": "00000000"}, "'id': '00000000'"),
        ({"id": None}, "'id': None"),
    ],
)
def test_files_that_are_none(tmp_path, changes, match):
    path = tmp_path / "zero.json"
    save_baselines(path, [made()])
    document = json.loads(path.read_text())
    (document if changes.keys() <= document.keys() else document["baselines"][0]).update(changes)
    path.write_text(json.dumps(document))
    with pytest.raises(RecordingError, match=rf"zero\.json.*{match}.*zero again") as refused:
        load_baselines(path)
    assert one_line(refused)


def test_a_sensor_twice(tmp_path):
    path = tmp_path / "zero.json"
    save_baselines(path, [made()])
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"baselines": document["baselines"] * 2}))
    with pytest.raises(RecordingError, match=r"'sensor': '4', expected each sensor once.*zero again"):
        load_baselines(path)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[1]", b"null", b"NaN", b'"', b"1" * 10_000, b"\xff", b"[" * 100_000, b'{"a":' * 100_000, None]
)
def test_files_that_are_no_json_or_not_there(tmp_path, text):
    path = tmp_path / "zero.json"
    if text is not None:
        path.write_bytes(text)
    words = r"zero\.json: cannot be read: No such" if text is None else r"zero\.json"
    with pytest.raises(RecordingError, match=words) as refused:
        load_baselines(path)
    assert one_line(refused)


def test_a_file_of_a_mebibyte_is_read_and_a_larger_one_is_not(tmp_path):
    path = tmp_path / "zero.json"
    save_baselines(path, [BASELINE])
    path.write_text(path.read_text().ljust(1 << 20))
    assert list(load_baselines(path)) == ["4"]
    path.write_text(path.read_text() + " ")
    with pytest.raises(RecordingError, match="larger than"):
        load_baselines(path)
