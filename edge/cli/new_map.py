"""Map that `edge-sr map` adds to a run."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import isfinite

from edge.errors import UsageError
from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink


@contextmanager
def new_map(options: argparse.Namespace) -> Iterator[MapSink]:
    """Yield the sink of a map, and report what is on it at the end, however the run ends.

    Args:
        options: of edge.cli.run_options.map_parser.

    Raises:
        UsageError: the size is out of range, or a file has another ending.
        SinkError: a file exists, or cannot be written.
    """
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
