"""Records of a run among faults as they were read, and how they are fetched."""

import os
import threading
import time
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import IO, Any, NamedTuple

import numpy as np
import orjson
from fault_log import Told
from numpy.typing import NDArray

from edge.sinks.pipe_capacity import PIPE_BYTES


class Seen(NamedTuple):
    """A record as it was read.

    Attributes:
        read_ns: when, monotonic, in [ns].
        head: the record without its maps and readings.
        counts: (16, 3), row-major by taxel, -1 where absent; None of an event.
        drawn: it has a pattern.
    """

    read_ns: int
    head: dict[str, Any]
    counts: NDArray[np.int32] | None
    drawn: bool


class Size(NamedTuple):
    """Memory, threads and descriptors of the program at a time, in [s] since it was started."""

    time_s: float
    resident_mb: float
    threads: int
    descriptors: int


@dataclass
class Ran:
    """Outcome of a run.

    Attributes:
        exit_code: exit code of edge-sr.
        said: text on stderr.
        seen: its records, in order.
        sizes: its memory, threads and descriptors, now and then.
        told: the injector's truth.
        slow: number of records that a consumer received which did not read for a while.
        unwritten: number of records that were left out for it, by the last that it received.
        broken: output of failed sinks, or to consumers, that is not whole records; empty is expected.
        clock_steps_s: steps by which the age of a baseline jumped from one record to the next, in [s].
    """

    exit_code: int = -1
    said: str = ""
    seen: list[Seen] = field(default_factory=list)
    sizes: list[Size] = field(default_factory=list)
    told: Told | None = None
    slow: int = 0
    unwritten: int = 0
    broken: list[str] = field(default_factory=list)
    clock_steps_s: list[float] = field(default_factory=list)


def in_thread(work: Any, *arguments: Any) -> threading.Thread:
    """Start work in a thread of its own."""
    thread = threading.Thread(target=work, args=arguments, daemon=True)
    thread.start()
    return thread


def read_records(stream: IO[bytes], seen: list[Seen]) -> None:
    """Keep every record until there are no more; fetched at once, since what finds no room is left out for us."""
    fetched: SimpleQueue[tuple[bytes, int]] = SimpleQueue()
    parser = in_thread(_parse_records, fetched, seen)
    while data := os.read(stream.fileno(), PIPE_BYTES):
        fetched.put((data, time.monotonic_ns()))
    fetched.put((b"", 0))
    parser.join()


def _parse_records(fetched: "SimpleQueue[tuple[bytes, int]]", seen: list[Seen]) -> None:
    rest = b""
    while True:
        data, read_ns = fetched.get()
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        seen += [read_record(line, read_ns) for line in lines]


def read_record(line: bytes, read_ns: int) -> Seen:
    """Decode a line of records."""
    head = orjson.loads(line)
    counts, drawn = head.pop("counts", None), head.pop("pattern", None) is not None
    head.pop("deviation", None)
    if counts is not None:
        counts = np.array([-1 if value is None else value for axis in counts for row in axis for value in row])
        counts = counts.reshape(3, 16).T.astype(np.int32)
    return Seen(read_ns, head, counts, drawn)


def keep_lines(stream: IO[bytes], lines: list[bytes]) -> None:
    """Keep every line until there are no more."""
    lines.extend(stream)
