import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from edge.evaluation.test_set import FrozenSet
from train.errors import CheckpointError
from train.experiments.paper import unseen
from train.experiments.paper.protocol import Intervals, intervals
from train.experiments.support.workbench import Method


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return quick_bench(tmp_path_factory)


@pytest.fixture(scope="module")
def page(bench, tmp_path_factory):
    return unseen.run(bench, tmp_path_factory.mktemp("reports"))


def frozen_of(truth_mm, indentation_mm):
    """A frozen set of as many taps as frames, with readings that are nothing."""
    count = len(truth_mm)
    return FrozenSet(
        newest=np.zeros((count, 3, 4, 4), np.int16),
        earlier=np.zeros((count, 3, 3, 4, 4), np.int16),
        tap=np.arange(count, dtype=np.int16),
        indentation_mm=indentation_mm.astype(np.float32),
        force_n=np.ones(count, np.float32),
        unit_patterns=(truth_mm / indentation_mm[:, None, None]).astype(np.float16),
        touched=truth_mm > 0,
        surface=np.array([f"surface {i}" for i in range(count)]),
        angle_deg=np.zeros(count, np.float32),
        full_scale_mm=0.5,
    )


def laplace_intervals(deviation_factor):
    """Return errors of a Laplace density of deviation 0.02 mm, predicted as `deviation_factor` times that."""
    rng = np.random.default_rng(0)
    truth, indentation_mm = np.zeros((8, 40, 40), np.float32), np.linspace(0.1, 0.4, 8)
    error = rng.laplace(scale=0.02 / np.sqrt(2), size=truth.shape).astype(np.float32)
    told = np.full(truth.shape, 0.02 * deviation_factor, np.float32)
    return Intervals(frozen_of(truth, indentation_mm), truth, truth + error, told)


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("factor", "level", "covered"), [(1, 0.3, 0.3), (1, 0.9, 0.9), (1, 0.99, 0.99), (0.5, 0.9, 1 - np.sqrt(0.1))]
)
def test_intervals_cover_what_the_density_says(factor, level, covered):
    """P(|e| <= w) = 1 - exp(-sqrt 2 w / sigma); at half the 90 % width that is 1 - sqrt(.1)."""
    found = laplace_intervals(factor)
    assert found.covered(level).mean() == pytest.approx(covered, abs=0.02)


def test_width_is_a_share_of_the_indentation():
    found = laplace_intervals(1)
    expected = 100 * 2 * 0.02 * np.log(10) / np.sqrt(2) / found.frozen.indentation_mm
    np.testing.assert_allclose(found.width_percent()[:, 7, 11], expected, rtol=1e-5)


def test_a_network_without_deviations_is_refused():
    truth = np.zeros((2, 40, 40))
    with pytest.raises(CheckpointError, match="no deviations"):
        intervals(Method("srcnn", 1, 0.5, lambda _: (truth, None)), frozen_of(truth, np.ones(2)))


@pytest.mark.night
def test_training_sets_keep_to_their_names(bench):
    surfaces = {name: set(data.family.tolist()) for name, data in unseen.training_sets(bench).items()}
    held_out = set(unseen.HELD_OUT)
    assert [name for name, there in surfaces.items() if there & held_out] == ["18 + figures"]
    assert surfaces["15, half as long"] == surfaces["15"]
    figures = surfaces["15 + figures"] - surfaces["15"]
    assert figures == {"glyph", "polygon"}
    assert surfaces["18 + figures"] == surfaces["15 + figures"] | held_out


@pytest.mark.parametrize(("lift_db", "met"), [(1.6, "yes"), (1.4, "no"), (-0.2, "no")])
def test_the_bound_is_on_the_mean_change_and_another_on_seen_surfaces(lift_db, met):
    tap = np.repeat(np.arange(5), 2)
    alone = np.random.default_rng(3).normal(30, 2, 10)
    scores = {
        (trained, tested, 4): unseen.Score(alone + change, tap, 10.0)
        for trained, change in (("15", 0.0), ("15 + figures", lift_db))
        for tested in ("15 seen", "3 held out", "glyphs", "polygons")
    }
    rows = {row["tested on"]: row for row in unseen.verdict_rows(scores, 4, "15 + figures", "15")}
    assert {row["met"] for tested, row in rows.items() if tested != "15 seen"} == {met}
    assert rows["all unseen"]["width over seen"] == 1.0
    assert rows["15 seen"]["met"] == ("yes" if lift_db >= -0.3 else "no")
    assert rows["all unseen"]["PSNR change dB"] == rows["glyphs"]["PSNR change dB"]
    # The networks see the same frames: the effect of a change that is the same everywhere is exact.
    assert rows["3 held out"]["PSNR change dB"] == f"{lift_db:.2f} ({lift_db:.2f}..{lift_db:.2f})"


@pytest.mark.night
def test_the_report_has_every_training_set_on_every_test_set(page):
    rows = rows_of(page.with_suffix(".csv"))
    assert len({(row["trained on"], row["tested on"], row["taps"]) for row in rows}) == len(rows) == 5 * 4 * 2
    assert {"test PSNR dB", "covered %", "width %", "parameters", "MMAC", "run time ms", "steps"} <= set(rows[0])
    assert len(rows_of(page.with_name("unseen-verdict.csv"))) == 30
    assert page.with_suffix(".png").stat().st_size > 10_000
