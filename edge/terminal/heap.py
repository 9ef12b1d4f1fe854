"""Heap of a program of its own: one for all threads, and what loading left is given back to the system.

A network takes more memory while it is loaded than afterwards, and glibc gives each thread a heap of its own, in which
other threads' free memory is of no use. Other C libraries have neither, and stay as they are.
"""

import ctypes
from typing import Final

_M_ARENA_MAX: Final = -8  # number of the setting in glibc's malloc.h


def share_one_heap() -> None:
    """Let all threads that begin from now on allocate in the heap of the first one."""
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_ARENA_MAX, 1)


def give_back() -> None:
    """Give free memory back to the system."""
    if (malloc_trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        malloc_trim(ctypes.c_size_t(0))
