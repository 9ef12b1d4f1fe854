"""Checks of the timing of one sensor: rate, torn scans and lost scans."""

from typing import Final

import numpy as np

from edge.doctor.findings import Finding, Verdict
from edge.doctor.scan_statistics import Samples
from firmware_bridge.silence import LATEST_SCAN_S

USUAL_HZ: Final = (70.0, 120.0)
"""Range of the rates measured on sensors of sixteen taxels, 74 to 113 scans a second, with a margin."""
RATE_TOLERANCE: Final = 0.1
_LOSS_LIMITS: Final = (0.001, 0.01)
_OLD_LIMITS: Final = (0.1, 0.3)
_LOSS_REMEDY: Final = (
    "frames are lost on the way: check the plugs and the termination of the bus, end what else loads this machine, "
    "and try another USB port without a hub"
)


def check_rate(samples: Samples, wanted_hz: float | None, line_full: bool) -> Finding:
    """Check the scans and the new readings a second.

    Args:
        samples: of the sensor.
        wanted_hz: the rate that a user expects, in [Hz].
        line_full: the serial line carries no more, so that the sensor's own rate cannot be seen.
    """
    rate_hz = 1 / samples.period_s()
    new_hz = samples.renewed[:, samples.living & ~samples.stuck()].mean(axis=0) * rate_hz
    taxels = f", taxels renewed {new_hz.min():.1f} to {new_hz.max():.1f} Hz" if new_hz.size else ""
    measured = f"{rate_hz:.1f} scans a second{taxels}"
    low, high = USUAL_HZ if wanted_hz is None else (wanted_hz * (1 - RATE_TOLERANCE), wanted_hz * (1 + RATE_TOLERANCE))
    norm = f"{low:.0f} to {high:.0f} Hz"
    if line_full:
        return Finding("rate", "not known", measured, norm, "the line is full: see baud rate")
    if low <= rate_hz <= high:
        return Finding("rate", "ok", measured, norm)
    remedy = (
        "set the sensor's rate in its controller, or state the expected one with --rate-hz"
        if rate_hz < low
        else "harmless, if the processor keeps up: state the expected rate with --rate-hz"
    )
    return Finding("rate", "look", measured, norm, remedy)


def check_torn(samples: Samples) -> Finding:
    """Check the share of scans that lack a taxel, or in which part of the taxels are old readings."""
    torn, old = float(samples.torn().mean()), float(samples.half_old().mean())
    measured = f"{100 * torn:.2f} % lack a taxel, {100 * old:.2f} % hold old readings"
    norm = f"under {100 * _LOSS_LIMITS[0]:.1f} % and {100 * _OLD_LIMITS[0]:.0f} %"
    verdict = _graded(torn, _LOSS_LIMITS)
    if verdict != "ok":
        missing = np.where(samples.living, (~samples.fresh).mean(axis=0), 0)
        most = int(missing.argmax())
        only = missing[most] > 0.8 * missing.sum()
        remedy = f"taxel {most} comes and goes: its connection may be broken" if only else _LOSS_REMEDY
        return Finding("torn scans", verdict, measured, norm, remedy)
    remedy = "the sender of these scans repeats itself: lower its rate to that of the sensor"
    verdict = _graded(old, _OLD_LIMITS)
    return Finding("torn scans", verdict, measured, norm, "" if verdict == "ok" else remedy)


def check_lost(samples: Samples, silent_s: float) -> Finding:
    """Check the share of scans that never came, by the gaps they left.

    Args:
        samples: of the sensor.
        silent_s: time without a scan at the end, in [s].
    """
    if silent_s > LATEST_SCAN_S:
        remedy = "the sensor fell silent: check its power and its plug"
        return Finding("lost scans", "wrong", f"all of the last {silent_s:.0f} s", "", remedy)
    lost = samples.lost()
    share = lost / (lost + samples.scans)
    gap_ms = 1000 * float(np.diff(samples.time_s).max())
    measured = f"{lost} of {lost + samples.scans}, longest gap {gap_ms:.0f} ms"
    verdict = _graded(share, _LOSS_LIMITS)
    return Finding(
        "lost scans",
        verdict,
        measured,
        f"under {100 * _LOSS_LIMITS[0]:.1f} %",
        "" if verdict == "ok" else _LOSS_REMEDY,
    )


def _graded(value: float, limits: tuple[float, float]) -> Verdict:
    return "ok" if value <= limits[0] else "look" if value <= limits[1] else "wrong"
