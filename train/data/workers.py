"""Start of joblib's workers with SIGINT blocked, so that an interruption reaches the caller alone."""

import signal

import joblib


def start_workers(jobs: int) -> None:
    """Start joblib's processes with SIGINT blocked, because Ctrl-C reaches them too and each would print a traceback.

    Later calls of joblib with as many jobs use these processes; an interrupted call ends them.

    Args:
        jobs: processes, -1 for one on each core.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        joblib.Parallel(n_jobs=jobs)(joblib.delayed(int)() for _ in range(2))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
