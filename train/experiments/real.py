"""Real grips through the shipped runtime: coverage of a face over the whole pad, and prediction of a hidden taxel.

Their true patterns are unknown, but both fingers hold a flat face: a pattern should cover the pad, evenly and without a
hole. It should also explain the readings: each taxel in turn is silent, and its z is read off the pattern by one linear
operator, fitted on simulated presses. No reading of the recordings (TACTILE_RECORDINGS) goes into a report.

Source: Wu and Liu 2024, Eq. 7-8 (degradation).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_linear_map, fitted_methods
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, TAXELS_FILE, find_model
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.presses import load_presses
from train.data.real_grips import (
    has_hole,
    hidden_taxels,
    neighbours_mean,
    play,
    recorded_grips,
    recordings_folder,
    share_touched,
    unevenness,
    z_of,
)
from train.data.world import World, solve_pad
from train.experiments.workbench import Workbench
from train.freeze import drawn
from train.physics.gripped import SCALE
from train.report import Report, Row, bootstrap_interval


def real(bench: Workbench, report: Report) -> None:
    """Compare the default model with bilinear interpolation on real grips, in a minute or two."""
    grips = recorded_grips(recordings_folder())
    bench.use(TAXELS_FILE)
    model = ModelSession(bench.use(find_model(DEFAULT_MODEL)))
    if bench.quick:
        readings, truth = drawn(solve_pad(World(count=24, per_pad=24, seed=3), 0), 100)
    else:
        readings, truth = drawn(load_presses(bench.data_folder / "gripped.npz"), 8000)
    # The ridge that leaves the least of z on validation presses.
    operator = fit_linear_map(truth.reshape(len(truth), -1), z_of(readings), 0.1)

    played = [(grip, play(grip, model)) for grip in tracked(grips, "whole", "recording")]
    grips, whole = zip(*((grip, one) for grip, one in played if len(one.zeroed)), strict=True)
    z = [z_of(one.zeroed) for one in whole]
    hidden = [hidden_taxels(grip, model, operator) for grip in tracked(grips, "hidden", "recording")]
    bilinear = fitted_methods(bench.use(BUNDLE_DIR / "classical.npz"), SCALE)["bilinear"]
    neighbours = [neighbours_mean(one) for one in z]
    report.say(
        f"{sum(map(len, z))} scans of {len(whole)} recordings in which some taxel is pressed, z RMS "
        f"{np.sqrt(np.mean(np.concatenate(z) ** 2)):.0f} counts, through edge.perception.runtime with {model.name} and "
        "the baseline of the free pad; the pads are unknown, and nothing is fitted on real readings. Share: of the pad "
        "above half of the pattern's 95th percentile, wanted 0.9; std / mean: over the inner 80 %, wanted 0.25 at "
        "most; medians of scans. A hole: pixels below that level with others above it all round. Hidden taxel: RMS "
        "error of the z of a silent taxel, read off the pattern; for bilinear the mean of its neighbours. Intervals, "
        "95 %, are by trial and sensor."
    )
    rows: list[Row] = [
        {"method": model.name} | _cells([one.patterns for one in whole], hidden, z),
        {"method": "bilinear"} | _cells([bilinear(one.zeroed) for one in whole], neighbours, z),
    ]
    report.table(rows, "Over all trials and both fingers.")
    rows = [
        {"trial": grip.trial, "sensor": grip.free.sensor, "scans": len(one.zeroed)}
        | _cells([one.patterns], [estimates], [mine], interval=False)
        | {"bilinear, hidden taxel counts": _rms([around], [mine], interval=False)}
        for grip, one, estimates, around, mine in zip(grips, whole, hidden, neighbours, z, strict=True)
    ]
    report.table(rows, f"{model.name} by trial and sensor.")
    shown: list[tuple[str, NDArray[np.floating]]] = []
    for what, which in (("strongest", np.argmax), ("weakest", np.argmin)):
        for grip, one in zip(grips, whole, strict=True):
            name = f"{grip.trial.removeprefix('data_sample_')}\n{grip.free.sensor}, {what}"
            shown.append((name, one.patterns[which(one.zeroed[:, 2].sum(axis=(1, 2)))]))
    report.pictures(shown, 4, "Each recording's strongest and weakest scan under load.")


def _cells(
    patterns: Sequence[NDArray[np.floating]],
    hidden: Sequence[NDArray[np.floating]],
    z: Sequence[NDArray[np.floating]],
    *,
    interval: bool = True,
) -> Row:
    joined = np.concatenate(patterns)
    joined = joined[np.isfinite(joined).all(axis=(1, 2))]
    share, uneven = share_touched(joined), unevenness(joined)
    return {
        "share of the pad": round(float(np.median(share)), 3),
        "of the least tenth": round(float(np.quantile(share, 0.1)), 3),
        "std / mean": round(float(np.median(uneven)), 3),
        "with a hole %": round(100 * float(has_hole(joined).mean()), 1),
        "hidden taxel counts": _rms(hidden, z, interval=interval),
    }


def _rms(
    estimates: Sequence[NDArray[np.floating]], z: Sequence[NDArray[np.floating]], *, interval: bool
) -> str | float:
    """Return the RMS error in counts where predictions exist, with its interval by trial and sensor."""
    squares = [((one - true) ** 2).mean(axis=1) for one, true in zip(estimates, z, strict=True)]
    groups = np.repeat(np.arange(len(squares)), [len(part) for part in squares])
    joined = np.concatenate(squares)
    known = np.isfinite(joined)
    root = float(np.sqrt(joined[known].mean()))
    if not interval:
        return round(root, 0)
    low, high = np.sqrt(bootstrap_interval(joined[known], groups[known]))
    return f"{root:.0f} ({low:.0f}..{high:.0f})"
