"""Lines that are drawn on a terminal alone: progress bars of tqdm, for work of more than two seconds, and others."""

import os
import sys
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING, Any, Final, TextIO, TypeVar

from firmware_bridge.errors import harmless

if TYPE_CHECKING:
    from tqdm import tqdm

DELAY_S: Final = 2.0
_Thing = TypeVar("_Thing")


def rewritable(stream: TextIO | None) -> bool:
    """Return whether a line can be rewritten in place: on a terminal, unless it knows no escape sequences."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def drawn(stream: TextIO) -> TextIO:
    """Return the stream for text with control characters of our own, which it otherwise escapes."""
    return getattr(stream, "drawn", stream)


def progress(what: str, total: float, unit: str, *, done: float = 0, stream: TextIO | None = None) -> "tqdm[Any]":  # pyright: ignore[reportInvalidTypeArguments]
    """Return a bar of `total` units of work, of which `done` are finished, each a `unit` such as "pose".

    It is drawn on a stream, stderr by default, only if that is a terminal, and cleared at the end.
    """
    from tqdm import tqdm  # here and not above, since few programs need it

    stream = sys.stderr if stream is None else stream
    return tqdm(
        desc=harmless(what, kept=""),
        total=total,
        initial=done,
        unit=unit,
        unit_scale=True,
        file=None if stream is None else drawn(stream),
        leave=False,
        dynamic_ncols=True,
        disable=not (stream is not None and not stream.closed and stream.isatty()),
        delay=DELAY_S,
    )


def tracked(things: Collection[_Thing], what: str, unit: str) -> Iterator[_Thing]:
    """Yield things one after the other under a bar; each counts when the next is requested."""
    with progress(what, len(things), unit) as bar:
        for thing in things:
            yield thing
            bar.update()
