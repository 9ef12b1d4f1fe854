"""What every sink offers; adding a sink is one file with this interface and its form in `edge.sinks.registry`."""

from collections.abc import Mapping
from typing import Protocol

from edge.perception.event import Event
from edge.perception.result import Result


class Sink(Protocol):
    """Where results go. Inherit it to get what is optional.

    Attributes:
        unwritten: records left out so far, because whoever reads them is too slow.
        trouble: what its user must know of it, in plain words; None while all is well.
    """

    unwritten: int = 0

    @property
    def trouble(self) -> str | None:  # noqa: D102 - above
        return None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Take one result, and what was received, dropped and lost up to it.

        Raises:
            SinkError: it cannot be written.
            SinkClosedError: its reader has gone.
        """
        ...

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Take what happened beside scans, and the counters up to then.

        Raises:
            SinkError: it cannot be written.
            SinkClosedError: its reader has gone.
        """

    def wait(self) -> None:
        """Called several times a second while no scan comes; raises as `write` does."""

    def close(self) -> None:
        """Finish what was written.

        Raises:
            SinkError: it cannot be finished.
        """
        ...
