"""Expected error and expected gain of another tap, as in the records, compared with the errors that occurred.

The tables in the bundled models' contracts were fitted at the validation position; here they are evaluated at the test
position, and outside the conditions of the fit: lighter taps, new shapes, a noisy sensor, a dead taxel.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import bundled_models
from edge.inference.contract import Contract
from edge.inference.expected_error import WORTH_A_TAP, expect_of
from edge.inference.onnx_session import ModelSession
from edge.perception.runtime import Model
from edge.terminal.progress_bar import tracked
from train.data.generation_config import SEED, random_figures
from train.errors import TrainError
from train.experiments.paper.unseen import TEST_FIGURES, TEST_SEED
from train.experiments.support.workbench import Workbench
from train.freeze import freeze
from train.learning.expected_error_table import doubts_and_errors
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval

PARTS: Final = 8
"""Number of bins with equally many frames, ordered by the expectation."""
_TEST: Final = "test"


@dataclass(frozen=True, slots=True)
class _Evaluated:
    """Frames of a set for one number of taps, (n,) each: expected and true RMS error in [mm], and expected gain."""

    tap: NDArray[np.integer]
    expected_mm: NDArray[np.float64]
    error_mm: NDArray[np.float64]
    gain: NDArray[np.float64] | None


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the expected errors of the bundled models, and write the report `confidence`."""
    models = [ModelSession(path) for path in (bundled_models()[:2] if bench.quick else bundled_models())]
    sets = _sets(bench)
    found = {
        (model.name, name, given): evaluated(model, given, frozen)
        for model in tracked(models, "judging", "model")
        for name, frozen in sets.items()
        for given in range(1, model.contract.taps + 1)
    }
    report = Report("confidence", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "`expected_rmse_mm` of a record against the RMS error that came out, over all pixels; error of the expectation "
        "is its mean absolute error as a share of the mean error. Intervals of the mean are by tap."
    )
    report.table(_reliability_rows(found), "Expected and true error, one tap given and all.")
    stops = [row for model in models if model.contract.taps > 1 for row in _stop_rows(model, sets, found)]
    report.table(
        stops,
        "Early stop: a pattern is made from one tap more each time that another was expected to take away "
        f"{WORTH_A_TAP:.0%} of the error, against all taps always. Here the same frame decides; the runtime goes by "
        "the tap before, and what it spares is in reports/bench.md.",
        "early-stop",
    )
    report.table(
        [row for model in models if model.contract.taps > 1 for row in _gain_rows(model.name, found)],
        "Share of the error that a second tap took away, by what was expected of it, on the test set.",
        "gain",
    )
    with report.figure(size=(11, 4.5)) as figure:
        axes = figure.subplots(1, 2)
        _plot_reliability(axes[0], models[-1].name, found)
        _plot_gain(axes[1], [model.name for model in models if model.contract.taps > 1], found)
    return report.write()


def _sets(bench: Workbench) -> dict[str, FrozenSet]:
    taps = bench.held_out("test")
    sets = {_TEST: bench.frozen("test")}
    if bench.quick:
        return sets
    return sets | {
        "test, 1 N": freeze(taps, Nuisances(), SEED, force_n=1.0),
        "unseen glyphs": bench.frozen("test", random_figures(TEST_FIGURES, 0, TEST_SEED)),
        "noise of 16 counts": freeze(taps, Nuisances(noise_counts=16.0), SEED),
        "one taxel in sixteen dead": bench.frozen("test", nuisances=Nuisances(dead_taxels=1 / 16)),
    }


def evaluated(model: Model, given: int, frozen: FrozenSet) -> _Evaluated:
    """Return expectations and errors of every frame, with the newest `given` taps."""
    about, error_mm, size_mm = doubts_and_errors(model, given, frozen)
    found = [
        expect_of(model.contract.confidence, given, *of) for of in zip(about.tolist(), size_mm.tolist(), strict=True)
    ]
    expectations = [expected for expected in found if expected is not None]
    if len(expectations) < len(found):
        raise TrainError(f"model '{model.name}' does not state the expected error of {given} taps: export it again")
    gains = [expected.gain for expected in expectations if expected.gain is not None]
    expected_mm = np.array([expected.rmse for expected in expectations])
    return _Evaluated(frozen.tap, expected_mm, error_mm, np.array(gains) if gains else None)


_Found = Mapping[tuple[str, str, int], _Evaluated]
"""Results by model, set and number of taps."""


def _reliability_rows(found: _Found) -> list[Row]:
    most = {model: max(given for name, _, given in found if name == model) for model, _, _ in found}
    return [
        {
            "model": model,
            "on": name,
            "taps": given,
            "expected um": with_interval(1e3 * seen.expected_mm, seen.tap, 1),
            "came out um": with_interval(1e3 * seen.error_mm, seen.tap, 1),
            "ratio": round(float(seen.expected_mm.mean() / seen.error_mm.mean()), 3),
            "correlation": round(float(np.corrcoef(seen.expected_mm, seen.error_mm)[0, 1]), 2),
            "off by %": round(100 * float(np.abs(seen.expected_mm - seen.error_mm).mean() / seen.error_mm.mean()), 1),
        }
        for (model, name, given), seen in found.items()
        if given in (1, most[model])
    ]


def _stop_rows(model: Model, sets: Mapping[str, FrozenSet], found: _Found) -> list[Row]:
    rows: list[Row] = []
    for name, frozen in sets.items():
        by_taps = [found[model.name, name, given] for given in range(1, model.contract.taps + 1)]
        used = taps_until_stop([seen.gain for seen in by_taps])
        errors_mm = np.stack([seen.error_mm for seen in by_taps])
        stopped_db, always_db = (_psnr(rmse_mm, model.contract) for rmse_mm in (_pick(errors_mm, used), errors_mm[-1]))
        rows.append(
            {
                "model": model.name,
                "on": name,
                "taps used": round(float(used.mean()), 2),
                "stopped at one %": round(100 * float((used == 1).mean()), 1),
                "PSNR dB": with_interval(stopped_db, frozen.tap),
                "lost to all taps dB": with_interval(always_db - stopped_db, frozen.tap),
                "lost by one tap always dB": with_interval(always_db - _psnr(errors_mm[0], model.contract), frozen.tap),
            }
        )
    return rows


def taps_until_stop(gains: list[NDArray[np.float64] | None]) -> NDArray[np.int64]:
    """Return the taps used in each frame, (n,), from the gains (n,) expected of another after 1, 2, ... taps.

    The gain after the last tap is None.
    """
    first = gains[0]
    if first is None:
        raise ValueError("a network of one tap has nothing to stop")
    used = np.ones(len(first), dtype=np.int64)
    for given, gain in enumerate(gains, start=1):
        if gain is not None:
            used[(used == given) & (gain >= WORTH_A_TAP)] = given + 1
    return used


def _pick(by_taps: NDArray[np.float64], used: NDArray[np.int64]) -> NDArray[np.float64]:
    return by_taps[used - 1, np.arange(len(used))]


def _psnr(rmse_mm: NDArray[np.float64], contract: Contract) -> NDArray[np.float64]:
    return 20 * np.log10(contract.output_full_scale / rmse_mm)


def _gain_rows(model: str, found: _Found) -> list[Row]:
    one, two = found[model, _TEST, 1], found[model, _TEST, 2]
    return [
        {
            "model": model,
            "expected %": round(100 * float(_gain(one)[part].mean()), 2),
            "came out %": round(100 * float(1 - two.error_mm[part].sum() / one.error_mm[part].sum()), 2),
            "frames": len(part),
        }
        for part in _parts(_gain(one))
    ]


def _gain(seen: _Evaluated) -> NDArray[np.float64]:
    return np.zeros(len(seen.tap)) if seen.gain is None else seen.gain


def _parts(values: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    return [part for part in np.array_split(np.argsort(values, kind="stable"), PARTS) if part.size]


def _plot_reliability(axes, model: str, found: _Found) -> None:
    for (name, tested, given), seen in found.items():
        if name == model and given == 1:
            parts = _parts(seen.expected_mm)
            expected = [1e3 * seen.expected_mm[part].mean() for part in parts]
            axes.plot(expected, [1e3 * seen.error_mm[part].mean() for part in parts], "o-", ms=3, label=tested)
    most = axes.get_xlim()[1]
    axes.plot([0, most], [0, most], "k:", lw=1)
    axes.set(xlabel="expected RMS error, um", ylabel="came out, um", title=f"{model}, one tap")
    axes.legend(fontsize=8)


def _plot_gain(axes, models: list[str], found: _Found) -> None:
    for model in models:
        rows = _gain_rows(model, found)
        axes.plot([row["expected %"] for row in rows], [row["came out %"] for row in rows], "o-", ms=3, label=model)
    low, high = axes.get_xlim()
    axes.plot([low, high], [low, high], "k:", lw=1)
    axes.axvline(100 * WORTH_A_TAP, color="grey", lw=0.8)
    axes.set(xlabel="gain expected of a second tap, %", ylabel="came out, %", title="on the test set")
    axes.legend(fontsize=8)
