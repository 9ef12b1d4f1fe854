"""Raw counts at the ends of their 16 bits: around the wrap, drifting a thousand a minute, all saturated."""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import DEFAULT_MODEL, TAXELS, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import ON_COUNTS
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from export.stability.case import Case, timed
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline, deformation
from firmware_bridge.zeroing.drift_tracker import COMMON_PER_S

PART: Final = "counts"
RATE_HZ: Final = 100.0
_NS: Final = 1_000_000_000
_CONTACT_COUNTS: Final = ON_COUNTS / USPA44.taxel_count
"""Counts in every taxel that together make a contact."""
_DRIFTS_S: Final = 240
_PRESS: Final = np.array([-300, 200, 900], dtype=np.int32)[:, None, None]
_SCANS: Final = 200
"""Number of scans of a free pad for zeroing."""


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    for rest in (0, 1, 443, 32768, 65092, 65534, 65535):
        yield _around(rest)
    for rest in (0, 1, 65534, 65535):
        yield resting(rest)
    for counts in (-1, 65535):
        yield saturated(counts)
    for per_minute in (1000.0,) if quick else (30.0, 120.0, 1000.0):
        yield _drift(per_minute)
    yield _fast_drift(3000.0)


def _around(rest: int) -> Case:
    """Return the case of a press on a pad whose taxels rest at `rest`, stored in 16 bits."""
    baseline = Baseline.of("4", _even(rest).astype(np.float32), created_unix_s=0.0, scans=_SCANS, origin="start-up")
    raw = (_even(rest) + _PRESS) % 65536
    zeroed, run_ms = timed(lambda: deformation(raw, baseline))
    apart = float(np.abs(zeroed - _PRESS).max())
    return Case(PART, "wrap-around", f"rest at {rest}", "counts off", apart, 0.0, run_ms)


def resting(rest: int) -> Case:
    """Return the case of a free pad whose taxels rest at `rest` and wrap around by noise: it must always be idle."""
    states = [result.state for result in _play([_even(rest)] * 2 * _SCANS)]
    lost = len(states) - states.index("idle") - states.count("idle")
    return Case(PART, "wrap-around", f"rest at {rest}, noise", "scans not taken", float(lost), 0.0)


def saturated(counts: int) -> Case:
    """Return the case of saturated chips, which carry no information: no pattern may be computed from them."""
    states = [result.state for result in _play([_even(38_600)] * _SCANS + [_even(counts)] * _SCANS, clip=True)]
    patterns = states[_SCANS + 10 :].count("contact")  # a taxel's last reading is kept for a few scans
    return Case(PART, "saturated", f"all taxels at {max(counts, 0)}", "patterns made of it", float(patterns), 0.0)


def _drift(per_minute: float) -> Case:
    """Return the case of a free pad that drifts in all taxels within the tracked rate, as a share of a contact."""
    sums = [abs(result.force_counts or 0.0) for result in _drifting(per_minute)]
    severity = f"{per_minute:g} counts a minute"
    return Case(PART, "drift", severity, "% of a contact at most", 100 * max(sums) / ON_COUNTS, 50.0)


def _fast_drift(per_minute: float) -> Case:
    """Return the case of a drift above the tracked rate, as the time until it is taken for a contact."""
    touching = (number for number, result in enumerate(_drifting(per_minute)) if result.contact)
    after_s = (next(touching, np.inf) - _SCANS) / RATE_HZ
    unfollowed_s = _CONTACT_COUNTS / (per_minute / 60)
    followed_s = _CONTACT_COUNTS / (per_minute / 60 - COMMON_PER_S)
    return Case(
        PART,
        "drift",
        f"{per_minute:g} counts a minute",
        "s until it is a contact",
        after_s,
        1.1 * followed_s,
        limit=True,
        note="faster than drift is followed (docs/commission.md, Drift)",
        least=0.9 * unfollowed_s,
    )


def _drifting(per_minute: float) -> Iterator[Result]:
    raw = _even(16_000)
    drifted = per_minute / 60 * np.arange(int(_DRIFTS_S * RATE_HZ)) / RATE_HZ
    return _play(chain([raw] * _SCANS, (raw + int(counts) for counts in drifted)), infer=False)


def _even(counts: int) -> NDArray[np.int32]:
    return np.full(USPA44.scan_shape, counts, dtype=np.int32)


def _play(readings: Iterable[NDArray[np.int32]], infer: bool = True, clip: bool = False) -> Iterator[Result]:
    """Run the runtime on readings at the sensor's rate, starting with zeroing; one count of noise keeps taxels alive.

    Args:
        readings: raw, (3, rows, cols) each.
        infer: compute patterns.
        clip: saturate at the end of the range; else the 16 bits wrap around.
    """
    estimator = load_estimator(TAXELS, (USPA44.rows, USPA44.cols))
    runtime = Runtime(ModelSession(find_model(DEFAULT_MODEL)), source="replay", estimator=estimator)
    series = ScanSeries("4", USPA44)
    period_ns = int(_NS / RATE_HZ)
    for number, counts in enumerate(readings):
        yield runtime.push(
            series.close(
                np.clip(counts + number % 2, 0, 65535) if clip else (counts + number % 2) % 65536, number * period_ns
            ),
            infer=infer,
        )
