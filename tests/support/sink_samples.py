"""Results for the tests of sinks: idle and contact in turn."""

import io

from edge_samples import BASELINE, FakeModel, make_contract, make_scan

from edge.perception.runtime import Runtime

SHAPES = ((3, 4, 4), (40, 40))
RUN = {"dropped": 2, "overruns": 1, "torn_wire": 3, "torn_source": 4}


def make_results(count=6, runtime=None, **settings):
    """Return idle and contact in turn, of two sensors, some torn; sensor 6 has no baseline and stays in zeroing."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1012.34} | settings
    runtime = runtime or Runtime(FakeModel(), **settings)
    results = []
    for number in range(count):
        for sensor in ("4", "6"):
            absent = (3, 7) if number % 4 == 2 else ()
            press = 3000 + 40 * (3 - number % 4) if number % 4 > 1 else 0
            scan = make_scan(number, sensor=sensor, press_counts=press, absent=absent, noise=3)
            results.append(runtime.push(scan))
    return results


def make_sure_results(count=6, **settings):
    """Return such results of a model that gives deviations."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}} | settings
    return make_results(count, Runtime(FakeModel(make_contract(interval_factor=1.6)), **settings))


class Terminal(io.StringIO):
    def isatty(self):
        return True
