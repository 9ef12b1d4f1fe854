"""Error against severity: one nuisance at a time is weakened and strengthened, on the same clean test sequences."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil, inf, isinf
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge.terminal.progress_bar import tracked
from train.experiments.support.methods import Method, classical_methods, compact_methods
from train.experiments.support.sweeps import Sweep, all_sweeps, plain_set
from train.experiments.support.trainings import mixed
from train.experiments.support.workbench import Figures, Workbench
from train.report import Report, Row, bootstrap_interval, with_interval

_NETWORKS: Final = ("stsr", "mtsr4")
_CLASSICAL: Final = ("linear map", "bilinear")
_BOUND_DB: Final = 1.0
_COLUMNS: Final = 4

Curves = dict[str, dict[str, list[float]]]
"""PSNR in [dB] by severity, of every model, by nuisance."""


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `robust`; the full run takes about a quarter of an hour once the networks are there."""
    data = mixed(bench)
    methods = [*compact_methods(bench, data, _NETWORKS), *classical_methods(bench, data, _CLASSICAL)]
    plain = plain_set(bench)
    sweeps = all_sweeps(bench, plain)
    if bench.quick:
        sweeps = [replace(sweep, severities=_few(sweep)) for sweep in sweeps]
    reference = {method.name: method.figures(plain) for method in methods}

    rows: list[Row] = []
    curves: Curves = {}
    gains: dict[str, NDArray[np.float64]] = {}
    for sweep in tracked(sweeps, "nuisances", "sweep"):
        curve = curves[sweep.name] = {method.name: [] for method in methods}
        for severity in sweep.severities:
            frozen = sweep.frozen(severity)
            psnr_db: dict[str, NDArray[np.float64]] = {}
            for method in methods:
                found = method.figures(frozen)
                psnr_db[method.name] = found["psnr_db"]
                rows.append(_row(sweep, severity, method, found, reference[method.name], plain.tap))
                curve[method.name].append(float(found["psnr_db"].mean()))
            one, four = (psnr_db[name] for name in _NETWORKS)
            gains[f"{sweep.name} {_label(severity)} {sweep.unit}"] = four - one

    bounds = [_bound(sweep, method.name, curves[sweep.name][method.name]) for sweep in sweeps for method in methods]
    report = Report("robust", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{len(plain.surface)} taps at the held-out position, {len(plain)} frames, clean sequences the same "
        "everywhere; of the nuisances (train.physics.sensor_noise) one is changed, the others stay at their "
        "defaults, and every "
        "other draw stays as it is. Only other pose errors and angles need taps of their own: with other angles the "
        "newest tap is still the same one, with other pose errors it is not. Dead taxels are drawn, exactly so many on "
        "each tap's sensor; a lost scan leaves the one before it; taps of another surface are the oldest ones. "
        "`loss dB` is the PSNR lost against the defaults, frame by frame. stsr, linear map and bilinear see the newest "
        "tap alone."
    )
    for method in methods:
        report.say(_finding(method.name, float(reference[method.name]["psnr_db"].mean()), bounds))
    report.say(_against_one_tap(gains, plain.tap))
    report.table(rows, "Errors by nuisance and severity; PSNR and loss with 95 % intervals by tap.")
    report.table(
        bounds,
        f"What the strongest severity costs, and where the loss passes {_BOUND_DB:g} dB, interpolated between "
        "severities: - where it never does.",
        "bounds",
    )
    with report.figure(size=(14, 3.2 * ceil(len(sweeps) / _COLUMNS))) as figure:
        _draw(figure, sweeps, curves)
    return report.write()


def severity_of_loss(
    severities: Sequence[float], psnr_db: Sequence[float], default: int, loss_db: float
) -> float | None:
    """Return the severity from which the loss against index `default` exceeds `loss_db`; None if it never does.

    PSNR is interpolated linearly between severities.

    Args:
        severities: from the weakest to the strongest nuisance.
        psnr_db: PSNR at each of them, in [dB].
        default: index of the reference, where the search starts.
        loss_db: loss, in [dB].
    """
    level_db = psnr_db[default] - loss_db
    for i in range(default, len(severities) - 1):
        before_db, after_db = psnr_db[i], psnr_db[i + 1]
        if after_db < level_db:
            share = (before_db - level_db) / (before_db - after_db)
            return severities[i] + share * (severities[i + 1] - severities[i])
    return None


def _few(sweep: Sweep) -> tuple[float, ...]:
    return tuple(dict.fromkeys([sweep.default, sweep.severities[-1]]))


def _row(sweep: Sweep, severity: float, method: Method, found: Figures, reference: Figures, tap: NDArray) -> Row:
    marks = ["off"] * (severity in (0, inf)) + ["default"] * (severity == sweep.default)
    return {
        "nuisance": sweep.name,
        "severity": _label(severity),
        "unit": sweep.unit,
        "mark": ", ".join(marks) or None,
        "model": method.name,
        "PSNR dB": with_interval(found["psnr_db"], tap),
        "loss dB": with_interval(reference["psnr_db"] - found["psnr_db"], tap),
        "SSIM": round(float(found["ssim"].mean()), 4),
        "IoU": round(float(found["contact_iou"].mean()), 4),
        **method.cost,
    }


def _bound(sweep: Sweep, model: str, psnr_db: list[float]) -> Row:
    default = sweep.severities.index(sweep.default)
    bound = severity_of_loss(sweep.severities, psnr_db, default, _BOUND_DB)
    return {
        "nuisance": sweep.name,
        "model": model,
        "strongest": f"{_label(sweep.severities[-1])} {sweep.unit}",
        "loss dB": round(psnr_db[default] - psnr_db[-1], 2),
        f"{_BOUND_DB:g} dB lost at": bound,
    }


def _finding(model: str, psnr_db: float, bounds: list[Row]) -> str:
    """List the nuisances that cost a model most and least."""
    losses = sorted(
        (float(row["loss dB"] or 0), f"{row['nuisance']} {row['strongest']}") for row in bounds if row["model"] == model
    )
    least, most = (", ".join(f"{what} ({loss:.1f} dB)" for loss, what in part) for part in (losses[:3], losses[:-4:-1]))
    return (
        f"**{model}**: {psnr_db:.2f} dB at the defaults. Of the strongest severities most is lost to {most}; least to "
        f"{least}."
    )


def _against_one_tap(gains: Mapping[str, NDArray[np.float64]], tap: NDArray[np.integer]) -> str:
    """List the conditions where four taps are significantly better or worse than one."""
    one, four = _NETWORKS
    better, worse = [], []
    for place, gain_db in gains.items():
        low, high = bootstrap_interval(gain_db, tap)
        (better if low > 0 else worse if high < 0 else []).append(f"{place} ({gain_db.mean():+.2f} dB)")
    return (
        f"{four} against {one}, where the 95 % interval of the difference leaves out 0: better at "
        f"{'; '.join(better) or 'nothing'}; worse at {'; '.join(worse) or 'nothing'}; no significant difference at "
        f"the other {len(gains) - len(better) - len(worse)} of {len(gains)}."
    )


def _draw(figure: Figure, sweeps: list[Sweep], curves: Curves) -> None:
    """Plot each nuisance on a common scale; severities are evenly spaced, because each is about twice the last."""
    axes = figure.subplots(ceil(len(sweeps) / _COLUMNS), _COLUMNS, sharey=True, squeeze=False).ravel()
    for place, sweep in zip(axes, sweeps, strict=False):
        at = range(len(sweep.severities))
        for name, psnr_db in curves[sweep.name].items():
            place.plot(at, psnr_db, "o-", markersize=3, label=name)
        place.axvline(sweep.severities.index(sweep.default), color="0.6", linestyle=":")
        place.set_xticks(at, [_label(severity) for severity in sweep.severities])
        place.set(title=sweep.name, xlabel=sweep.unit)
    for place in axes[::_COLUMNS]:
        place.set_ylabel("PSNR [dB]")
    for place in axes[len(sweeps) :]:
        place.set_axis_off()
    axes[0].legend(fontsize="small")
    figure.suptitle("dotted: the default")


def _label(severity: float) -> str:
    return "off" if isinf(severity) else f"{severity:.3g}"
