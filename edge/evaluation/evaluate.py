"""Evaluation of patterns on the frozen test set, for the figures in contracts, benches and tests."""

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import (
    boundary_distance_mm,
    contact_iou,
    interval_coverage,
    psnr_db,
    rmse_percent,
    ssim,
    ssim_global,
)
from edge.evaluation.test_set import FrozenSet
from edge.inference.contract import Contract
from edge.inference.model_interface import Model
from firmware_bridge.pad_geometry import USPA44


def judge(
    patterns: NDArray[np.floating],
    frozen: FrozenSet,
    contact_level: float,
    half_width_mm: NDArray[np.floating] | None = None,
    pitch_mm: float = USPA44.pitch_mm,
) -> dict[str, NDArray[np.float64]]:
    """Return every metric of every frame, (n,) each.

    Args:
        patterns: (n, H, W) in [mm].
        frozen: the test set.
        contact_level: share of a pattern's maximum from which a pixel counts as touched.
        half_width_mm: (n, H, W), half widths of the 90 % intervals; "coverage_90" is left out without them.
        pitch_mm: of the taxels, in [mm].
    """
    truth, full_scale = frozen.patterns(), frozen.full_scale_mm
    errors = {
        "psnr_db": psnr_db(patterns, truth, full_scale),
        "ssim": ssim(patterns, truth, full_scale),
        "ssim_global": ssim_global(patterns, truth, full_scale),
        "rmse_percent": rmse_percent(patterns, truth, full_scale),
        "contact_iou": contact_iou(patterns, frozen.touching(), contact_level),
        "boundary_mm": boundary_distance_mm(patterns, frozen.touching(), contact_level, pitch_mm / frozen.scale),
    }
    if half_width_mm is not None:
        errors["coverage_90"] = interval_coverage(patterns, truth, half_width_mm)
    return errors


def judge_model(model: Model, frozen: FrozenSet, given: int | None = None) -> dict[str, NDArray[np.float64]]:
    """Return every metric of every frame, (n,) each, of a model with the newest `given` taps or all that it takes."""
    patterns, half_width_mm = infer_with_intervals(model, frozen, given)
    return judge(patterns, frozen, model.contract.contact_level, half_width_mm, model.contract.pitch_mm)


def infer_with_intervals(
    model: Model, frozen: FrozenSet, given: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the patterns (n, H, W) of every frame, and the half widths of their 90 % intervals, both in [mm].

    The intervals are None if the model gives no deviations.
    """
    contract = model.contract
    patterns: list[NDArray[np.float32]] = []
    half_widths_mm: list[NDArray[np.float32]] = []
    for window in windows_of(frozen, contract, given):
        patterns.append(model.run(contract.scale_window(window)).copy())
        if model.deviation is not None and contract.interval_factor is not None:
            half_widths_mm.append(contract.interval_factor * model.deviation)
    return np.stack(patterns), np.stack(half_widths_mm) if half_widths_mm else None


def windows_of(frozen: FrozenSet, contract: Contract, given: int | None = None) -> NDArray[np.float32]:
    """Return windows (n, taps, 3, rows, cols) in zeroed counts for a model, with the newest `given` taps or all.

    One that takes poses takes windows of just these; for all others older taps are zero.
    """
    return frozen.windows(given if contract.takes_poses and given is not None else contract.taps, given)


def mean_error(errors: dict[str, NDArray[np.float64]]) -> dict[str, float]:
    """Return the mean of each metric over all frames, rounded to the resolution of the test set."""
    return {name: round(float(values.mean()), 4) for name, values in errors.items()}
