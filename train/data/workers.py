"""Joblib's workers, started so that an interruption is the caller's alone."""

import signal

import joblib


def start_workers(jobs: int) -> None:
    """Start joblib's processes with SIGINT blocked: a terminal sends Ctrl-C to them too, and each would complain of it.

    Whoever calls joblib next with as many jobs is given them; one that is interrupted ends them.

    Args:
        jobs: processes, -1 for one on each core.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        joblib.Parallel(n_jobs=jobs)(joblib.delayed(int)() for _ in range(2))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
