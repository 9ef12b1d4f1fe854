"""Experiments: each in miniature leaves a page with its tables; and parts of the reports of the shipped models."""

from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import write_recording
from edge_samples import FakeModel, make_pad_contract, write_model
from trust_samples import FOREIGN_TAXEL, make_trusted_contract

from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.errors import RecordingError
from train.data.frozen_presses import load_frozen_presses
from train.data.real_grips import has_hole, recorded_contacts, share_touched, unevenness
from train.errors import CheckpointError
from train.experiments.__main__ import main, run
from train.experiments.paper_tables import HELD_OUT, training_sets
from train.experiments.trust_checks import CONTACTS, FAULTS, judged, share, verdicts_on
from train.experiments.workbench import Workbench, infer_presses
from train.families.catalogue import SHARES
from train.report import Report, bootstrap_interval


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Workbench whose datasets and networks are made once."""
    folder = tmp_path_factory.mktemp("quick")
    return Workbench(folder / "data", folder / "checkpoints", quick=True)


REST = np.array([15_900, 16_430, 38_600])[:, None, None] + 11 * np.arange(16).reshape(4, 4)


def grip(released):
    """Counts above rest, (60, 3, 4, 4): every row another, one in ten sent again."""
    rng = np.random.default_rng(int(released))
    pressed = 900 + rng.integers(-300, 300, (60, 3, 4, 4))
    if released:
        pressed[30:] = 0
    pressed[10:30:10] = pressed[9:29:10]
    return pressed


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    """Two trials of two sensors: one grips all the time, the other lets go; its last rows are the rest level."""
    for trial, released in (("trial-a", False), ("trial-b", True)):
        (tmp_path / trial).mkdir()
        for sensor in ("sensor1", "sensor2"):
            write_recording(tmp_path / trial / f"xela_{sensor}.csv", REST + grip(released))
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path))
    return tmp_path


def tables_of(page):
    """Return the tables of a report, each as rows by column."""
    tables = []
    for part in page.read_text().split("\n\n"):
        if part.startswith("| "):
            columns, _, *rows = [line.strip("| \n").split(" | ") for line in part.splitlines()]
            tables.append([dict(zip(columns, row, strict=True)) for row in rows])
    return tables


# Number of tables of each experiment that needs no recordings.
TABLES = dict.fromkeys(("table3", "table4", "angle", "taps", "unseen", "pads", "nonnegative", "fig7"), 1)
TABLES |= {"families": 3, "posed-taps": 5, "second-world": 3, "blind-sensors": 2}


@pytest.mark.parametrize(
    "name", [name if name.startswith("fig") else pytest.param(name, marks=pytest.mark.night) for name in TABLES]
)
def test_it_runs_in_miniature(tmp_path, bench, name):
    page = run(name, bench, tmp_path)
    assert page.read_text().startswith(f"# {name}\n")
    tables = tables_of(page)
    assert len(tables) == TABLES[name] and all(len(rows[0]) > 1 for rows in tables)


@pytest.mark.night
def test_training_sets_keep_to_their_names(bench):
    sets = training_sets(bench)
    surfaces = {name: set(data.family.tolist()) for name, (_, data) in sets.items()}
    assert [name for name, there in surfaces.items() if there & set(HELD_OUT)] == ["18 + figures"]
    assert surfaces["15 + figures"] - surfaces["15"] == {"glyph", "polygon"}
    assert surfaces["18 + figures"] == surfaces["15 + figures"] | set(HELD_OUT)


def test_a_folder_without_recordings_is_named_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match=r"^experiments: .*TACTILE_RECORDINGS"):
        main(["real"])
    assert not (tmp_path / "data").exists()


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


def test_the_report_compares_the_shipped_way_with_a_linear_one(recordings, bench, tmp_path):
    page = run("real", bench, tmp_path / "reports")
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


def test_the_report_of_the_checks_is_made_in_miniature(recordings, bench, tmp_path):
    folder = tmp_path / "reports"
    families, _, grips, faults = tables_of(run("trust-checks", bench, folder))
    assert [row["contacts of"] for row in families] == [*SHARES, "all", "light"]
    assert any(float(row["stsr-int8 %"]) > 0 for row in grips), "noise is no grip"
    assert {"no fault", "another pad's file", *FAULTS} <= {row["fault"] for row in faults}
    for name in ("stsr", "mtsr"):
        write_model(folder / f"{name}-int8.onnx", make_pad_contract(taps=1))
    with pytest.raises(CheckpointError, match="stsr-int8 has no checks"):
        run("trust-checks", replace(bench, models=folder), folder)
