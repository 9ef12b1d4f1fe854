"""End of a program on Ctrl-C and similar signals: after the scans in hand, and if necessary by force.

Python runs a handler of signals between two steps of its main thread, and so never while a call into a library does
not return: a model that loops, a pipe that is full, a peer that is gone. The system's own part of a handler runs all
the same, and wakes a thread here.
"""

import contextlib
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, TypeVar

END_S: Final = 1.5  # time from the signal to the end by force, within the two seconds that are promised
STALLED_S: Final = 10.0  # longest pause in the growth of a recording that is being finished, since its disk may be busy
EXIT_FORCED: Final = 6
_LOOK_S: Final = 0.1
_STDERR: Final = 2
_READ_BYTES: Final = 64

_Thing = TypeVar("_Thing")
_finishing: list[Path] = []
_before_force: list[Callable[[], object]] = []


@contextlib.contextmanager
def handled(names: Iterable[str], handle: Callable[[int, Any], object]) -> Iterator[dict[int, Any]]:
    """Handle signals within a with statement, and yield their former handlers by number.

    Signals that the parent has this program ignore stay ignored: nohup does so with a hang-up, and a shell without jobs
    with the Ctrl-C that is meant for another program in front.
    """
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, handle)
    try:
        yield before
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

    with handled(("SIGINT", "SIGTERM", "SIGHUP"), handle) as numbers, _ended_in_time(numbers):
        yield stop


@contextlib.contextmanager
def _ended_in_time(numbers: Collection[int]) -> Iterator[None]:
    """End the process by force, with EXIT_FORCED, if the with block lasts longer than END_S after one of these signals.

    Files that are being finished get the time they need for as long as they grow. Main thread alone.
    """
    waking, woken = socket.socketpair()
    woken.setblocking(False)
    before = signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=_watch, args=(waking, numbers), name="ending", daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        woken.close()  # which ends the thread
        thread.join()
        waking.close()


def finishing(path: Path) -> contextlib.AbstractContextManager[None]:
    """Allow a file the time it takes to finish it, although the program was asked to end."""
    return _kept(_finishing, path)


def before_force(act: Callable[[], object]) -> contextlib.AbstractContextManager[None]:
    """Register an action to do before an end of the process by force; it must be short and never wait."""
    return _kept(_before_force, act)


@contextlib.contextmanager
def _kept(things: list[_Thing], thing: _Thing) -> Iterator[None]:
    things.append(thing)
    try:
        yield
    finally:
        things.remove(thing)


def _watch(waking: socket.socket, numbers: Collection[int]) -> None:
    while not set(numbers) & set(received := waking.recv(_READ_BYTES)):
        if not received:
            return
    files, left_s = _sizes(), END_S
    waking.settimeout(_LOOK_S)
    # Counted in waits, not by the clock: where a busy machine delays this thread, it delays what it waits for too.
    while left_s > 0:
        with contextlib.suppress(TimeoutError):
            if not waking.recv(_READ_BYTES):
                return
        before, files = files, _sizes()
        left_s = left_s - _LOOK_S if files == before else STALLED_S if files else END_S
    _force()


def _sizes() -> dict[Path, int]:
    """Return the files that are being finished, with their sizes in bytes."""
    sizes: dict[Path, int] = {}
    for path in tuple(_finishing):
        try:
            sizes[path] = path.stat().st_size
        except OSError:  # not begun yet, or already under its last name
            sizes[path] = 0
    return sizes


def _force() -> None:
    for act in tuple(_before_force):
        act()
    line = f"edge-sr: not ended {END_S:g} s after the signal, still in {_where()}: ended by force\n"
    with contextlib.suppress(OSError):
        if select.select([], [_STDERR], [], 0)[1]:  # an unread pipe may be what blocks the program
            os.write(_STDERR, line.encode(errors="replace"))
    os._exit(EXIT_FORCED)


def _where() -> str:
    """Return the function that the main thread has not returned from, with its file and line."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    if frame is None:
        return "its end"
    return f"{frame.f_code.co_qualname} ({'/'.join(Path(frame.f_code.co_filename).parts[-2:])}, line {frame.f_lineno})"
