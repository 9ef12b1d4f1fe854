"""Prefetching of the next batch while a network trains on the current one."""

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Batch = TypeVar("Batch")


def drawn_ahead(batches: Callable[[int], Batch], first: int, end: int) -> Generator[Batch, None, None]:
    """Yield the batches from number `first` to before `end`, each drawn in a thread while the one before is used."""
    with ThreadPoolExecutor(1, "batches") as thread:
        coming = thread.submit(batches, first)
        for number in range(first, end):
            batch = coming.result()
            if number + 1 < end:
                coming = thread.submit(batches, number + 1)
            yield batch
