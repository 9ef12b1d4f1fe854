"""Errors of patterns and forces in the forms that the reports of shipped models use."""

import numpy as np
from numpy.typing import NDArray

from train.experiments.support.workbench import Figures
from train.report import Row, with_interval


def pooled_db(psnr_db: NDArray[np.floating]) -> float:
    """Return the PSNR of all frames taken as one, in [dB]: bad frames weigh more than in the mean."""
    return float(-10 * np.log10(np.mean(10 ** (-psnr_db / 10))))


def own_peak_db(psnr_db: NDArray[np.floating], truth: NDArray[np.floating], full_scale: float) -> NDArray[np.floating]:
    """Return the PSNR (n,) against the maximum of each true pattern (n, H, W) in place of the full scale, in [dB]."""
    return psnr_db + 20 * np.log10(truth.max(axis=(-2, -1)) / full_scale)


def pattern_cells(figures: Figures, truth: NDArray[np.floating], full_scale: float, groups: NDArray[np.integer]) -> Row:
    """Return errors of patterns as cells of a row, with intervals by group: frames of a group are not independent."""
    psnr_db = figures["psnr_db"]
    return {
        "PSNR dB": with_interval(psnr_db, groups),
        "pooled dB": round(pooled_db(psnr_db), 2),
        "own peak dB": round(float(own_peak_db(psnr_db, truth, full_scale).mean()), 2),
        "IoU": round(float(figures["contact_iou"].mean()), 3),
        "edge mm": round(float(figures["boundary_mm"].mean()), 3),
        "RMSE %": round(float(figures["rmse_percent"].mean()), 2),
    }
