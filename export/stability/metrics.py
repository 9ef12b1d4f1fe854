"""Metrics on maps that are equal, constant, zero, tiny and huge: defined, and the same at every amplitude."""

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation import metrics
from export.stability.case import Case, refused, timed

PART: Final = "metrics"
_MAP: Final = np.random.default_rng(0).random((1, 40, 40))
_OTHER: Final = _MAP + 0.01 * np.random.default_rng(1).random((1, 40, 40))
_ZERO, _EVEN = np.zeros_like(_MAP), np.full_like(_MAP, 0.3)

Metric = Callable[[NDArray[Any], NDArray[Any], float], NDArray[np.float64]]
METRICS: Final[dict[str, Metric]] = {
    "PSNR": metrics.psnr_db,
    "SSIM": metrics.ssim,
    "SSIM global": metrics.ssim_global,
    "RMSE": metrics.rmse_percent,
}
_OF_EQUALS: Final = {"PSNR": np.inf, "SSIM": 1.0, "SSIM global": 1.0, "RMSE": 0.0}


def cases(_quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    for name, metric in METRICS.items():
        for severity, maps in (("equal", _MAP), ("equal and even", _EVEN), ("both zero", _ZERO)):
            value, run_ms = timed(lambda metric=metric, maps=maps: float(metric(maps, maps, 1.0)[0]))
            expected = _OF_EQUALS[name]
            apart = 0.0 if value == expected else abs(value - expected)
            yield Case(PART, name, severity, f"from {expected:g}", apart, 1e-12, run_ms)
        for severity, maps in (("against zero", _ZERO), ("against an even map", _EVEN)):
            value, run_ms = timed(lambda metric=metric, maps=maps: float(metric(_MAP, maps, 1.0)[0]))
            yield Case(PART, name, severity, "not finite", float(not np.isfinite(value)), 0.0, run_ms)
        true = float(metric(_MAP, _OTHER, 1.0)[0])
        for amplitude in (1e-12, 1e-6, 1e6, 1e12):
            value, run_ms = timed(
                lambda metric=metric, size=amplitude: float(metric(size * _MAP, size * _OTHER, size)[0])
            )
            what = "change, maps and full scale by one factor"
            yield Case(PART, name, f"amplitude {amplitude:g}", what, abs(value / true - 1), 1e-9, run_ms)
        single = float(metric(_MAP.astype(np.float32), _OTHER.astype(np.float32), 1.0)[0])
        yield Case(PART, name, "float32 maps", "change", abs(single / true - 1), 1e-4)
        for full_scale in (0.0, -1.0, float("nan")):
            work = lambda metric=metric, full=full_scale: metric(_MAP, _MAP, full)  # noqa: E731
            yield refused(PART, name, f"full scale {full_scale:g}", work, ValueError)
        yield refused(
            PART, name, "maps of unlike shape", lambda metric=metric: metric(_MAP, _MAP[:, :39], 1.0), ValueError
        )
    yield Case(
        PART, "IoU", "nothing touched in both", "from 1", float(1 - metrics.contact_iou(_ZERO, _ZERO > 0, 0.5)[0]), 0.0
    )
    apart = metrics.boundary_distance_mm(_ZERO, _ZERO > 0, 0.5, 0.47)[0]
    yield Case(PART, "boundary", "nothing touched in both", "from 0", float(apart), 0.0)
