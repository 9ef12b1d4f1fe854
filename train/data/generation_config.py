"""Means to make a set again with the same bytes: its seed, one thread, and the hash of a user's file."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import torch
from threadpoolctl import threadpool_limits

from train.errors import DatasetError
from train.surfaces.meshes import mesh_file

SEED: Final = 20240228
"""Seed of all frozen sets: the paper's day of publication. It must never change, or figures cannot be compared."""


def mesh_sha256(name: str) -> str:
    """Return the hash of a user's file, because the content under a name may change."""
    try:
        return hashlib.sha256(mesh_file(name)[0].read_bytes()).hexdigest()
    except OSError as error:
        raise DatasetError(f"{name} cannot be read: {error.strerror or error}") from error


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
