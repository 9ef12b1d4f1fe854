"""Runtime with a fake model, and a sensor that is pressed and moved scan by scan."""

from edge_samples import BASELINE, PERIOD_NS, FakeModel, make_scan

from edge.perception.runtime import Runtime

PRESS = 3000


def make_runtime(model=None, **settings):
    settings = {"source": "device", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1060.0} | settings
    return Runtime(model or FakeModel(), **settings)


class Pushed:
    """Sensor whose scans come one by one into a runtime; `settings` are those of each scan, `results` are kept."""

    def __init__(self, runtime=None, sensor="4", **settings):
        self.runtime, self.sensor = runtime or make_runtime(), sensor
        self.number, self.results = 0, []
        self._settings = settings

    def scan(self, press=0.0, **changes):
        scan = make_scan(self.number, press_counts=press, sensor=self.sensor, **self._settings | changes)
        self.number += 1
        return scan

    def push(self, press=0.0, **changes):
        self.results.append(self.runtime.push(self.scan(press, **changes)))
        return self.results[-1]

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
