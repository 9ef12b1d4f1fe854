"""The scheduling that `--realtime` asks the system for: each part on its own, and in one line what was refused.

SCHED_FIFO lets the process run before every ordinary one; threads that it starts inherit it, so the reader stands no
lower than the loop. The pin keeps its caches warm, on the last of the processors it may use, since interrupts and
everything else tend to the first. Locked memory cannot be paged out. The kernel still takes back 5 % of each second
from threads that never rest (/proc/sys/kernel/sched_rt_runtime_us); these rest between scans.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

PRIORITY: Final = 20
"""Modest: above every ordinary process, below the kernel's interrupt threads (50)."""
MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
MCL_ONFAULT: Final = 4
"""Only what is used: the untouched part of every thread's stack would be 8 MB each."""

_SCHEDULER_REMEDY: Final = "a line '@GROUP - rtprio 20' in /etc/security/limits.conf, or CAP_SYS_NICE, permits it"
_MEMORY_REMEDY: Final = "'ulimit -l unlimited', a line '@GROUP - memlock unlimited' there, or CAP_IPC_LOCK, permits it"


@contextmanager
def realtime(tell: Callable[[str], object]) -> Iterator[None]:
    """Run in real time as far as is permitted, and as before afterwards; call it before threads are started.

    Args:
        tell: gets one line for each part that is not to be had; the run goes on without it.
    """
    if sys.platform != "linux":
        tell(f"--realtime: not on {sys.platform}, only on Linux; going on without")
        yield
        return
    with ExitStack() as undo:
        for name, remedy, begin in (
            ("SCHED_FIFO", _SCHEDULER_REMEDY, _schedule),
            ("one processor of its own", "the container or cgroup must permit it", _pin),
            ("locked memory", _MEMORY_REMEDY, _lock_memory),
        ):
            try:
                undo.callback(begin())
            except OSError as error:
                tell(f"--realtime: no {name}: {error.strerror}; {remedy}; going on without")
        yield


def _schedule() -> Callable[[], object]:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    return lambda: os.sched_setscheduler(0, policy, parameters)


def _pin() -> Callable[[], object]:
    allowed = os.sched_getaffinity(0)
    if len(allowed) > 1:  # nothing is gained on the only one
        os.sched_setaffinity(0, {max(allowed)})
    return lambda: os.sched_setaffinity(0, allowed)


def _lock_memory() -> Callable[[], object]:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return libc.munlockall
