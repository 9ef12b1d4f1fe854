"""Zeroing once, to keep the baseline for later runs."""

import math
import threading
import time
from collections.abc import Callable

from edge.pipeline.run_statistics import silence_hint
from edge.pipeline.scan_reader import Source
from firmware_bridge.errors import BaselineRefusedError, DeviceError
from firmware_bridge.links.base import Notice
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import GIVEN_UP_S, POLL_S
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline, BaselineEstimator


def take_baselines(
    source: Source,
    *,
    stop: threading.Event | None = None,
    clock_s: Callable[[], float] = time.monotonic,
) -> dict[str, Baseline]:
    """Take the baselines of all sensors of a source, by name: medians of their first 100 complete scans, pads free.

    Raises a BaselineRefusedError where a pad moved or was loaded, or the source ended or was stopped too soon, and a
    DeviceError where no scan, or no whole new one of a sensor, arrived for a long time. No stream may read the source.
    """
    source.reserve()
    clock = (lambda: math.nan) if source.kind == "replay" else time.time  # never today's, of an old file
    estimators: dict[str, BaselineEstimator] = {}
    baselines: dict[str, Baseline] = {}
    whole_s: dict[str, float] = {}
    received_s = clock_s()
    while not (baselines and baselines.keys() == whole_s.keys()):
        if stop is not None and stop.is_set():
            raise BaselineRefusedError("stopped before every sensor was zeroed: nothing is kept")
        taken = source.take(POLL_S)
        if taken is None:
            raise BaselineRefusedError(f"the source ended before {FEWEST_SCANS} complete scans of every sensor")
        now_s = clock_s()
        if any(isinstance(arrival, Scan) for arrival in taken):
            received_s = now_s
        elif now_s - received_s > GIVEN_UP_S:
            hint = silence_hint((), source.counters)
            raise DeviceError(f"no scan from {source.name} for {GIVEN_UP_S:.0f} s: {hint}")
        for arrival in taken:
            if not isinstance(arrival, Scan):
                if isinstance(arrival, Notice) and arrival.kind in ("lost", "silent"):
                    estimators.clear()  # the sensor may read differently after the gap
                continue
            name = arrival.sensor
            if name not in whole_s or (arrival.complete and not arrival.repeated):
                whole_s[name] = now_s
            if name in baselines:
                continue
            estimator = estimators.setdefault(name, BaselineEstimator(clock=clock))
            try:
                baseline = estimator.push(arrival)
            except BaselineRefusedError as refusal:
                raise BaselineRefusedError(f"sensor {name}: {refusal}") from refusal
            if baseline is not None:
                baselines[name] = baseline
        for name in whole_s.keys() - baselines.keys():
            if now_s - whole_s[name] > GIVEN_UP_S:  # a taxel or the sensor is silent, while scans come
                lack = f"no whole new scan from sensor {name} for {GIVEN_UP_S:.0f} s"
                raise DeviceError(f"{lack}: edge-sr doctor shows what is wrong")
    return baselines
