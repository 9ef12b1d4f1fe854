"""Progress bar with rate and remaining time for work of more than two seconds, on a terminal alone."""

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Self, TextIO, TypeVar

from edge.terminal.text_wrap import drawn
from firmware_bridge.errors import harmless

if TYPE_CHECKING:
    from tqdm import tqdm

DELAY_S: Final = 2.0
_RANK, _FIRST = "RANK", "0"
"""Variable and value of the first of torchrun's processes, which share a terminal; it alone shows its bars."""
_COUNTED: Final = "{desc} {percentage:3.0f}%|{bar}| {rate_fmt} {remaining} left{postfix}"
_TIMED: Final = "{desc} {percentage:3.0f}%|{bar}| {remaining} left{postfix}"
SECONDS: Final = "s"
"""Unit of work that lasts for a set time, whose rate means nothing."""
_Thing = TypeVar("_Thing")


class Progress:
    """Progress of a piece of work on one line, which is cleared at the end, whatever ends it."""

    def __init__(
        self,
        what: str,
        total: float,
        unit: str,
        *,
        done: float = 0,
        stream: TextIO | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        delay_s: float = DELAY_S,
    ) -> None:
        """Begin; nothing is shown yet.

        Args:
            what: name of the work, in a word or two.
            total: units of the whole work.
            unit: in the singular, such as "pose"; SECONDS for a wait.
            done: units that were finished before, and took no time now.
            stream: output, used only if it is a terminal; stderr by default.
            clock_s: monotonic, in [s].
            delay_s: time before the bar appears, in [s].
        """
        self._what, self._total, self._unit = harmless(what, kept=""), total, unit
        self._before = self._done = done
        self._note = ""
        self._stream = sys.stderr if stream is None else stream
        self._clock_s = clock_s
        self._begun_s = clock_s()
        self._delay_s = delay_s
        self._bar: tqdm[Any] | None = None
        first = os.environ.get(_RANK, _FIRST) == _FIRST
        self._watched = first and self._stream is not None and not self._stream.closed and self._stream.isatty()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def advance(self, units: float = 1) -> None:
        """Add finished units."""
        self.reach(self._done + units)

    def reach(self, done: float) -> None:
        """Set the number of finished units."""
        more, self._done = done - self._done, done
        if self._bar is not None:
            self._bar.update(more)
        elif self._watched and self._clock_s() - self._begun_s >= self._delay_s:
            self._show()

    def note(self, text: str, *, at_once: bool = False) -> None:
        """Set a few words after the bar, shown with the next step, or at once if that is far off."""
        self._note = text
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=at_once)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Clear the bar within a with statement, for lines of others on the same terminal."""
        if self._bar is not None:
            self._bar.clear()
        yield
        if self._bar is not None:
            self._bar.refresh()

    def close(self) -> None:
        """Clear the line; repeated calls do no harm."""
        self._watched = False
        if self._bar is not None:
            self._bar.close()

    def _show(self) -> None:
        from tqdm import tqdm  # here and not above, since most work is over before

        waited_s = self._clock_s() - self._begun_s
        bar = tqdm(
            desc=self._what,
            total=self._total,
            initial=self._before,
            unit=self._unit,
            unit_scale=True,
            file=drawn(self._stream),
            leave=False,
            dynamic_ncols=True,
            miniters=0,
            bar_format=_TIMED if self._unit == SECONDS else _COUNTED,
            delay=1e-9,  # its first bar would have no rate
        )
        bar.last_print_t -= waited_s  # the rate counts from the start of the work, not of the bar
        bar.set_postfix_str(self._note, refresh=False)
        bar.update(self._done - self._before)
        self._bar = bar


def tracked(things: Iterable[_Thing], what: str, unit: str, total: int | None = None) -> Iterator[_Thing]:
    """Yield things one after the other under a bar; each counts when the next is requested.

    `what` and `unit` are those of Progress; `total` is the number of things, if they have no length.
    """
    count = len(things) if total is None and isinstance(things, Sized) else total
    if count is None:
        raise TypeError("the sequence has no length: pass `total`")
    with Progress(what, count, unit) as progress:
        for thing in things:
            yield thing
            progress.advance()
