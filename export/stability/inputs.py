"""Invalid inputs of a model, refused before inference."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from edge.errors import WindowError
from edge.inference.bundled import find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.runtime import Runtime
from export.stability.case import Case, refused
from firmware_bridge.scans.scan import Scan

PART: Final = "inputs"


def cases(_quick: bool = False) -> Iterator[Case]:
    """Yield the cases of a model in each arithmetic; both share the code that refuses them."""
    for model in ("mtsr4", "mtsr4-int8"):
        session = ModelSession(find_model(model))
        good = np.ones((session.contract.taps, 3, session.contract.rows, session.contract.cols), dtype=np.float32)
        bad = {
            "NaN in one place": _with(good, np.nan),
            "inf in one place": _with(good, np.inf),
            "-inf in one place": _with(good, -np.inf),
            "float64": good.astype(np.float64),
            "int32": good.astype(np.int32),
            "a tap too many": np.concatenate([good, good[:1]]),
            "no tap": good[:0],
            "flat": good.ravel(),
        }
        for name, window in bad.items():
            yield refused(
                PART, session.name, name, lambda session=session, window=window: session.run(window), WindowError
            )
        runtime = Runtime(session, source="replay")
        counts = np.zeros((3, 5, 5), dtype=np.int32)
        scan = Scan("4", 0, 0, counts, np.ones((5, 5), bool), np.ones((5, 5), bool))
        yield refused(
            PART,
            session.name,
            "a scan of 5 x 5 taxels",
            lambda runtime=runtime, scan=scan: runtime.push(scan),
            WindowError,
        )


def _with(window: np.ndarray, value: float) -> np.ndarray:
    changed = window.copy()
    changed[0, 2, 1, 1] = value
    return changed
