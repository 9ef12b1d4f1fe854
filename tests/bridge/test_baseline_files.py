"""Files of baselines: saved, loaded, written by hand and refused."""

import json
from pathlib import Path

import pytest
from baseline_samples import REST, made

from firmware_bridge.errors import RecordingError
from firmware_bridge.zeroing.baseline import (
    LAST_UNIX_S,
    load_baselines,
    save_baselines,
)


def test_the_id_stands_for_sensor_counts_and_time():
    one = made()
    assert len(one.id) == 8 and one.id == made().id
    others = [made(sensor="6"), made(REST + 1), made(created_unix_s=1_001.0)]
    assert len({one.id, *(other.id for other in others)}) == 4


def test_saved_baselines_come_back(tmp_path):
    path = tmp_path / "zero.json"
    saved = [made(), made(REST + 0.5, "6", 123.456)]
    path.write_text("old")
    save_baselines(str(path), saved)
    loaded = load_baselines(str(path))
    assert list(loaded) == ["4", "6"]
    for baseline, sensor in zip(saved, ("4", "6"), strict=True):
        got = loaded[sensor]
        assert (got.counts == baseline.counts).all() and got.counts.shape == (3, 4, 4)
        assert (got.id, got.created_unix_s, got.scans) == (baseline.id, baseline.created_unix_s, 100)
        assert got.origin == "file"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["zero.json", "zero.json.bak"]
    assert (tmp_path / "zero.json.bak").read_text() == "old"


def test_a_baseline_written_by_hand_as_the_docs_say_needs_no_id(tmp_path):
    path = tmp_path / "zero.json"
    entry = {"sensor": "4", "created_unix_s": 1_790_000_000, "scans": 100, "counts": [[[16_000] * 4] * 4] * 3}
    path.write_text(json.dumps({"format": "tactile-baseline", "version": 1, "baselines": [entry]}))
    baseline = load_baselines(path)["4"]
    assert (baseline.counts == 16_000).all() and len(baseline.id) == 8
    entry["counts"] = [[[16_001] * 4] * 4] * 3
    path.write_text(json.dumps({"format": "tactile-baseline", "version": 1, "baselines": [entry]}))
    assert load_baselines(path)["4"].id != baseline.id


def test_saving_each_sensor_once(tmp_path):
    with pytest.raises(ValueError, match="each sensor once"):
        save_baselines(tmp_path / "zero.json", [made(), made()])


def test_saving_where_nothing_can_be_written(tmp_path):
    with pytest.raises(RecordingError, match=r"zero\.json: cannot be written: No such file"):
        save_baselines(tmp_path / "no" / "zero.json", [made()])
    (tmp_path / "folder").mkdir()
    with pytest.raises(RecordingError, match="cannot be written"):
        save_baselines(tmp_path / "folder", [made()])
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


def document(tmp_path: Path) -> dict:
    save_baselines(tmp_path / "zero.json", [made()])
    return json.loads((tmp_path / "zero.json").read_text())


def refused(tmp_path: Path, changed: object, match: str) -> None:
    path = tmp_path / "zero.json"
    path.write_text(json.dumps(changed))
    with pytest.raises(RecordingError, match=rf"zero\.json.*{match}.*zero again"):
        load_baselines(path)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"format": "other"}, "'format': 'other', expected 'tactile-baseline'"),
        ({"version": 2}, "'version': 2, expected 1"),
        ({"baselines": []}, "'baselines'"),
        ({"baselines": {}}, "'baselines'"),
        ({"baselines": [1]}, "'baselines': 1, expected objects"),
    ],
)
def test_files_that_are_none(tmp_path, changes, match):
    refused(tmp_path, document(tmp_path) | changes, match)


def test_the_least_reading_and_the_last_second_are_lawful(tmp_path):
    path = tmp_path / "zero.json"
    content = document(tmp_path)
    content["baselines"][0] |= {"counts": with_cell(0), "created_unix_s": LAST_UNIX_S}
    del content["baselines"][0]["id"]
    path.write_text(json.dumps(content))
    baseline = load_baselines(path)["4"]
    assert baseline.counts.min() == 0 and baseline.created_unix_s == LAST_UNIX_S


def with_cell(cell: object) -> list:
    counts = REST.tolist()
    counts[1][2][3] = cell
    return counts


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"sensor": ""}, "'sensor'"),
        ({"sensor": 4}, "'sensor'"),
        ({"created_unix_s": 0}, "'created_unix_s'"),
        ({"created_unix_s": True}, "'created_unix_s'"),
        ({"created_unix_s": "5"}, "'created_unix_s'"),
        ({"created_unix_s": float("inf")}, "'created_unix_s'"),
        ({"scans": 0}, "'scans'"),
        ({"scans": 1.0}, "'scans'"),
        ({"counts": None}, "'counts': None"),
        ({"counts": []}, "'counts'"),
        ({"counts": [[[]], [[]], [[]]]}, "'counts'"),
        ({"counts": REST.tolist()[:2]}, r"'counts': 'shape \(2, 4, 4\)'"),
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
def test_entries_that_are_none(tmp_path, changes, match):
    changed = document(tmp_path)
    changed["baselines"][0] |= changes
    refused(tmp_path, changed, match)


def test_a_sensor_twice(tmp_path):
    changed = document(tmp_path)
    changed["baselines"] *= 2
    refused(tmp_path, changed, "'sensor': '4', expected each sensor once")


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b"null", b'"x"', b"\xff", b"[" * 100_000])
def test_files_that_are_no_json(tmp_path, text):
    path = tmp_path / "zero.json"
    path.write_bytes(text)
    with pytest.raises(RecordingError, match=r"zero\.json"):
        load_baselines(path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        load_baselines(tmp_path / "zero.json")
