"""Reports of the shipped models: on other pads, on real grips and of the checks, each in miniature, and their parts."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import FakeModel, make_pad_contract, write_model
from experiment_samples import grip, quick_bench, save_recordings, tables_of
from trust_samples import FOREIGN_TAXEL, make_trusted_contract

from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.errors import RecordingError
from train.data.frozen_presses import load_frozen_presses
from train.data.real_grips import has_hole, recorded_contacts, share_touched, unevenness
from train.errors import CheckpointError
from train.experiments.__main__ import run
from train.experiments.trust_checks import CONTACTS, FAULTS, judged, share, verdicts_on
from train.experiments.workbench import infer_presses
from train.families.catalogue import SHARES
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
    found, again = recorded_contacts(recordings), np.zeros(120, bool)
    again[10:30:10] = again[70:90:10] = again[90:] = True
    assert set(found) == {"xela_sensor1", "xela_sensor2"}
    np.testing.assert_array_equal(found["xela_sensor1"], np.concatenate([grip(False), grip(True)])[~again])
    (recordings / "trial-a" / "xela_sensor1.csv").write_text("nothing\n")
    with pytest.raises(RecordingError, match=r"trial-a/xela_sensor1\.csv, line 1"):
        recorded_contacts(recordings)


def test_measures_of_a_face_of_half_a_face_and_of_a_hole():
    face, half, hole = np.ones((3, 40, 40))
    half[:20] = 0
    hole[15:20, 15:20] = 0
    patterns = np.stack([face, half, hole])
    np.testing.assert_allclose(share_touched(patterns), [1, 0.5, 1 - 25 / 1600])
    np.testing.assert_allclose(unevenness(patterns)[:2], [0, 1])
    assert has_hole(patterns).tolist() == [False, False, True]


def test_the_report_compares_the_shipped_way_with_a_linear_one(recordings, tmp_path_factory):
    page = run("real", quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    methods, trials = tables_of(page)
    assert [row["method"] for row in methods] == [DEFAULT_MODEL, "bilinear"]
    assert all(0 < float(row["share of the pad"]) <= 1 for row in methods)
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
    assert page.startswith("# mine\n") and 'command = "python' in page
    assert page.index("What was done.") < page.index("All methods.\n\n| method | dB | extra |")
    assert "| a | 31.23 | - |\n| b | - | 2 |" in page


def press(z=3000.0, x=0.0):
    counts = np.zeros((3, 4, 4), dtype=np.float32)
    counts[2].flat[FOREIGN_TAXEL] = z
    counts[0, 0, 0] = x
    return counts


def test_suspicion_is_counted_after_contacts_that_have_ended():
    model = FakeModel(make_trusted_contract())
    odd, good, light = (np.stack([one] * CONTACTS) for one in (press(x=9000), press(), press(z=500)))
    found = verdicts_on(model, [odd, good], [None, None])
    assert found["contacts"] == 2 * CONTACTS
    assert str(found["flagged %"]).startswith("50.0") and str(found["sensor, after 10 %"]).startswith("50.0")
    assert (found["unfamiliar %"], found["unexplained %"]) == (50, 0)
    assert verdicts_on(model, [light], [None]) == {"contacts": 0}, "what begins no contact"


def test_a_share_of_none_has_an_interval_too():
    none = np.zeros(100, dtype=bool)
    assert (share(none), share(~none)) == ("0.0 (0.0..3.6)", "100.0 (96.4..100.0)")
    assert share(none, np.zeros(100, dtype=int)) == "0.0 (0.0..97.5)"


def test_patterns_that_are_off_are_counted_by_how_far():
    """The fake model's patterns are in no relation to the truth: what counts is who is counted where."""
    wide = load_frozen_presses().pick(np.arange(60))
    found = judged(FakeModel(make_trusted_contract()), wide, [None] * len(wide))
    assert len(found.off) and np.isfinite(found.off).all() and (found.off > 1).all()
    cells = found.cells(np.ones(len(found.off), dtype=bool))
    assert cells["contacts"] == cells["> 50% off"] == cells["> 100% off"] == len(found.off)
    assert cells["of those < 30% off, not believed %"] is None


def test_the_report_of_the_checks_is_made_in_miniature(recordings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports")
    families, _, grips, faults = tables_of(run("trust-checks", quick_bench(tmp_path_factory), folder))
    assert [row["contacts of"] for row in families] == [*SHARES, "all", "light"]
    assert any(float(row["stsr-int8 %"]) > 0 for row in grips), "noise is no grip"
    assert {"no fault", "another pad's file", *FAULTS} <= {row["fault"] for row in faults}
    for name in ("stsr", "mtsr"):
        write_model(folder / f"{name}-int8.onnx", make_pad_contract(taps=1))
    with pytest.raises(CheckpointError, match="stsr-int8 has no checks"):
        run("trust-checks", replace(quick_bench(tmp_path_factory), models=folder), folder)
