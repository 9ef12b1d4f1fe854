"""End of a program on Ctrl-C and similar signals: after the scans in hand, and if necessary by force.

Python runs no handler while a call into a library does not return: a model that loops, a pipe that is full. The
system's own part of a handler runs all the same, and wakes a thread here.
"""

import contextlib
import os
import select
import signal
import socket
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, Final

END_S: Final = 5.0  # time from the signal to the end by force
STDIN, STDOUT, STDERR = 0, 1, 2


@contextlib.contextmanager
def handled(names: Iterable[str], handle: Callable[[int, Any], object]) -> Iterator[Collection[int]]:
    """Handle signals within a with statement, and yield their numbers."""
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    # What the parent ignores stays so: a hang-up under nohup, Ctrl-C that is for another program.
    before = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, handle)
    try:
        yield before.keys()
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

    waking, woken = socket.socketpair()
    woken.setblocking(False)
    with handled(("SIGINT", "SIGTERM", "SIGHUP"), handle) as numbers:
        before = signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
        thread = threading.Thread(target=_watch, args=(waking, numbers), name="ending", daemon=True)
        thread.start()
        try:
            yield stop
        finally:
            signal.set_wakeup_fd(before)
            woken.close()  # which ends the thread
            thread.join()
            waking.close()


def _watch(waking: socket.socket, numbers: Collection[int]) -> None:
    """Kill the process if it goes on for END_S after the last of these signals."""
    while True:
        try:
            received = waking.recv(64)
        except TimeoutError:
            with contextlib.suppress(OSError):
                if select.select([], [STDERR], [], 0)[1]:  # an unread pipe may be what blocks the program
                    os.write(STDERR, f"edge-sr: not ended {END_S:g} s after the signal: ended by force\n".encode())
            os.kill(os.getpid(), signal.SIGKILL)  # a shell restores the terminal after a signal, not after an exit
            os._exit(128 + signal.SIGKILL)  # the first process of a container cannot be killed by one within
        if not received:
            return
        if set(numbers) & set(received):
            waking.settimeout(END_S)
