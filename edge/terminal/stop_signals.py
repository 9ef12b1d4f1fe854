"""Stop event on Ctrl-C and similar signals, so that a run ends after the scans in hand."""

import contextlib
import signal
import threading
from collections.abc import Iterator

from edge.terminal.forced_end import ended_in_time


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that the first signal sets; the block then has END_S to end. A second signal ends it at once."""
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {getattr(signal, name): signal.signal(getattr(signal, name), handle) for name in names}
    try:
        with ended_in_time(before):
            yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
