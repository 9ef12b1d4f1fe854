"""Means to make a set again with the same bytes: its seed, one thread, quiet workers, and the hash of a user's file."""

import hashlib
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import joblib
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


@contextmanager
def quiet_workers(jobs: int) -> Iterator[None]:
    """Start joblib's processes with SIGINT ignored, because Ctrl-C reaches them too and each would print a traceback.

    They inherit what is ignored; a mask is not enough, since joblib's tracker of resources lifts it. joblib replaces a
    process that has grown by 300 MB by another, which inherits nothing and sets for itself what it ignores; its warning
    of that is left out. Enter from the main thread.
    """
    with joblib.parallel_config("loky", initializer=_begin_quietly), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            joblib.Parallel(n_jobs=jobs)(joblib.delayed(int)() for _ in range(2))
        finally:
            signal.signal(signal.SIGINT, before)
        yield


def _begin_quietly() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # shapely divides by the length of an edge, and leaves out those without length afterwards.
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="shapely")
