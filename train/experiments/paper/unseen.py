"""Fig. 16: surfaces that were not trained on, and the gain and cost of random figures in the training.

Three of the 18 surfaces are held out; tested glyphs and polygons are of another seed than the trained ones. All
networks are identical; the training set differs. All figures make as many windows as all surfaces do, so training on
surfaces alone runs once for as long and once for as many windows of the surfaces. Figures reduce the accuracy on seen
surfaces, so one network sees fewer of them.

Source: Wu and Liu 2024, Fig. 16 and Sec. VI-C.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import judge
from edge.evaluation.test_set import FrozenSet
from edge.terminal.progress_bar import tracked
from train.data.presses import PressSet, join_presses
from train.experiments.paper.protocol import HELD_OUT, KNOWN, SETS, intervals, presses
from train.experiments.support.workbench import Method, Workbench, error_cells
from train.fit import given_taps
from train.learning.checkpoint import Training
from train.learning.training_loop import Recipe
from train.report import Report, Row, band, with_interval

TEST_SEED: Final = 999_000_000
TEST_FIGURES: Final = 24
GIVEN: Final = (1, 4)
LEAST_LIFT_DB: Final = 1.5
"""Least PSNR gain expected of random figures on surfaces that were not trained on, in [dB]."""
MOST_LOSS_DB: Final = 0.3
"""Largest PSNR loss accepted on the other surfaces, in [dB]."""

_ALONE, _ALONE_HALF, _ALL_BOTH = "15", "15, half as long", "18 + figures"
_FEW, _BOTH = "15 + 833 figures", "15 + figures"
_FEW_FIGURES: Final = 833
"""Number of figures that make a tenth of the windows."""
_PAIRS: Final = ((_FEW, _ALONE), (_BOTH, _ALONE), (_BOTH, _ALONE_HALF))
"""Pairs of training sets that are compared."""
_OLD, _NEW, _GLYPHS, _POLYGONS = "15 seen", "3 held out", "glyphs", "polygons"
_UNSEEN: Final = (_NEW, _GLYPHS, _POLYGONS)
_ALL_UNSEEN: Final = "all unseen"
BASE: Final = Training("unseen-all", "compact-mtsr4", Recipe(steps=16_000, given=given_taps(max(GIVEN)), bf16=True))
TRAININGS: Final[Mapping[str, Training]] = {
    _ALONE: replace(BASE, name="unseen-alone"),
    _ALONE_HALF: replace(BASE, name="unseen-alone-half", recipe=replace(BASE.recipe, steps=BASE.recipe.steps // 2)),
    _FEW: replace(BASE, name="unseen-few"),
    _BOTH: replace(BASE, name="unseen-both"),
    _ALL_BOTH: BASE,
}
"""Trainings by training set."""


class Score(NamedTuple):
    """Score of one network on one frozen set: (n,) PSNR in [dB], tap of each frame, mean width in [%]."""

    psnr_db: NDArray[np.float64]
    tap: NDArray[np.integer]
    width_percent: float


_Scores = Mapping[tuple[str, str, int], Score]
"""Scores by training set, test set and number of taps."""


def run(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate them, and write the report `unseen`."""
    tests = test_sets(bench)
    networks = _networks(bench)
    rows: list[Row] = []
    scores: dict[tuple[str, str, int], Score] = {}
    for trained, method in tracked(networks.items(), "judging", "network"):
        for (tested, frozen), given in product(tests.items(), GIVEN):
            found = intervals(method, frozen, given)
            figures = judge(found.pattern, frozen, method.contact_level)
            width_percent = float(found.width_percent().mean())
            scores[trained, tested, given] = Score(figures["psnr_db"], frozen.tap, width_percent)
            row: Row = {"trained on": trained, "tested on": tested, "taps": given}
            row |= error_cells(figures, frozen, "test") | found.cells()
            rows.append(row | method.cost | method.training)

    report = Report("unseen", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"Held out: {', '.join(HELD_OUT)}. Figures are random glyphs and polygons, {SETS['figures'].count} to train on "
        f"and {TEST_FIGURES} of each kind, of another seed, to test. All tests are made at the test position, though "
        f"pose errors bring some training taps near it. Every network is `{BASE.network}` at x{BASE.scale}, "
        f"{BASE.recipe.steps} steps (or half as many) of {BASE.recipe.batch} windows; contact levels and deviations "
        "are set on the 15 surfaces at the validation position (on the 18 for `18 + figures`)."
    )
    verdict = [row for given in GIVEN for pair in _PAIRS for row in verdict_rows(scores, given, *pair)]
    report.table(verdict, "What figures added to the 15 surfaces change, frame by frame.", "verdict")
    report.table(rows, "`covered` and `width` are of the 90 % interval, the width in % of the frame's indentation.")
    _plot_errors(report, scores)
    return report.write()


def test_sets(bench: Workbench) -> dict[str, FrozenSet]:
    """Return the test sets, by name."""
    numbers = range(TEST_SEED, TEST_SEED + TEST_FIGURES)
    glyphs, polygons = ([f"{kind}:{number}" for number in numbers] for kind in ("glyph", "polygon"))
    surfaces = {_OLD: KNOWN, _NEW: HELD_OUT, _GLYPHS: glyphs, _POLYGONS: polygons}
    return {name: bench.frozen("test", these) for name, these in surfaces.items()}


def training_sets(bench: Workbench) -> dict[str, PressSet]:
    """Return the training sets, by name; all but the last are without the held-out surfaces."""
    known, held_out, figures = (presses(bench, name).at_scale(BASE.scale) for name in SETS)
    few = figures.pick(np.arange(min(_FEW_FIGURES, len(figures))))  # both kinds alternate
    return {
        _ALONE: known,
        _ALONE_HALF: known,
        _FEW: join_presses([known, few]),
        _BOTH: join_presses([known, figures]),
        _ALL_BOTH: join_presses([known, held_out, figures]),
    }


def verdict_rows(scores: _Scores, given: int, mixed: str, alone: str) -> list[Row]:
    """Return the PSNR change by random figures on each test set, against surfaces alone, with its bound."""
    rows: list[Row] = []
    for tested in (*_UNSEEN, _ALL_UNSEEN, _OLD):
        pairs = [(scores[mixed, one, given], scores[alone, one, given]) for one in _parts(tested)]
        lift_db = np.concatenate([ours.psnr_db - theirs.psnr_db for ours, theirs in pairs])
        tap = np.concatenate([1000 * part + ours.tap.astype(int) for part, (ours, _) in enumerate(pairs)])
        wider = float(np.mean([ours.width_percent for ours, _ in pairs]))
        least_db = -MOST_LOSS_DB if tested == _OLD else LEAST_LIFT_DB
        rows.append(
            {
                "trained on": mixed,
                "against": alone,
                "taps": given,
                "tested on": tested,
                "PSNR change dB": with_interval(lift_db, tap),
                "at least dB": least_db,
                "met": "yes" if lift_db.mean() >= least_db else "no",
                "width over seen": round(wider / scores[mixed, _OLD, given].width_percent, 2),
            }
        )
    return rows


def _parts(tested: str) -> tuple[str, ...]:
    return _UNSEEN if tested == _ALL_UNSEEN else (tested,)


def _networks(bench: Workbench) -> dict[str, Method]:
    known, every = bench.frozen("validation", KNOWN), bench.frozen("validation")
    return {
        trained: bench.network(TRAININGS[trained], data, every if trained == _ALL_BOTH else known)
        for trained, data in training_sets(bench).items()
    }


def _plot_errors(report: Report, scores: _Scores) -> None:
    trained_on = list(dict.fromkeys(trained for trained, _, _ in scores))
    tested_on = list(dict.fromkeys(tested for _, tested, _ in scores))
    with report.figure(size=(9, 4.5)) as figure:
        axes = figure.subplots()
        for (number, trained), given in product(enumerate(trained_on), GIVEN):
            mean_db, around_db = band(scores[trained, tested, given][:2] for tested in tested_on)
            axes.errorbar(
                np.arange(len(tested_on)) + 0.12 * (number - (len(trained_on) - 1) / 2) + 0.03 * (given > 1),
                mean_db,
                yerr=around_db,
                fmt="o" if given > 1 else "_",
                color=f"C{number}",
                label=f"{trained}, {given} tap{'s' * (given > 1)}",
                capsize=2,
            )
        axes.set(xticks=range(len(tested_on)), xticklabels=tested_on, xlabel="tested on", ylabel="PSNR [dB]")
        axes.legend(title="trained on", fontsize=7, ncols=2)
