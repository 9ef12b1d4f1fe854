"""Real-time scheduling of `--realtime`: each part requested on its own, with one line for each that is refused."""

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Final

PRIORITY: Final = 20  # modest priority: above every ordinary process, below the kernel's interrupt threads (50)


@contextmanager
def realtime(tell: Callable[[str], object], thread_ids: Sequence[int] = ()) -> Iterator[None]:
    """Run this thread, and those that it waits for, in real time as far as is permitted, and as before afterwards.

    `tell` is called with one line for each part that is refused; the run continues without it. `thread_ids` are the
    system's numbers of the other threads. A thread begun meanwhile is ordinary, on this processor.
    """
    if sys.platform != "linux":
        tell(f"--realtime: not on {sys.platform}, only on Linux; going on without")
        yield
        return
    threads = (0, *thread_ids)  # 0 is the caller's own
    rights = "a line '@GROUP - rtprio 20' in /etc/security/limits.conf, or CAP_SYS_NICE, permits it"
    memory = "'ulimit -l unlimited', a line '@GROUP - memlock unlimited' there, or CAP_IPC_LOCK, permits it"
    with ExitStack() as undo:
        for name, remedy, begin in (
            ("SCHED_FIFO", rights, partial(_schedule, threads)),
            ("one processor of its own", "the container or cgroup must permit it", partial(_pin, threads)),
            ("locked memory", memory, lock_memory),
        ):
            try:
                undo.callback(begin())
            except OSError as error:
                tell(f"--realtime: no {name}: {error.strerror}; {remedy}; going on without")
        yield


def _each(threads: Sequence[int], act: Callable[[int], None]) -> None:
    for thread in threads:
        with suppress(ProcessLookupError):  # it has ended, and its link with it
            act(thread)


def _schedule(threads: Sequence[int]) -> Callable[[], object]:
    def schedule(policy: int, parameters: os.sched_param) -> None:
        # Threads that these begin start as ordinary ones. The flag stays afterwards: to clear it needs a privilege.
        policy |= os.SCHED_RESET_ON_FORK
        _each(threads, lambda thread: os.sched_setscheduler(thread, policy, parameters))

    before = os.sched_getscheduler(0), os.sched_getparam(0)
    schedule(os.SCHED_FIFO, os.sched_param(PRIORITY))
    return lambda: schedule(*before)


def _pin(threads: Sequence[int]) -> Callable[[], object]:
    """Pin them to the last processor that may be used: interrupts and most other work run on the first."""
    allowed = os.sched_getaffinity(0)

    def pin(processors: set[int]) -> None:
        _each(threads, lambda thread: os.sched_setaffinity(thread, processors))

    if len(allowed) > 1:  # a single processor gains nothing
        pin({max(allowed)})
    return lambda: pin(allowed)


def lock_memory() -> Callable[[], object]:
    """Keep the used memory of this process in RAM, and return what gives it back."""
    libc = ctypes.CDLL(None, use_errno=True)
    # MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT, which locks only used memory: the stack of a thread alone would be 8 MB.
    if libc.mlockall(1 | 2 | 4) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return libc.munlockall
