"""Interface of every sink; a new one is one file, and its form in `edge.sinks.registry`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from edge.errors import SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from firmware_bridge.in_place import check_writable
from firmware_bridge.poses import TimedPose


class Sink(Protocol):
    """Destination of results. Inherit it to get the optional methods."""

    unwritten: int = 0  # records left out so far, because the reader is too slow
    uses_poses: bool = False  # its results depend on poses, as those of a map do
    patience_s: float = 0.0  # longest time for which results of a sensor at rest may wait for it

    @property
    def trouble(self) -> str | None:
        """What is wrong with it, in plain words for the user; None while all is well."""
        return None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Take one result, and the counters up to it; raises SinkError, or SinkClosedError if its reader has gone."""
        ...

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Take an event, with the counters up to then; raises as `write` does."""

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Take poses of pads, before the results that are made with them at hand; raises as `write` does."""

    def wait(self) -> None:
        """Do what is due, several times a second while no scan comes; raises as `write` does."""

    def close(self) -> None:
        """Finish the written records, or raise a SinkError; there may be nothing to finish."""


def check_new(path: Path) -> None:
    """Raise a SinkError where a new file cannot be written, before anything is begun."""
    if path.exists() or path.is_symlink():
        raise SinkError(f"{path} exists: give another name, or delete it first")
    try:
        check_writable(path)
    except OSError as error:
        raise SinkError(f"cannot write {path}: {error.strerror or error}") from error
