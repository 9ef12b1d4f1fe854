"""Progress bar with rate and remaining time for work of more than two seconds, on a terminal alone."""

import os
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any, Final, Self, TextIO, TypeVar

from edge.terminal.text_wrap import drawn
from firmware_bridge.errors import harmless

DELAY_S: Final = 2.0
SECONDS: Final = "s"  # unit of work that lasts for a set time, whose rate means nothing
_Thing = TypeVar("_Thing")


class Progress:
    """Progress of a piece of work on one line, which is cleared at the end, whatever ends it."""

    def __init__(self, what: str, total: float, unit: str, *, done: float = 0, stream: TextIO | None = None) -> None:
        """Begin with `done` units of `total`, each a `unit` such as "pose", or SECONDS; nothing is shown yet.

        The stream, stderr by default, is used only if it is a terminal.
        """
        self._bar: Any = None  # a tqdm, where there is a terminal
        stream = sys.stderr if stream is None else stream
        first = os.environ.get("RANK", "0") == "0"  # of torchrun's processes, which share a terminal
        if first and stream is not None and not stream.closed and stream.isatty():
            from tqdm import tqdm  # here and not above, since few programs run on a terminal

            rate = "" if unit == SECONDS else "{rate_fmt} "
            self._bar = tqdm(
                desc=harmless(what, kept=""),
                total=total,
                initial=done,
                unit=unit,
                unit_scale=True,
                file=drawn(stream),
                leave=False,
                dynamic_ncols=True,
                miniters=0,
                bar_format=f"{{desc}} {{percentage:3.0f}}%|{{bar}}| {rate}{{remaining}} left{{postfix}}",
                delay=DELAY_S,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def advance(self, units: float = 1) -> None:
        """Add finished units."""
        if self._bar is not None:
            self._bar.update(units)

    def reach(self, done: float) -> None:
        """Set the number of finished units."""
        if self._bar is not None:
            self._bar.update(done - self._bar.n)

    def note(self, text: str, *, at_once: bool = False) -> None:
        """Set a few words after the bar, shown with the next step, or at once if that is far off."""
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=at_once and self._shown)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Clear the bar within a with statement, for lines of others on the same terminal."""
        if self._bar is None or not self._shown:
            yield
            return
        self._bar.clear()
        yield
        self._bar.refresh()

    @property
    def _shown(self) -> bool:
        return self._bar is not None and self._bar.last_print_t >= self._bar.start_t + DELAY_S

    def close(self) -> None:
        """Clear the line; repeated calls do no harm."""
        if self._bar is not None:
            self._bar.close()


def tracked(things: Collection[_Thing], what: str, unit: str) -> Iterator[_Thing]:
    """Yield things one after the other under a bar, as for Progress; each counts when the next is requested."""
    with Progress(what, len(things), unit) as progress:
        for thing in things:
            yield thing
            progress.advance()
