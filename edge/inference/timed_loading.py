"""Loading of a model within a time limit, on a thread that can be abandoned.

While onnxruntime loads a graph, and during its first run, Python handles no signal on the calling thread. So the
calling thread only waits, and gives up in time.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Final, TypeVar

from edge.errors import ModelError

LOAD_LIMIT_S: Final = 60.0  # longest load: a thousand times that of the bundled models
STOP_S: Final = 0.5
"""Time that each part of a load may still take after a stop was requested: two in a row come before an end by force."""
_POLL_S: Final = 0.1
_THREAD: Final = "edge: loading a model"

Made = TypeVar("Made")


def within_limit(
    work: Callable[[], Made],
    path: Path,
    stop: threading.Event | None = None,
    give_up: Callable[[], object] = lambda: None,
) -> Made:
    """Do a part of loading a model on another thread, and return its value or raise its exception.

    Abandoned work goes on until it ends, `give_up` ends it without waiting for that, or the program ends.

    Raises:
        ModelError: it was not done within LOAD_LIMIT_S, or STOP_S after `stop`.
    """
    made = Future[Made]()

    def run() -> None:
        try:
            made.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised below, on the thread that waits
            made.set_exception(error)

    threading.Thread(target=run, name=_THREAD, daemon=True).start()
    until_s, asked_s = time.monotonic() + LOAD_LIMIT_S, None
    while not wait([made], _POLL_S).done:
        now_s = time.monotonic()
        if asked_s is None and stop is not None and stop.is_set():
            asked_s = now_s
        if asked_s is not None and now_s > asked_s + STOP_S:
            give_up()
            raise ModelError(f"{path}: stopped before it was loaded")
        if now_s > until_s:
            give_up()
            raise ModelError(f"{path}: not loaded within {LOAD_LIMIT_S:g} s: export a smaller graph")
    return made.result()


def unfinished_load() -> bool:
    """Return whether an abandoned load goes on; `os._exit` must end the program then, or onnxruntime may crash."""
    return any(thread.name == _THREAD for thread in threading.enumerate())
