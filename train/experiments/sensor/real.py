"""Real grips through the shipped runtime: coverage of a face over the whole pad, and consistency with the readings.

Recordings go through edge.perception.runtime with the default model and the baseline of a free pad. Their true patterns
are unknown, but both fingers hold a flat face that covers the pad: a pattern should cover it, evenly and without a
hole. It should also explain the readings: it is degraded back to z by one linear operator, fitted on simulated presses,
with no taxel hidden and with each in turn, which is then silent like a broken one.

Recordings are read from TACTILE_RECORDINGS, or from next to the repository; no reading of theirs goes into a report,
patterns do.

Source: Wu and Liu 2024, Eq. 7-8 (degradation).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from edge.evaluation.classical_methods import fit_linear_map, fitted_methods
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, TAXELS, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.runtime import Runtime
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from train.data.generation_config import SEED
from train.data.press_batches import read_presses
from train.data.presses import PressSet, load_presses
from train.data.real_grips import (
    Grip,
    from_other_trials,
    linear_from_others,
    loaded,
    neighbours_mean,
    recorded_grips,
    recordings_folder,
    z_of,
)
from train.data.world import World, solve_pad
from train.experiments.support.workbench import Workbench
from train.freeze import SCALE, drawn
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, bootstrap_interval

_SCAN_NS: Final = 16_750_000
_TAXELS: Final = USPA44.taxel_count
_FITTED_ON: Final = 8000
_QUICK_FITTED_ON: Final = 100
_RIDGE: Final = 0.1
"""Ridge of the operator that leaves the least of z on validation presses."""
_TIMED_RUNS: Final = 200


@dataclass(frozen=True, slots=True)
class Played:
    """Output of the runtime for the scans of one grip that are under load.

    Attributes:
        zeroed: (n, 3, rows, cols) counts over the baseline, without a hidden taxel.
        patterns: (n, H, W) in [mm]; NaN where there was no pattern.
        run_time_us: (n,) of the inference, in [us].
    """

    zeroed: NDArray[np.float32]
    patterns: NDArray[np.float32]
    run_time_us: NDArray[np.floating]


def play(grip: Grip, model: ModelSession, hidden: int | None = None) -> Played:
    """Play a whole recording through a runtime that is set up as shipped, except that every scan is inferred.

    Args:
        grip: the recording.
        model: model of the runtime.
        hidden: taxel that is silent from the first scan on.
    """
    name = grip.free.sensor
    estimator = load_estimator(TAXELS, (USPA44.rows, USPA44.cols))
    runtime = Runtime(
        model,
        source="replay",
        estimator=estimator,
        baselines={name: grip.free},
        options=RuntimeOptions(every_scan=True),
    )
    series = ScanSeries(name, USPA44)
    none = np.full(model.contract.pattern_shape, np.nan, dtype=np.float32)
    patterns, times_us = [], []
    for number, raw in enumerate(grip.counts.astype(np.int32)):
        if hidden is not None:
            raw.reshape(3, -1)[:, hidden] = ABSENT
        result = runtime.push(series.close(raw, number * _SCAN_NS))
        patterns.append(none if result.pattern is None else result.pattern)
        times_us.append(result.run_time_us or np.nan)
    zeroed = (grip.counts - grip.free.counts).astype(np.float32)
    here = loaded(zeroed)
    return Played(zeroed[here], np.stack(patterns)[here], np.array(times_us)[here])


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
    """Write the report `real`; the full run takes a minute or two.

    Raises:
        DatasetError: there are no recordings, or no presses.
    """
    grips = recorded_grips(recordings_folder())
    bench.use(TAXELS)
    model = ModelSession(bench.use(find_model(DEFAULT_MODEL)))
    readings, truth = drawn(_presses(bench, "gripped"), _QUICK_FITTED_ON if bench.quick else _FITTED_ON)
    operator = fit_linear_map(truth.reshape(len(truth), -1), z_of(readings), _RIDGE)

    whole = [play(grip, model) for grip in tracked(grips, "whole", "recording")]
    grips = [grip for grip, one in zip(grips, whole, strict=True) if len(one.zeroed)]
    whole = [one for one in whole if len(one.zeroed)]
    z = [z_of(one.zeroed) for one in whole]
    degraded = [_degraded(one.patterns, operator) for one in whole]
    hidden = [np.full_like(one, np.nan) for one in z]
    for taxel in tracked(range(_TAXELS), "hidden", "taxel"):
        for grip, estimates in zip(grips, hidden, strict=True):
            estimates[:, taxel] = _degraded(play(grip, model, taxel).patterns, operator)[:, taxel]

    classical = fitted_methods(bench.use(BUNDLE_DIR / "classical.npz"), SCALE)
    methods = {
        model.name: (
            [one.patterns for one in whole],
            hidden,
            float(np.nanmedian(np.concatenate([one.run_time_us for one in whole]))),
        ),
        "bilinear": _classical(classical["bilinear"], whole, [neighbours_mean(one) for one in z]),
        "linear map": _classical(
            classical["linear map"], whole, [linear_from_others(z_of(readings), one) for one in z]
        ),
    }
    report = Report("real", folder, __file__, bench.used, quick=bench.quick)
    report.say(_method(whole, model.name))
    report.say(_unexplained(_presses(bench, "validation"), operator))
    rows: list[Row] = [
        {"method": name}
        | _cells(patterns, [_degraded(part, operator) for part in patterns], estimates, z)
        | {"run time us": round(us, 1)}
        for name, (patterns, estimates, us) in methods.items()
    ]
    trials = [grip.trial for grip in grips]
    if len(set(trials)) > 1:
        gained = _rms(_with_gains(grips, degraded, z), z)
        rows.append({"method": f"{model.name}, gains fitted on other trials", "self-consistency counts": gained})
        others = _rms(from_other_trials(trials, z), z)
        rows.append({"method": "linear map, fitted on other trials", "hidden taxel counts": others})
    report.table(rows, "Over all trials and both fingers.")
    report.table(
        [
            {"trial": grip.trial, "sensor": grip.free.sensor, "scans": len(one.zeroed)}
            | _cells([one.patterns], [back], [estimates], [mine], interval=False)
            | {"bilinear, hidden taxel counts": _rms([neighbours_mean(mine)], [mine], interval=False)}
            for grip, one, back, estimates, mine in zip(grips, whole, degraded, hidden, z, strict=True)
        ],
        f"{model.name} by trial and sensor.",
        "trials",
    )
    _draw(report, grips, whole)
    return report.write()


def _presses(bench: Workbench, name: str) -> PressSet:
    if bench.quick:
        return solve_pad(World(count=24, per_pad=24, seed=3), 0)
    return load_presses(bench.data_folder / f"{name}.npz")


def _degraded(patterns: NDArray[np.floating], operator: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return z readings (n, taxels) in counts."""
    return patterns.reshape(len(patterns), -1) @ operator


def _classical(
    method: Callable[[NDArray[np.floating]], NDArray[np.floating]],
    whole: Sequence[Played],
    hidden: list[NDArray[np.floating]],
) -> tuple[list[NDArray[np.floating]], list[NDArray[np.floating]], float]:
    scan = whole[0].zeroed[:1]
    times_us = []
    for _ in range(_TIMED_RUNS):
        started_ns = time.perf_counter_ns()
        method(scan)
        times_us.append((time.perf_counter_ns() - started_ns) / 1e3)
    return [method(one.zeroed) for one in whole], hidden, float(np.median(times_us))


def _cells(
    patterns: Sequence[NDArray[np.floating]],
    degraded: Sequence[NDArray[np.floating]],
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
        "self-consistency counts": _rms(degraded, z, interval=interval),
        "hidden taxel counts": _rms(hidden, z, interval=interval),
    }


def _rms(
    estimates: Sequence[NDArray[np.floating]], z: Sequence[NDArray[np.floating]], *, interval: bool = True
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


def _method(whole: Sequence[Played], model: str) -> str:
    scans = sum(len(one.zeroed) for one in whole)
    size = np.sqrt(np.mean(np.concatenate([z_of(one.zeroed) for one in whole]) ** 2))
    return (
        f"{scans} scans of {len(whole)} recordings in which some taxel is pressed, z RMS {size:.0f} counts, through "
        f"edge.perception.runtime with {model} and the baseline of the free pad; the pads are unknown, and "
        f"nothing is "
        "fitted on real readings but in the last two rows of the first table. Share: of the pad above half of the "
        "pattern's 95th percentile, wanted .9; std / mean: over the inner 80 %, wanted .25 at most; medians of scans. "
        "A hole: pixels below that level with others above it all round. Self-consistency: RMS error of z degraded "
        "back from the pattern. Hidden taxel: the same of a taxel that is silent, wanted 85 at most; for bilinear the "
        "mean of its neighbours, for the linear map least squares from the other fifteen z, fitted on simulated "
        "presses. Intervals, 95 %, are by trial and sensor."
    )


def _unexplained(presses: PressSet, operator: NDArray[np.floating]) -> str:
    read = z_of(read_presses(presses.with_taps(1), Nuisances(), SEED)[:, 0])
    left = read - _degraded(presses.patterns.astype(np.float32), operator)
    percent = 100 * np.mean(left**2) / np.mean(read**2)
    return (
        f"True patterns of {len(presses)} validation presses leave {percent:.0f} % of their z's energy unexplained by "
        "the operator: pads and gains differ, and are unknown."
    )


def _with_gains(
    grips: Sequence[Grip], degraded: Sequence[NDArray[np.floating]], z: Sequence[NDArray[np.floating]]
) -> list[NDArray[np.floating]]:
    """Return the degraded readings with gains for each taxel, fitted on the sensor's other trials."""
    mended = []
    for grip, back in zip(grips, degraded, strict=True):
        mine = [other.free.sensor == grip.free.sensor and other.trial != grip.trial for other in grips]
        estimates, true = (
            np.concatenate([part for part, yes in zip(parts, mine, strict=True) if yes]) for parts in (degraded, z)
        )
        known = np.isfinite(estimates).all(axis=1)
        mended.append(back * (true * estimates)[known].sum(axis=0) / (estimates**2)[known].sum(axis=0))
    return mended


def _draw(report: Report, grips: Sequence[Grip], whole: Sequence[Played]) -> None:
    trials, sensors = (list(dict.fromkeys(names)) for names in zip(*map(_names, grips), strict=True))
    strongest: Mapping[tuple[str, str], NDArray[np.float32]] = {
        _names(grip): one.patterns[one.zeroed[:, 2].sum(axis=(1, 2)).argmax()]
        for grip, one in zip(grips, whole, strict=True)
    }
    with report.figure(size=(2.4 * len(trials) + 1, 2.6 * len(sensors))) as figure:
        grid = figure.subplots(len(sensors), len(trials), squeeze=False)
        most = max(float(pattern.max()) for pattern in strongest.values())
        picture = None
        for place, axes in np.ndenumerate(grid):
            axes.axis("off")
            trial, sensor = trials[place[1]], sensors[place[0]]
            if (trial, sensor) in strongest:
                picture = axes.imshow(strongest[trial, sensor], vmin=0, vmax=most)
                axes.set_title(f"{trial.removeprefix('data_sample_')}\n{sensor}", fontsize=8)
        if picture is not None:
            figure.colorbar(picture, ax=grid, label="pattern [mm], strongest scan")


def _names(grip: Grip) -> tuple[str, str]:
    return grip.trial, grip.free.sensor
