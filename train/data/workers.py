"""Start of joblib's workers with SIGINT ignored, so that an interruption reaches the caller alone."""

import signal

import joblib


def start_workers(jobs: int) -> None:
    """Start joblib's processes with SIGINT ignored, because Ctrl-C reaches them too and each would print a traceback.

    They inherit what is ignored. A mask is not enough: the tracker of resources, which joblib starts before them, lifts
    it. Later calls of joblib with as many jobs use these processes; an interrupted call ends them. Call it from the
    main thread; until it returns, Ctrl-C does nothing.

    Args:
        jobs: processes, -1 for one on each core.
    """
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        joblib.Parallel(n_jobs=jobs)(joblib.delayed(int)() for _ in range(2))
    finally:
        signal.signal(signal.SIGINT, before)
