"""Report of the checks: verdicts on wrong patterns, faults of sensors, foreign taps, and the page in miniature."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import FakeModel, make_pad_contract, write_model
from experiment_samples import quick_bench, save_recordings, tables_of
from trust_samples import FOREIGN_TAXEL, make_trusted_contract

from edge.inference.contract import ANY_BATCH
from train.data.frozen_presses import load_frozen_presses
from train.errors import CheckpointError
from train.experiments import trust_checks
from train.experiments.__main__ import run
from train.experiments.sensor_faults import FAULTS
from train.families.family_shares import SHARES


def press(z=3000.0, x=0.0):
    counts = np.zeros((3, 4, 4), dtype=np.float32)
    counts[2].flat[FOREIGN_TAXEL] = z
    counts[0, 0, 0] = x
    return counts


@pytest.fixture(scope="module")
def wide():
    return load_frozen_presses().pick(np.arange(60))


class TestVerdicts:
    def test_suspicion_is_counted_after_contacts_that_have_ended(self):
        model = FakeModel(make_trusted_contract())
        odd = np.stack([press(x=9000)] * trust_checks.CONTACTS)
        good = np.stack([press()] * trust_checks.CONTACTS)
        found = trust_checks.verdicts_on(model, [odd, good], [None, None])
        assert (found["contacts"], found["too light"]) == (2 * trust_checks.CONTACTS, 0)
        assert str(found["flagged %"]).startswith("50.0")
        assert (found["unfamiliar %"], found["unexplained %"]) == (50, 0)
        after = [float(str(found[f"sensor, after {number} %"]).split()[0]) for number in trust_checks.AFTER]
        assert after == [0, 50, 50, 50]

    def test_what_begins_no_contact_counts_nowhere(self):
        found = trust_checks.verdicts_on(FakeModel(make_trusted_contract()), [np.stack([press(z=500)] * 4)], [None])
        assert found == {"contacts": 0}

    def test_a_share_of_none_has_an_interval_too(self):
        assert trust_checks.share(np.zeros(100, dtype=bool)) == "0.0 (0.0..3.6)"
        assert trust_checks.share(np.ones(100, dtype=bool)) == "100.0 (96.4..100.0)"
        assert trust_checks.share(np.zeros(100, dtype=bool), np.zeros(100, dtype=int)) == "0.0 (0.0..97.5)"


def test_patterns_that_are_off_are_counted_by_how_far(wide):
    """The fake model's patterns are in no relation to the truth: what counts is who is counted where."""
    found = trust_checks.judged(FakeModel(make_trusted_contract()), wide, [None] * len(wide))
    assert len(found.off) and np.isfinite(found.off).all() and (found.off > 1).all()
    cells = found.cells(np.ones(len(found.off), dtype=bool))
    assert cells["contacts"] == cells["> 50% off"] == cells["> 100% off"] == len(found.off)
    assert cells["of those < 30% off, not believed %"] is None


class TestTaps:
    def test_right_windows_are_kept_and_foreign_ones_dropped(self):
        posed = {"batch": ANY_BATCH, "takes_poses": True, "reach_mm": 10.0, "unposed_taps": 4}
        model = FakeModel(make_trusted_contract(output_full_scale=0.5, **posed))
        elsewhere = np.roll(press(), 2, axis=-1)
        right, wrong = (np.stack([press(), *[one] * 3])[None] for one in (press(), elsewhere))
        truth = np.zeros((1, 40, 40), dtype=np.float32)
        right_db, used, foreign = trust_checks.guarded(model, right, truth, 4)
        assert (used.tolist(), foreign.tolist()) == ([4], [[False] * 3])
        wrong_db, used, foreign = trust_checks.guarded(model, wrong, truth, 4)
        assert (used.tolist(), foreign.tolist()) == ([1], [[True] * 3])
        alone_db, _, _ = trust_checks.guarded(model, wrong, truth, 1)
        assert alone_db == pytest.approx(wrong_db, abs=0.05) and right_db != wrong_db


class TestPage:
    def test_it_runs_in_miniature(self, tmp_path, tmp_path_factory, monkeypatch):
        save_recordings(tmp_path / "recordings")
        monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "recordings"))
        page = run("trust-checks", quick_bench(tmp_path_factory), tmp_path)
        families, _, grips, faults, taps = tables_of(page)
        assert page.read_text().startswith("# trust-checks\n") and "quick run" in page.read_text()
        assert [row["contacts of"] for row in families] == [*SHARES, "all", "light"]
        assert any(float(row["stsr-int8 %"]) > 0 for row in grips), "noise is no grip"
        assert {"no fault", "another pad's file", *FAULTS} <= {row["fault"] for row in faults}
        cases = ["right", "another surface", "order reversed", "turned the other way", "not turned"]
        assert [row["earlier taps"] for row in taps] == cases

    def test_a_model_without_checks_is_refused_in_a_line(self, tmp_path, tmp_path_factory):
        for name in ("stsr", "stsr-small", "mtsr"):
            write_model(tmp_path / f"{name}-int8.onnx", make_pad_contract(taps=1))
        with pytest.raises(CheckpointError, match="stsr-int8 has no checks"):
            run("trust-checks", replace(quick_bench(tmp_path_factory), models=tmp_path), tmp_path)
