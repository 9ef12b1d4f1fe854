"""Error by contact force, small forces included.

PSNR is taken against one full scale for all, so it is highest for the shallowest patterns. The effect of the force on
shapes shows in the error relative to the truth's own RMS, and in SSIM with the truth's own peak as full scale.

Source: Wu and Liu 2024, Fig. 14.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import contact_iou, psnr_db, ssim
from edge.terminal.progress_bar import tracked
from train.data.paper_taps import PaperTaps, windows
from train.data.presses import SEED
from train.experiments.paper.protocol import classical_methods, compact_methods, mixed
from train.experiments.support.workbench import Figures, Method, Workbench
from train.freeze import SCALE, TEST_FORCE_N
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, band, with_interval

EDGES_N: Final = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 8.0)
_NETWORKS: Final = ("stsr", "mtsr2", "mtsr4")
_CLASSICAL: Final = ("linear map", "bilinear")
_REACHED: Final = 0.99
"""Share of the requested force that a press must reach: some presses reach their largest indentation before."""


@dataclass(frozen=True, slots=True)
class Bin:
    """Scans of one range of forces: windows (n, K, 3, rows, cols) in zeroed counts, truth (n, H, W), sequences (n,).

    The newest tap is pressing, the earlier ones are at their ends.
    """

    force_n: tuple[float, float]
    windows: NDArray[np.float32]
    patterns: NDArray[np.float32]
    touching: NDArray[np.bool_]
    tap: NDArray[np.int64]


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `force`; the full run takes a few minutes once the networks are there."""
    data = mixed(bench)
    methods = [*compact_methods(bench, data, _NETWORKS), *classical_methods(bench, data, _CLASSICAL)]
    sequences = bench.held_out("test").at_scale(SCALE)
    draws = 1 if bench.quick else 4
    bins = [
        scans
        for number, bounds in enumerate(pairwise(EDGES_N))
        if (scans := scans_between(sequences, bounds, draws, [SEED, number]))
    ]
    figures = {
        method.name: [errors(method, scans) for scans in bins] for method in tracked(methods, "forces", "method")
    }
    report = Report("force", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"The {len(sequences)} test taps, newest scan somewhere on its press, earlier taps at their ends of "
        f"{TEST_FORCE_N:g} N; forces drawn evenly over their logarithm, {draws} a tap and "
        "range, every scan read by a sensor of its own with all nuisances at their defaults. Small shapes are as deep "
        f"as they may ({MAX_INDENTATION_MM} mm) before high forces, so those have fewer taps. PSNR and SSIM are "
        "against the declared full scale: the less there is, the better they look. Relative error is RMS error over "
        "the truth's RMS, and SSIM at own scale has each truth's peak as full scale: they measure errors of shape."
    )
    report.table(
        [_row(method, scans, figures[method.name][i]) for i, scans in enumerate(bins) for method in methods],
        "Errors by contact force, with 95 % intervals by tap.",
    )
    middle_n = [float(np.sqrt(np.prod(scans.force_n))) for scans in bins]
    shown = {"psnr_db": "PSNR [dB]", "ssim_own": "SSIM at own scale", "relative_percent": "relative error [%]"}
    with report.figure(size=(13, 4.5)) as figure:
        axes = figure.subplots(1, len(shown))
        for place, (key, label) in zip(axes, shown.items(), strict=True):
            for name, found in figures.items():
                mean, (below, above) = band((one[key], scans.tap) for one, scans in zip(found, bins, strict=True))
                (line,) = place.plot(middle_n, mean, "o-", label=name)
                place.fill_between(
                    middle_n, mean - below, mean + above, color=line.get_color(), alpha=0.15, linewidth=0
                )
            place.set(xscale="log", xlabel="force [N]", ylabel=label)
            place.set_xticks(EDGES_N, [f"{edge:g}" for edge in EDGES_N])
            place.minorticks_off()
        axes[0].legend()
    return report.write()


def scans_between(sequences: PaperTaps, force_n: tuple[float, float], draws: int, seed: Sequence[int]) -> Bin | None:
    """Return scans of sequences that reach such forces, drawn log-uniformly; None if no sequence does."""
    rng = np.random.default_rng([*seed, 0])
    index = np.repeat(np.arange(len(sequences)), draws)
    wanted_n = np.exp(rng.uniform(log(force_n[0]), log(force_n[1]), len(index)))
    end_n = sequences.force_n[index, 0, -1]
    reached = end_n >= _REACHED * wanted_n
    if not reached.any():
        return None
    index, wanted_n = index[reached], wanted_n[reached]
    taps_n = np.full((len(index), sequences.taps), TEST_FORCE_N)
    taps_n[:, 0] = wanted_n
    readings, patterns = windows(sequences, index, taps_n, Nuisances(), [*seed, 1])
    return Bin(force_n, readings, patterns, sequences.touching[index], index)


def errors(method: Method, scans: Bin) -> Figures:
    """Return every metric of every scan, (n,) each."""
    patterns, truth = method.patterns(scans.windows).astype(np.float64), scans.patterns.astype(np.float64)
    peak = truth.max(axis=(1, 2), keepdims=True)
    return {
        "psnr_db": psnr_db(patterns, truth, MAX_INDENTATION_MM),
        "ssim": ssim(patterns, truth, MAX_INDENTATION_MM),
        "ssim_own": ssim(patterns / peak, truth / peak, 1.0),
        "relative_percent": 100 * np.sqrt(np.mean((patterns - truth) ** 2, (1, 2)) / np.mean(truth**2, (1, 2))),
        "contact_iou": contact_iou(patterns, scans.touching, method.contact_level),
    }


def _row(method: Method, scans: Bin, found: Figures) -> Row:
    return {
        "force N": "{:g}..{:g}".format(*scans.force_n),
        "scans": len(scans.tap),
        "taps": len(np.unique(scans.tap)),
        "model": method.name,
        "PSNR dB": with_interval(found["psnr_db"], scans.tap),
        "SSIM": round(float(found["ssim"].mean()), 4),
        "SSIM at own scale": with_interval(found["ssim_own"], scans.tap, 3),
        "relative error %": with_interval(found["relative_percent"], scans.tap, 1),
        "IoU": round(float(found["contact_iou"].mean()), 4),
        **method.cost,
    }
