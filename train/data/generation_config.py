"""Means to make a set again with the same bytes: its seed, and one thread."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import torch
from threadpoolctl import threadpool_limits

SEED: Final = 20240228
"""Seed of all frozen sets: the paper's day of publication. It must never change, or figures cannot be compared."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and BLAS to one thread each: a sum split over threads differs in its last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)
