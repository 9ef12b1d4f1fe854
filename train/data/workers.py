"""Workers of joblib that ignore SIGINT, so that Ctrl-C reaches the caller alone, and leave two warnings out."""

import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import joblib


@contextmanager
def quiet_workers(jobs: int) -> Iterator[None]:
    """Start joblib's processes with SIGINT ignored, because Ctrl-C reaches them too and each would print a traceback.

    They inherit what is ignored. A mask is not enough: the tracker of resources, which joblib starts before them, lifts
    it. Calls of joblib with as many jobs in the with statement use these processes, and those that replace them: joblib
    ends a process that has grown by 300 MB, and another, which inherits nothing, sets for itself what it ignores. An
    interrupted call ends them. Enter from the main thread; until then, Ctrl-C does nothing. joblib's warning of a
    process that it has ended is left out, since another one does its work.
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
