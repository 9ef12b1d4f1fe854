"""Stop event on Ctrl-C and similar signals, so that a run ends after the scans in hand."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator

from edge.terminal.forced_end import ended_in_time


@contextlib.contextmanager
def handled(names: Iterable[str], handle: Callable[[int, object], object]) -> Iterator[list[int]]:
    """Handle signals within a with statement, and yield their numbers.

    Signals that the parent has this program ignore stay ignored: nohup does so with a hang-up, and a shell without jobs
    with the Ctrl-C that is meant for another program in front.
    """
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, handle)
    try:
        yield list(before)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that the first signal sets; the block then has END_S to end. A second signal ends it at once."""
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    with handled(("SIGINT", "SIGTERM", "SIGHUP"), handle) as numbers, ended_in_time(numbers):
        yield stop
