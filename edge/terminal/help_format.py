"""Layout of help texts for a terminal of any width: paragraphs, lists in two columns, and lines to be copied."""

import argparse
import textwrap
from typing import Final

from edge.terminal.text_wrap import FEWEST_COLUMNS

MOST_COLUMNS: Final = 80
_GAP: Final = 2


class HelpFormatter(argparse.HelpFormatter):
    """Formatter that lays out descriptions and epilogues by the form of each line.

    A line with a tab is an entry of a list: a term, and its meaning in the column of the options' meanings. A line that
    begins with a space is kept. Any other line is a paragraph.
    """

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        self._width = max(min(self._width, MOST_COLUMNS), FEWEST_COLUMNS)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(
            indent + line
            for paragraph in text.splitlines()
            for line in self._laid_out(paragraph, self._width - len(indent))
        )

    def _laid_out(self, line: str, width: int) -> list[str]:
        term, tab, meaning = line.partition("\t")
        if not tab:
            return [line] if line.startswith(" ") else textwrap.wrap(line, width) or [""]
        column = min(self._max_help_position, width // 2)
        beside = len(term) + 2 * _GAP <= column
        first = f"{' ' * _GAP}{term}"
        lines = textwrap.wrap(
            meaning,
            width,
            initial_indent=first.ljust(column) if beside else " " * column,
            subsequent_indent=" " * column,
            break_on_hyphens=False,
        )
        return lines if beside else [first, *lines]
