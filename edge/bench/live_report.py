"""Live report of a bench: the page on stdout, kept for the file, and one line of progress."""

from collections.abc import Iterable, Iterator, Sequence, Sized
from typing import Final, TextIO, TypeVar

from edge.terminal.progress_bar import Progress
from edge.terminal.text_wrap import drawn
from firmware_bridge.errors import harmless

_CLEAR_LINE: Final = "\r\x1b[K"
_Thing = TypeVar("_Thing")


def line(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def head(columns: Sequence[str]) -> str:
    """Return the head of a Markdown table."""
    return f"{line(columns)}\n{'|---' * len(columns)}|"


class Page:
    """Page of lines that are shown at once and kept; progress is shown on a terminal alone, and overwritten.

    Attributes:
        lines: all lines so far.
    """

    def __init__(self, out: TextIO, err: TextIO) -> None:
        self.lines: list[str] = []
        self._out = out
        self._err = err
        self._watched = err.isatty()
        self._bar: Progress | None = None

    def say(self, text: str) -> None:
        """Show a line, or several, and keep it."""
        self.lines.append(text)
        self._write(self._out, text)

    def section(self, title: str, text: str, table_head: str) -> None:
        """Begin a section and its table."""
        self.say(f"\n## {title}\n\n{text}\n\n{table_head}")

    def warn(self, text: str) -> None:
        """Show a line on stderr."""
        self._write(self._err, f"edge-sr: {text}")

    def progress(self, text: str) -> None:
        """Show the current step: after the bar where there is one, else over the step before."""
        if self._bar is not None:
            self._bar.note(text, at_once=True)
        elif self._watched:
            drawn(self._err).write(f"{_CLEAR_LINE}{harmless(text)}")
            self._err.flush()

    def tracked(
        self, things: Iterable[_Thing], what: str, unit: str = "row", total: int | None = None
    ) -> Iterator[_Thing]:
        """Yield the things, one after the other, with a progress bar that makes room for lines shown meanwhile."""
        self.progress("")
        count = len(things) if total is None and isinstance(things, Sized) else total
        with Progress(what, count or 0, unit, stream=self._err) as bar:
            self._bar = bar
            try:
                for thing in things:
                    yield thing
                    bar.advance()
            finally:
                self._bar = None

    def _write(self, stream: TextIO, text: str) -> None:
        if self._bar is None:
            self.progress("")
            stream.write(text + "\n")
            stream.flush()
            return
        with self._bar.aside():
            stream.write(text + "\n")
            stream.flush()
