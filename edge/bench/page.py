"""Where a bench is shown while it goes on: the page on stdout, kept for the file, and one line of progress."""

from typing import TextIO


class Page:
    """Lines that are shown at once and kept; progress is shown on a terminal alone, and overwritten.

    Attributes:
        lines: all that was said.
    """

    def __init__(self, out: TextIO, err: TextIO) -> None:
        self.lines: list[str] = []
        self._out = out
        self._err = err
        self._watched = err.isatty()

    def say(self, text: str) -> None:
        """Show a line, or several, and keep it."""
        self.progress("")
        self.lines.append(text)
        self._out.write(text + "\n")
        self._out.flush()

    def section(self, title: str, text: str, table_head: str) -> None:
        """Begin a section and its table."""
        self.say(f"\n## {title}\n\n{text}\n\n{table_head}")

    def warn(self, text: str) -> None:
        """Show a line on stderr."""
        self.progress("")
        self._err.write(f"edge-sr: {text}\n")
        self._err.flush()

    def progress(self, text: str) -> None:
        """Show what is being done, over what was shown before."""
        if self._watched:
            self._err.write(f"\r\x1b[K{text}")
            self._err.flush()
