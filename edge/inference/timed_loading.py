"""Loading of a model within a time limit, on a thread that can be abandoned.

While onnxruntime loads a graph, and during its first run, Python handles no signal on the calling thread. So the
calling thread only waits, and gives up in time.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from edge.errors import ModelError

if TYPE_CHECKING:
    import onnxruntime

LOAD_LIMIT_S: Final = 60.0
"""Longest load: a thousand times that of the bundled models."""
STOP_S: Final = 0.5
"""Time that each part of a load may still take after a stop was requested: two in a row come before an end by force."""
_POLL_S: Final = 0.1
_THREAD: Final = "edge: loading a model"
_IDENTITY: Final = (
    b"\x08\x08"  # IR version
    b"\x3a\x37\x0a\x10\x0a\x01a\x12\x01b\x22\x08Identity\x12\x01g"  # a graph of one node, from a to b
    b"\x5a\x0f\x0a\x01a\x12\x0a\x0a\x08\x08\x01\x12\x04\x0a\x02\x08\x01"
    b"\x62\x0f\x0a\x01b\x12\x0a\x0a\x08\x08\x01\x12\x04\x0a\x02\x08\x01"
    b"\x42\x02\x10\x0d"  # operator set
)
"""Smallest graph that onnxruntime loads. Source: onnx.proto, ModelProto and its messages."""

Made = TypeVar("Made")


def within_limit(
    work: Callable[[], Made],
    path: Path,
    stop: threading.Event | None = None,
    give_up: Callable[[], object] = lambda: None,
) -> Made:
    """Do a part of loading a model on another thread, and return its value or raise its exception.

    Abandoned work goes on until it ends, `give_up` ends it, or the program ends. See `unfinished_load`.

    Args:
        work: the part to do.
        path: of the model, for the message.
        stop: event that ends the wait early.
        give_up: asks the work to end, and does not wait for it.

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
    """Return whether an abandoned load still goes on; the program must then end by `os._exit`.

    Otherwise onnxruntime may crash at exit, when it frees objects that the thread still uses.
    """
    return any(thread.name == _THREAD for thread in threading.enumerate())


@cache
def flush_denormals(options_of: "Callable[[], onnxruntime.SessionOptions]") -> None:
    """Build a session here: onnxruntime makes denormals zero once in a process, on the thread of the first session."""
    import onnxruntime  # here, so that the command line can call `unfinished_load` without it

    onnxruntime.InferenceSession(_IDENTITY, options_of(), providers=["CPUExecutionProvider"])
