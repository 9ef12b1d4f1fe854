import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.paper import tables


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return quick_bench(tmp_path_factory)


@pytest.fixture(scope="module")
def page(bench, tmp_path_factory):
    return tables.run_unseen(bench, tmp_path_factory.mktemp("reports"))


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.night
def test_training_sets_keep_to_their_names(bench):
    surfaces = {name: set(data.family.tolist()) for name, (_, data) in tables.training_sets(bench).items()}
    held_out = set(tables.HELD_OUT)
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
        (trained, tested, 4): tables.Score(alone + change, tap, 10.0)
        for trained, change in (("15", 0.0), ("15 + figures", lift_db))
        for tested in ("15 seen", "3 held out", "glyphs", "polygons")
    }
    rows = {row["tested on"]: row for row in tables.verdict_rows(scores, 4, "15 + figures", "15")}
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
