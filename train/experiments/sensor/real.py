"""Real grips through the shipped runtime: coverage of a face over the whole pad, and prediction of a hidden taxel.

Recordings go through edge.perception.runtime with the default model and the baseline of a free pad. Their true patterns
are unknown, but both fingers hold a flat face that covers the pad: a pattern should cover it, evenly and without a
hole. It should also explain the readings: each taxel in turn is silent, like a broken one, and its z is read off the
pattern by one linear operator, fitted on simulated presses.

Recordings are read from TACTILE_RECORDINGS, or from next to the repository; no reading of theirs goes into a report,
patterns do.

Source: Wu and Liu 2024, Eq. 7-8 (degradation).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from edge.evaluation.classical_methods import fit_linear_map, fitted_methods
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, TAXELS, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Runtime
from edge.perception.taxel_health import load_estimator
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from train.data.presses import load_presses
from train.data.real_grips import Grip, loaded, neighbours_mean, recorded_grips, recordings_folder, z_of
from train.data.world import World, solve_pad
from train.experiments.workbench import Workbench
from train.freeze import SCALE, drawn
from train.report import Report, Row, bootstrap_interval

_TAXELS: Final = USPA44.taxel_count


class Played(NamedTuple):
    """Output of the runtime for the scans of one grip that are under load: zeroed counts without a hidden taxel.

    Patterns are (n, H, W) in [mm], NaN where there was none; believed (n,) unless any reason spoke against it.
    """

    zeroed: NDArray[np.float32]
    patterns: NDArray[np.float32]
    believed: NDArray[np.bool_]


def play(grip: Grip, model: ModelSession, hidden: int | None = None, pad: Pad | None = None) -> Played:
    """Play a whole recording through a runtime that is set up as shipped, except that every scan is inferred."""
    name = grip.free.sensor
    estimator = load_estimator(TAXELS, (USPA44.rows, USPA44.cols))
    options, free = RuntimeOptions(every_scan=True), {name: grip.free}
    runtime = Runtime(model, source="replay", estimator=estimator, baselines=free, pad=pad, options=options)
    series = ScanSeries(name, USPA44)
    none = np.full(model.contract.pattern_shape, np.nan, dtype=np.float32)
    patterns, believed = [], []
    for number, raw in enumerate(grip.counts.astype(np.int32)):
        if hidden is not None:
            raw.reshape(3, -1)[:, hidden] = ABSENT
        result = runtime.push(series.close(raw, number * 16_750_000))
        patterns.append(none if result.pattern is None else result.pattern)
        believed.append(result.trusted is not False)
    zeroed = (grip.counts - grip.free.counts).astype(np.float32)
    here = loaded(zeroed)
    return Played(zeroed[here], np.stack(patterns)[here], np.array(believed)[here])


def share_touched(patterns: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the share of the pad above half of the pattern's 95th percentile, (n,) of patterns (n, H, W)."""
    return _above_half(patterns).mean(axis=(1, 2))


def unevenness(patterns: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return standard deviation over mean in the inner 80 % of the pad, (n,) of patterns (n, H, W)."""
    rim = patterns.shape[1] // 10
    inner = patterns[:, rim:-rim, rim:-rim]
    return inner.std(axis=(1, 2)) / inner.mean(axis=(1, 2))


def has_hole(patterns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return True where pixels below half of the 95th percentile are enclosed, (n,) of patterns (n, H, W)."""
    return np.array([(binary_fill_holes(above) & ~above).any() for above in _above_half(patterns)], dtype=bool)


def _above_half(patterns: NDArray[np.floating]) -> NDArray[np.bool_]:
    return patterns > 0.5 * np.quantile(patterns, 0.95, axis=(1, 2), keepdims=True)


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `real`; the full run takes a minute or two."""
    grips = recorded_grips(recordings_folder())
    bench.use(TAXELS)
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
    hidden = [np.full_like(one, np.nan) for one in z]
    for taxel in tracked(range(_TAXELS), "hidden", "taxel"):
        for grip, estimates in zip(grips, hidden, strict=True):
            patterns = play(grip, model, taxel).patterns
            estimates[:, taxel] = patterns.reshape(len(patterns), -1) @ operator[:, taxel]
    bilinear = fitted_methods(bench.use(BUNDLE_DIR / "classical.npz"), SCALE)["bilinear"]
    neighbours = [neighbours_mean(one) for one in z]
    report = Report("real", folder, __file__, bench.used, quick=bench.quick)
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
    report.table(rows, f"{model.name} by trial and sensor.", "trials")
    _draw(report, grips, whole)
    return report.write()


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


def _draw(report: Report, grips: Sequence[Grip], whole: Sequence[Played]) -> None:
    names = [(grip.trial, grip.free.sensor) for grip in grips]
    trials, sensors = (list(dict.fromkeys(column)) for column in zip(*names, strict=True))
    strongest: Mapping[tuple[str, str], NDArray[np.float32]] = {
        name: one.patterns[one.zeroed[:, 2].sum(axis=(1, 2)).argmax()] for name, one in zip(names, whole, strict=True)
    }
    with report.figure(size=(2.4 * len(trials) + 1, 2.6 * len(sensors))) as figure:
        grid = figure.subplots(len(sensors), len(trials), squeeze=False)
        most = max(float(pattern.max()) for pattern in strongest.values())
        picture = None
        for place, axes in np.ndenumerate(grid):
            axes.axis("off")
            if (name := (trials[place[1]], sensors[place[0]])) in strongest:
                picture = axes.imshow(strongest[name], vmin=0, vmax=most)
                axes.set_title(f"{name[0].removeprefix('data_sample_')}\n{name[1]}", fontsize=8)
        if picture is not None:
            figure.colorbar(picture, ax=grid, label="pattern [mm], strongest scan")
