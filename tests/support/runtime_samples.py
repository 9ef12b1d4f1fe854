"""Runtime with a fake model, and a sensor that is pressed and moved scan by scan."""

import threading

import numpy as np
from edge_samples import BASELINE, PERIOD_NS, FakeModel, make_scan

from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import pump
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import Source
from firmware_bridge.zeroing.baseline import Baseline

PRESS = 3000


def make_runtime(model=None, **settings):
    settings = {"source": "device", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1060.0} | settings
    return Runtime(model or FakeModel(), **settings)


class Pushed:
    """Sensor whose scans come one by one into a runtime; `settings` are those of each scan, `results` are kept."""

    def __init__(self, runtime=None, sensor="4", **settings):
        self.runtime = runtime or make_runtime()
        self.number, self.results = 0, []
        self._settings = {"sensor": sensor, **settings}

    def scan(self, press=0.0, **changes):
        scan = make_scan(self.number, press_counts=press, **self._settings | changes)
        self.number += 1
        return scan

    def push(self, press=0.0, **changes):
        self.results.append(self.runtime.push(self.scan(press, **changes)))
        return self.results[-1]

    def play(self, count, offset=0.0, **changes):
        """Return the results of so many scans, off by counts of z or of all axes, or by a function of the number."""
        for number in range(count):
            scan = self.scan(**changes)
            off = np.rint(offset(number) if callable(offset) else offset).astype(np.int32)
            scan.counts[slice(None) if off.ndim == 3 else 2] += off
            self.results.append(self.runtime.push(scan))
        return self.results[-count:]

    def place(self, pose, **settings):
        """Hold the pad at a pose from now on, shortly before the next scan."""
        return self.runtime.pose(pose, (self.number + 1) * PERIOD_NS - 1000, holds=True, **settings)

    def tap(self, pose=None, press=PRESS, **changes):
        """Press twice and release; return the result of the second scan."""
        if pose is not None:
            self.place(pose)
        self.push(0.6 * press, **changes)
        result = self.push(press, **changes)
        self.push()
        return result

    @property
    def events(self):
        return [event for result in self.results for event in result.events]

    @property
    def kinds(self):
        return [event.kind for event in self.events]


def pumped(link, *sinks, runtime=None, statistics=None, rate_hz=None, **how):
    """Pump a link through a runtime of sensors 4 and 6 into sinks until it ends, and return the statistics."""
    baselines = {name: Baseline.of(name, BASELINE.counts, 1000.0, 100, "file") for name in "46"}
    runtime = runtime or make_runtime(source=link.kind, baselines=baselines)
    statistics = statistics or Statistics()
    with Source(link, rate_hz=rate_hz) as source:
        pump(source, runtime, sinks, statistics, **{"stop": threading.Event()} | how)
    return statistics


def presses(numbers):
    """Return scans that press a little more each, so that each needs a pattern of its own."""
    return [make_scan(number, press_counts=PRESS + 20 * number) for number in numbers]
