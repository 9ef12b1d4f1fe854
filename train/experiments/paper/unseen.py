"""Fig. 16: surfaces that were not trained on, and the gain and cost of random figures in the training.

Three of the 18 surfaces are held out; tested glyphs and polygons are of another seed than the trained ones. All
networks are identical; the training set differs. All figures make as many windows as all surfaces do, so training on
surfaces alone runs once for as long and once for as many windows of the surfaces. Figures reduce the accuracy on seen
surfaces, so one network sees fewer of them.

Source: Wu and Liu 2024, Fig. 16 and Sec. VI-C.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet
from edge.terminal.progress_bar import tracked
from train.data.presses import PressSet, join_presses
from train.experiments.paper.protocol import HELD_OUT, KNOWN, SETS, intervals, presses
from train.experiments.support.workbench import Workbench, cost_cells, error_cells
from train.fit import given_taps
from train.learning.checkpoint import Training
from train.learning.training_loop import Recipe
from train.networks.blocks import PatternNet
from train.report import Report, Row, bootstrap_interval, with_interval

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
_SHOWN_OF: Final = {_NEW: 3, _GLYPHS: 2, _POLYGONS: 1}


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one network on one frozen set: (n,) PSNR in [dB], tap of each frame, mean width in [%]."""

    psnr_db: NDArray[np.float64]
    tap: NDArray[np.integer]
    width_percent: float


_Scores = dict[tuple[str, str, int], Score]
"""Scores by training set, test set and number of taps."""


def run(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate them, and write the report `unseen`."""
    tests = test_sets(bench)
    nets = _networks(bench)
    rows: list[Row] = []
    scores: _Scores = {}
    for trained, (net, made) in tracked(nets.items(), "judging", "network"):
        cost = cost_cells(net) | bench.training_cells(made)
        for tested, frozen in tests.items():
            for given in GIVEN:
                found = intervals(net, frozen, given)
                figures = judge(found.pattern, frozen, made["contact_level"])
                scores[trained, tested, given] = Score(
                    figures["psnr_db"], frozen.tap, float(found.width_percent().mean())
                )
                name: Row = {"trained on": trained, "tested on": tested, "taps": given}
                rows.append(name | error_cells(figures, frozen, "test") | found.cells() | cost)

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
    _plot_shapes(report, nets, tests)
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


def verdict_rows(scores: Mapping[tuple[str, str, int], Score], given: int, mixed: str, alone: str) -> list[Row]:
    """Return the PSNR change by random figures on each test set, against surfaces alone, with its bound."""
    rows: list[Row] = []
    for tested in (*_UNSEEN, _ALL_UNSEEN, _OLD):
        lift_db, tap = _lift_db(scores, tested, given, mixed, alone)
        wider = float(np.mean([scores[mixed, one, given].width_percent for one in _parts(tested)]))
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


def _lift_db(
    scores: Mapping[tuple[str, str, int], Score], tested: str, given: int, mixed: str, alone: str
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Return the PSNR change of every frame, and each frame's tap; taps of all unseen surfaces are numbered apart."""
    lifts, taps, first = [], [], 0
    for kind in _parts(tested):
        lifts.append(scores[mixed, kind, given].psnr_db - scores[alone, kind, given].psnr_db)
        taps.append(scores[alone, kind, given].tap + first)
        first += int(taps[-1].max()) + 1
    return np.concatenate(lifts), np.concatenate(taps)


def _networks(bench: Workbench) -> dict[str, tuple[PatternNet, dict[str, Any]]]:
    known, every = bench.frozen("validation", KNOWN), bench.frozen("validation")
    nets = {}
    for trained, data in training_sets(bench).items():
        training = TRAININGS[trained]
        nets[trained] = bench.network(training, data, every if training == BASE else known)
    return nets


def _plot_errors(report: Report, scores: _Scores) -> None:
    trained_on = list(dict.fromkeys(trained for trained, _, _ in scores))
    tested_on = list(dict.fromkeys(tested for _, tested, _ in scores))
    with report.figure(size=(9, 4.5)) as figure:
        axes = figure.subplots()
        for number, trained in enumerate(trained_on):
            for given in GIVEN:
                mine = [scores[trained, tested, given] for tested in tested_on]
                means = np.array([score.psnr_db.mean() for score in mine])
                bounds = np.array([bootstrap_interval(score.psnr_db, score.tap) for score in mine]).T
                axes.errorbar(
                    np.arange(len(tested_on)) + 0.12 * (number - (len(trained_on) - 1) / 2) + 0.03 * (given > 1),
                    means,
                    yerr=np.abs(bounds - means),
                    fmt="o" if given > 1 else "_",
                    color=f"C{number}",
                    label=f"{trained}, {given} tap{'s' * (given > 1)}",
                    capsize=2,
                )
        axes.set(xticks=range(len(tested_on)), xticklabels=tested_on, xlabel="tested on", ylabel="PSNR [dB]")
        axes.legend(title="trained on", fontsize=7, ncols=2)


def _plot_shapes(
    report: Report, nets: Mapping[str, tuple[PatternNet, dict[str, Any]]], tests: Mapping[str, FrozenSet]
) -> None:
    """Plot some surfaces that were not trained on, each at the end of its first tap."""
    columns: list[tuple[str, list[NDArray[np.float32]]]] = []
    for tested, most in _SHOWN_OF.items():
        frozen = tests[tested]
        names, first_tap = np.unique(frozen.surface, return_index=True)
        ends = [int(np.flatnonzero(frozen.tap == tap)[-1]) for tap in first_tap[:most]]
        alone, both = (intervals(nets[trained][0], frozen, GIVEN[-1]) for trained in (_ALONE, _BOTH))
        for name, end in zip(names[:most], ends, strict=True):
            maps = [alone.truth[end], alone.pattern[end], both.pattern[end], both.deviation[end]]
            columns.append((str(name).partition(":")[0], maps))
    titles = ("truth", f"trained on {_ALONE}", f"on {_BOTH}", "its deviation")
    with report.figure("shapes", size=(1.6 * len(columns), 6.6)) as figure:
        grid = figure.subplots(len(titles), len(columns), squeeze=False)
        for column, (name, maps) in enumerate(columns):
            grid[0, column].set_title(name, fontsize=8)
            for row, pattern in enumerate(maps):
                most_mm = float(maps[0].max()) * (0.3 if row == len(maps) - 1 else 1.0)
                grid[row, column].imshow(pattern, vmin=0, vmax=most_mm)
                grid[row, column].set(xticks=[], yticks=[])
        for row, title in enumerate(titles):
            grid[row, 0].set_ylabel(title, fontsize=8)
