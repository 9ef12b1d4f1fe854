"""Common parts of all commands: text as wide as the terminal, one line for wrong usage, and types of numbers."""

import argparse
import math
import re
import shutil
import textwrap
from collections.abc import Callable
from typing import Any, Final, NoReturn

from edge import __version__
from firmware_bridge.schedule import POSITIVE

FEWEST_COLUMNS: Final = 30


def columns() -> int:
    """Return the width of the terminal, or the default of one, at least FEWEST_COLUMNS."""
    return max(shutil.get_terminal_size().columns, FEWEST_COLUMNS)


def wrapped(text: str, width: int, start: str = "", indent: str = "") -> list[str]:
    """Wrap a paragraph after `start`, further lines after `indent`; a wider word stays whole, as it may be copied."""
    return textwrap.wrap(
        text, width, initial_indent=start, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


class HelpFormatter(argparse.HelpFormatter):
    """Formatter that keeps lines which begin with a space, and makes of others a paragraph, or an entry at a tab.

    An entry of a list is a term, and its meaning in the column of the options' meanings.
    """

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        self._width = max(min(self._width, 80), FEWEST_COLUMNS)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(line for paragraph in text.splitlines() for line in self._laid_out(paragraph))

    def _laid_out(self, line: str) -> list[str]:
        term, tab, meaning = line.partition("\t")
        if not tab:
            return [line] if line.startswith(" ") else wrapped(line, self._width) or [""]
        column = min(self._max_help_position, self._width // 2)
        first, indent = f"  {term}", " " * column
        if len(first) + 2 <= column:
            return wrapped(meaning, self._width, first.ljust(column), indent)
        return [first, *wrapped(meaning, self._width, indent, indent)]


EXIT_USAGE: Final = 2


class Parser(argparse.ArgumentParser):
    """Argument parser that reports wrong usage in one line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=HelpFormatter, allow_abbrev=False, **settings)
        self.add_argument("--version", action="version", version=f"edge-sr {__version__}", help="show the version")

    def error(self, message: str) -> NoReturn:
        """End with the message, the option that was meant, and a hint at the help."""
        from difflib import get_close_matches

        named = re.search(r"unrecognized arguments: (--[\w-]+)", message)
        near = get_close_matches(named[1], self._option_string_actions, n=1) if named else ()
        meant = f"did you mean {near[0]}? " if near else ""
        self.exit(EXIT_USAGE, f"edge-sr: {message} ({meant}{self.prog} --help lists all options)\n")


def positive(text: str, low: float = POSITIVE[0], high: float = POSITIVE[1]) -> float:
    """Parse a positive number in a range."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number, {low:g} to {high:g}")
    return value


def not_negative(text: str) -> float:
    """Parse a number of 0 or more."""
    return 0.0 if text == "0" else positive(text)


def whole(least: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from `least`."""

    def whole_number(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < 10) or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")
        return int(text)

    return whole_number


def port(text: str) -> int:
    """Parse a port of this machine; 0 stands for any free one."""
    if not (text.isascii() and text.isdigit() and len(text) < 10) or int(text) > 65535:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a port: expected 0 to 65535, or none; write FILE or command before it"
        )
    return int(text)
