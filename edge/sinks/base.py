"""What every sink offers; adding a sink is one file with this interface and its form in `forms`."""

from collections.abc import Mapping
from typing import Protocol

from edge.result import Result


class Sink(Protocol):
    """Where results go. Inherit it to get what is optional."""

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Take one result, and what was received, dropped and lost up to it.

        Raises:
            SinkError: it cannot be written.
            SinkClosedError: its reader has gone.
        """
        ...

    def wait(self) -> None:
        """Called several times a second while no scan comes."""

    def close(self) -> None:
        """Finish what was written.

        Raises:
            SinkError: it cannot be finished.
        """
        ...
