"""Judge patterns on the frozen test set: the figures that contracts, benches and tests speak of."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edge.contract import Contract
from edge.frozen import FrozenSet
from edge.metrics import contact_iou, psnr_db, rmse_percent, ssim, ssim_global


def judge(patterns: NDArray[np.floating], frozen: FrozenSet, contact_level: float) -> dict[str, NDArray[np.float64]]:
    """Every metric of every frame, (n,) each; patterns (n, H, W) in [mm]."""
    truth, full_scale = frozen.patterns(), frozen.full_scale_mm
    return {
        "psnr_db": psnr_db(patterns, truth, full_scale),
        "ssim": ssim(patterns, truth, full_scale),
        "ssim_global": ssim_global(patterns, truth, full_scale),
        "rmse_percent": rmse_percent(patterns, truth, full_scale),
        "contact_iou": contact_iou(patterns, frozen.touching(), contact_level),
    }


def mean_error(errors: dict[str, NDArray[np.float64]]) -> dict[str, float]:
    """Mean of each metric over all frames, rounded to what the test set can tell."""
    return {name: round(float(values.mean()), 4) for name, values in errors.items()}


def by_surface(values: NDArray[np.float64], frozen: FrozenSet) -> dict[str, float]:
    """Mean of one metric, (n,), for each surface."""
    surface = frozen.surface[frozen.tap]
    return {str(name): float(values[surface == name].mean()) for name in dict.fromkeys(frozen.surface.tolist())}


def infer_all(
    run: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    contract: Contract,
    frozen: FrozenSet,
    given: int | None = None,
) -> NDArray[np.float32]:
    """Patterns (n, H, W) of a model for every frame, with the newest `given` taps or all it takes.

    Args:
        run: gives the pattern (H, W) of a window (taps, 3, rows, cols) in network input units.
        contract: the model's.
        frozen: the test set.
        given: taps that are there; older ones are zero.
    """
    windows = frozen.windows(contract.taps, given)
    return np.stack([run(contract.scale_window(window)).copy() for window in windows])
