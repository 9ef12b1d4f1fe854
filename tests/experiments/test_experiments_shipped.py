"""Reports of the shipped models: parts of those on other pads, and the page on real grips in miniature."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_pad_contract, write_model
from experiment_samples import grip, quick_bench, save_recordings, tables_of

from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.taxel_health import HOLD_SCANS
from train.data.frozen_presses import load_frozen_presses
from train.data.real_grips import has_hole, play, recorded_grips, recorded_sets, share_touched, unevenness
from train.errors import DatasetError
from train.experiments.__main__ import run
from train.experiments.workbench import infer_presses
from train.report import Report, bootstrap_interval


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    save_recordings(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path))
    return tmp_path


def test_known_gains_and_pads_enter_the_model(tmp_path):
    contract = make_pad_contract(taps=1, output_full_scale=0.5, interval_factor=1.6, interval_levels={"90": [1.6] * 4})
    model = ModelSession(write_model(tmp_path / "stsr-int8.onnx", contract))
    few = load_frozen_presses().pick(np.arange(5))
    found = {known: infer_presses(model, few, known).patterns for known in (False, True)}
    scaled = [model.contract.scale_window(window) for window in few.windows(1, gains_known=True)]
    rows = [model.contract.pad_row(few.pad(index, gains=True)) for index in range(5)]
    by_hand = [model.run(one, row).copy() for one, row in zip(scaled, rows, strict=True)]
    assert found[True] == pytest.approx(np.stack(by_hand), rel=1e-5)
    assert not np.allclose(found[False], found[True])


def test_recordings_are_zeroed_by_the_trial_that_lets_go(recordings):
    sets = {(part.sensor, part.trial): part.counts for part in recorded_sets(recordings)}
    assert set(sets) == {(f"xela_sensor{n}", f"trial-{t}") for n in (1, 2) for t in "ab"}
    for trial, released in (("trial-a", False), ("trial-b", True)):
        kept = grip(released)
        again = np.zeros(len(kept), bool)
        again[10:30:10] = True
        if released:
            again[30:] = True
        np.testing.assert_array_equal(sets["xela_sensor1", trial], kept[~again])


def test_a_damaged_recording_is_named(recordings):
    (recordings / "trial-a" / "xela_sensor1.csv").write_text("nothing\n")
    with pytest.raises(DatasetError, match=r"trial-a/xela_sensor1\.csv, line 1"):
        recorded_sets(recordings)


def test_measures_of_a_face_of_half_a_face_and_of_a_hole():
    face, half, hole = np.ones((3, 40, 40))
    half[:20] = 0
    hole[15:20, 15:20] = 0
    patterns = np.stack([face, half, hole])
    np.testing.assert_allclose(share_touched(patterns), [1, 0.5, 1 - 25 / 1600])
    np.testing.assert_allclose(unevenness(patterns)[:2], [0, 1])
    assert has_hole(patterns).tolist() == [False, False, True]


def test_a_hidden_taxel_is_not_seen_whatever_it_reads(recordings):
    model = ModelSession(find_model(DEFAULT_MODEL))
    held = recorded_grips(recordings)[0]
    changed = held.counts.copy()
    changed[:, :, 1, 2] += 700
    other = replace(held, counts=changed)
    before, after = (play(one, model, hidden=6) for one in (held, other))
    assert np.isfinite(before.patterns[HOLD_SCANS:]).all() and len(before.believed) == len(before.patterns)
    np.testing.assert_array_equal(before.patterns, after.patterns)
    assert np.abs(play(held, model).patterns - play(other, model).patterns).max() > 0.01


def test_the_report_compares_the_shipped_way_with_a_linear_one(recordings, tmp_path_factory):
    page = run("real", quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    methods, trials = tables_of(page)
    assert [row["method"] for row in methods] == [DEFAULT_MODEL, "bilinear"]
    for row in methods:
        assert 0 < float(row["share of the pad"]) <= 1 and float(row["hidden taxel counts"].split()[0]) > 0
    assert [(row["trial"], row["sensor"]) for row in trials] == [
        (f"trial-{trial}", f"xela_sensor{sensor}") for sensor in (1, 2) for trial in "ab"
    ]
    assert str(recordings) not in page.read_text()


def test_frames_of_one_tap_are_not_independent():
    """Sixteen copies of each value tell no more than one: the interval is that of the taps, not of the frames."""
    values = np.random.default_rng(1).normal(30, 2, 72)
    alone = bootstrap_interval(values, np.arange(72))
    assert bootstrap_interval(np.repeat(values, 16), np.repeat(np.arange(72), 16)) == pytest.approx(alone)
    assert alone[1] - alone[0] == pytest.approx(2 * 1.96 * values.std() / np.sqrt(72), rel=0.1)
    assert alone[0] < values.mean() < alone[1]


def test_a_report_is_a_page_with_tables(tmp_path):
    report = Report("mine", tmp_path / "reports", __file__)
    report.say("What was done.")
    report.table([{"method": "a", "dB": 31.234567}, {"method": "b", "extra": 2}], "All methods.")
    page = report.write().read_text()
    assert page.startswith("# mine\n") and 'command = "python' in page and "quick run" not in page
    assert page.index("What was done.") < page.index("All methods.\n\n| method | dB | extra |")
    assert "| a | 31.23 | - |\n| b | - | 2 |" in page
    assert "quick run" in Report("mine", tmp_path, __file__, quick=True).write().read_text()
