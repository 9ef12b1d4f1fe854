"""Text for a terminal of any width."""

import os
import shutil
import textwrap
from typing import Final, TextIO

FEWEST_COLUMNS: Final = 30


def columns() -> int:
    """Return the width of the terminal, or the default of one, at least FEWEST_COLUMNS."""
    return max(shutil.get_terminal_size().columns, FEWEST_COLUMNS)


def rewritable(stream: TextIO | None) -> bool:
    """Return whether a line can be rewritten in place: on a terminal, unless it knows no escape sequences."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def drawn(stream: TextIO) -> TextIO:
    """Return the stream for text with control characters of our own, which it otherwise escapes."""
    return getattr(stream, "drawn", stream)


def wrapped(text: str, width: int, start: str = "", indent: str = "") -> list[str]:
    """Wrap a paragraph into lines of `width` columns, of which the first begins with `start`, the others with `indent`.

    A wider word stays whole, since paths and options are copied from the text.
    """
    return textwrap.wrap(
        text, width, initial_indent=start, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
