"""Real grips through the shipped runtime: coverage of a face over the whole pad.

Their true patterns are unknown, but both fingers hold a flat face: a pattern should cover the pad, evenly and without a
hole. They are read from TACTILE_RECORDINGS; no reading of theirs goes into a report, patterns do.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fitted_methods
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, TAXELS, find_model
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.real_grips import has_hole, play, recorded_grips, recordings_folder, share_touched, unevenness
from train.experiments.workbench import Workbench
from train.physics.gripped import SCALE
from train.report import Report, Row


def real(bench: Workbench, report: Report) -> None:
    """Compare the default model with bilinear interpolation on real grips, in a minute or two."""
    grips = recorded_grips(recordings_folder())
    bench.use(TAXELS)
    model = ModelSession(bench.use(find_model(DEFAULT_MODEL)))
    bilinear = fitted_methods(bench.use(BUNDLE_DIR / "classical.npz"), SCALE)["bilinear"]
    played = [(grip, play(grip, model)) for grip in tracked(grips, "playing", "recording")]
    played = [(grip, one) for grip, one in played if len(one.zeroed)]
    z = np.concatenate([one.zeroed[:, 2].ravel() for _, one in played])
    report.say(
        f"{sum(len(one.zeroed) for _, one in played)} scans of {len(played)} recordings in which some taxel is pressed,"
        f" z RMS {np.sqrt(np.mean(z**2)):.0f} counts, through edge.perception.runtime with {model.name} and the "
        "baseline of the free pad; the pads are unknown, and nothing is fitted on real readings. Share: of the pad "
        "above half of the pattern's 95th percentile, wanted 0.9; std / mean: over the inner 80 %, wanted 0.25 at "
        "most; medians of scans. A hole: pixels below that level with others above it all round."
    )
    rows: list[Row] = [
        {"method": model.name} | _cells([one.patterns for _, one in played]),
        {"method": "bilinear"} | _cells([bilinear(one.zeroed) for _, one in played]),
    ]
    report.table(rows, "Over all trials and both fingers.")
    rows = [
        {"trial": grip.trial, "sensor": grip.free.sensor, "scans": len(one.zeroed)} | _cells([one.patterns])
        for grip, one in played
    ]
    report.table(rows, f"{model.name} by trial and sensor.")
    shown: list[tuple[str, NDArray[np.floating]]] = []
    for what, which in (("strongest", np.argmax), ("weakest", np.argmin)):
        for grip, one in played:
            name = f"{grip.trial.removeprefix('data_sample_')}\n{grip.free.sensor}, {what}"
            shown.append((name, one.patterns[which(one.zeroed[:, 2].sum(axis=(1, 2)))]))
    report.pictures(shown, 4, "Each recording's strongest and weakest scan under load.")


def _cells(patterns: Sequence[NDArray[np.floating]]) -> Row:
    joined = np.concatenate(patterns)
    joined = joined[np.isfinite(joined).all(axis=(1, 2))]
    share = share_touched(joined)
    return {
        "share of the pad": round(float(np.median(share)), 3),
        "of the least tenth": round(float(np.quantile(share, 0.1)), 3),
        "std / mean": round(float(np.median(unevenness(joined))), 3),
        "with a hole %": round(100 * float(has_hole(joined).mean()), 1),
    }
