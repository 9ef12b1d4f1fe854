"""Live report of a bench: the page on stdout, kept for the file, and one line of progress."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import TextIO, TypeVar

from edge.terminal.progress_bar import Progress

_Thing = TypeVar("_Thing")


def line(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


class Page:
    """Page of lines that are shown at once and kept; progress is shown on a terminal alone, and overwritten.

    Attributes:
        lines: all lines so far.
    """

    def __init__(self, out: TextIO, err: TextIO) -> None:
        self.lines: list[str] = []
        self._out, self._err = out, err
        self._bar: Progress | None = None

    def say(self, text: str) -> None:
        """Show a line, or several, and keep it."""
        self.lines.append(text)
        self._write(self._out, text)

    def section(self, title: str, text: str, columns: Sequence[str]) -> None:
        """Begin a section and its table."""
        self.say(f"\n## {title}\n\n{text}\n\n{line(columns)}\n{'|---' * len(columns)}|")

    def warn(self, text: str) -> None:
        """Show a line on stderr."""
        self._write(self._err, f"edge-sr: {text}")

    def progress(self, text: str) -> None:
        """Show the current step after the bar."""
        if self._bar is not None:
            self._bar.note(text, at_once=True)

    def tracked(self, things: Sequence[_Thing], what: str) -> Iterator[_Thing]:
        """Yield the things, one after the other, with a progress bar that makes room for lines shown meanwhile."""
        with Progress(what, len(things), "row", stream=self._err) as bar:
            self._bar = bar
            try:
                for thing in things:
                    yield thing
                    bar.advance()
            finally:
                self._bar = None

    def _write(self, stream: TextIO, text: str) -> None:
        with nullcontext() if self._bar is None else self._bar.aside():
            stream.write(text + "\n")
            stream.flush()
