"""Zeroing once, to keep the baseline for later runs."""

import threading
import time
from collections.abc import Callable
from typing import Final

from firmware_bridge.baseline import Baseline, BaselineEstimator
from firmware_bridge.errors import BaselineRefusedError, DeviceError
from firmware_bridge.links.base import Link

READ_TIMEOUT_S: Final = 0.1
SILENCE_S: Final = 10.0


def take_baselines(
    link: Link,
    *,
    scans: int,
    skip: int = 0,
    stop: threading.Event,
    clock_s: Callable[[], float] = time.monotonic,
) -> dict[str, Baseline]:
    """Baselines of all sensors on a link, by name; gives up at the first refusal.

    Args:
        link: open.
        scans: complete ones to take the median of.
        skip: scans of each sensor to leave out first.
        stop: gives up early.
        clock_s: monotonic, in [s].

    Raises:
        BaselineRefusedError: a pad moved or was loaded, or the end came too soon.
        DeviceError: no scan came for a long time.
        LinkLostError: the link is gone.
    """
    skipped: dict[str, int] = {}
    estimators: dict[str, BaselineEstimator] = {}
    baselines: dict[str, Baseline] = {}
    heard_s = clock_s()
    while not (baselines and baselines.keys() == skipped.keys()):
        if stop.is_set():
            raise BaselineRefusedError("stopped before every sensor was zeroed: nothing is kept")
        arrived = link.read(READ_TIMEOUT_S)
        if arrived:
            heard_s = clock_s()
        elif link.ended:
            raise BaselineRefusedError(f"the source ended before {scans} complete scans of every sensor were heard")
        elif clock_s() - heard_s > SILENCE_S:
            raise DeviceError(f"no scan from {link.name} for {SILENCE_S:.0f} s: is the sensor powered?")
        for scan in arrived:
            name = scan.sensor
            skipped[name] = skipped.get(name, -1) + 1
            if skipped[name] < skip or name in baselines:
                continue
            estimator = estimators.setdefault(name, BaselineEstimator(scans))
            try:
                baseline = estimator.push(scan)
            except BaselineRefusedError as refusal:
                raise BaselineRefusedError(f"sensor {name}: {refusal}") from refusal
            if baseline is not None:
                baselines[name] = baseline
    return baselines
