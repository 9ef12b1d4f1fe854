"""Text for a terminal of any width."""

import shutil
import textwrap
from typing import Final

FEWEST_COLUMNS: Final = 30


def columns() -> int:
    """Of the terminal, or what is taken for its width."""
    return max(shutil.get_terminal_size().columns, FEWEST_COLUMNS)


def wrapped(text: str, width: int, start: str = "", indent: str = "") -> list[str]:
    """Text in lines.

    Args:
        text: a paragraph.
        width: of a line, in columns; a word that is wider stays whole, since paths and options are copied from there.
        start: put before the first line.
        indent: put before the others.
    """
    return textwrap.wrap(
        text, width, initial_indent=start, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
