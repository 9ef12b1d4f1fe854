"""Runtime with a fake model, and the press of its contacts."""

from edge_samples import (
    BASELINE,
    FakeModel,
)

from edge.perception.runtime import Runtime

PRESS = 3000


def make_runtime(model=None, **settings):
    settings = {"source": "device", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1060.0} | settings
    return Runtime(model or FakeModel(), **settings)
