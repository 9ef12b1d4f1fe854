"""Files that `edge-sr record` and `edge-sr map` add to a run."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Final

from edge.errors import SinkError, UsageError
from edge.pipeline.run_statistics import Statistics
from edge.sinks.registry import check_apart

if TYPE_CHECKING:
    from edge.api import MapSink

_NOT_WRITTEN: Final = (".csv", ".npz", ".json", ".jsonl")
"""Suffixes of other formats, which a recording must not be named after."""


@contextmanager
def new_recording(options: argparse.Namespace) -> Iterator[Statistics]:
    """Add a recording to the options of a run, and report it at the end, however the run ends."""
    path = Path(options.file)
    if path.is_dir():
        raise SinkError(f"cannot record into {path}: it is a directory; name a file in it")
    if path.suffix.lower() in _NOT_WRITTEN:
        made = path.with_suffix(".mcap")
        then = "for records in JSON use edge-sr --sink jsonl:FILE"
        if path.suffix.lower() in (".csv", ".npz"):
            then = f"afterwards edge-sr convert {made} {path}"
        raise UsageError(f"{path.suffix} cannot be recorded: edge-sr record {made}; {then}")
    if path.suffix != ".mcap":
        path = path.with_name(path.name + ".mcap")
    if path.exists():  # checked before anything is begun
        raise SinkError(f"{path} exists: give another name, or delete it first")
    options.sink = [*options.sink, f"mcap:{path}"]
    check_apart(options.sink)
    statistics = Statistics()
    try:
        yield statistics
    finally:
        if path.exists():
            size_mb = path.stat().st_size / 1e6
            emulated = ", EMULATED" if statistics.source == "emulated" else ""
            sure = sys.exception() is None and not statistics.unwritten  # else a sink has reported what it lacks
            held = f"{'' if sure else 'at most '}{statistics.scans} scans, {statistics.duration_s():.1f} s"
            with suppress(OSError):  # the terminal may have gone
                sys.stderr.write(f"recorded {path}: {held}, {size_mb:.2f} MB{emulated}\n")


@contextmanager
def new_map(options: argparse.Namespace) -> Iterator["MapSink"]:
    """Yield the sink of a map, and report what is on it at the end, however the run ends."""
    from edge.api import MapSink, ObjectMap

    for path, ending in ((options.out, ".npz"), (options.png, ".png")):
        if path is not None and path.suffix != ending:
            raise UsageError(f"{path} is no name of a map's file: expected one that ends in {ending}")
    if not all(map(isfinite, options.centre_mm)):
        raise UsageError(f"--centre-mm {options.centre_mm[0]} {options.centre_mm[1]}: expected two finite numbers")
    whole = ObjectMap(options.size_mm, options.px_per_mm, centre_mm=tuple(options.centre_mm))
    sink = MapSink(whole, npz=options.out, png=options.png)
    try:
        yield sink
    finally:
        if sink.fused or sys.exception() is None:
            with suppress(OSError):  # the terminal may have gone
                sys.stderr.write(f"{sink.summary()}\n")
