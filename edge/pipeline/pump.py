"""Loop from a source through the runtime into sinks."""

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink


@contextmanager
def uncollected() -> Iterator[None]:
    """Disable garbage collection within a with statement.

    A full collection stops everything for tens of milliseconds, several periods of a sensor, and the loop makes no
    cycles that would need one: its objects are freed at once. Older objects are kept out of later collections.
    """
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()


def pump(source: Source, runtime: Runtime, sinks: Sequence[Sink], statistics: Statistics, **settings: Any) -> None:
    """Run a stream into its sinks until it ends, without pauses for garbage collection; it takes the same settings.

    Statistics are filled on the way, so that they are available however the run ends; errors are those of the stream.
    """
    settings = {"patience_s": min((sink.patience_s for sink in sinks), default=0.0), **settings}
    stream = Stream(source, runtime, sinks=sinks, statistics=statistics, **settings)
    with uncollected():
        try:
            for _ in stream:
                pass
        finally:
            # What the last ones left out belongs to the run, too.
            statistics.unwritten = sum(sink.unwritten for sink in sinks)
            statistics.sink_trouble = "; ".join(sink.trouble for sink in sinks if sink.trouble is not None) or None
