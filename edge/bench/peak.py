"""Peak of the machine: large matrix products.

numpy's BLAS may know less of a processor than onnxruntime does (on a new one it may fall back to instructions of half
the width), and the largest product may wait for memory. So the best of both, over several sizes, is the peak.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.inference.onnx_session import load_session

SIZES: Final = (256, 384, 512, 1024, 1536)
SEED: Final = 0
_BUDGET_NS: Final = 100_000_000
_LEAST_TRIES: Final = 3


def peak_gmac_s(threads: int, sizes: tuple[int, ...] = SIZES) -> float:
    """Return the best of several square float32 products, in [10^9 multiply-accumulates per second].

    Args:
        threads: of onnxruntime; numpy's BLAS takes those of the process's environment.
        sizes: rows and columns of the factors.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.onnx"
        path.write_bytes(product_model())
        session: Any = load_session(path, threads)
    best = 0.0
    for size in sizes:
        a, b = np.random.default_rng(SEED).standard_normal((2, size, size), dtype=np.float32)
        out = np.empty_like(a)
        best = max(
            best,
            size**3 / _shortest_ns(lambda a=a, b=b: session.run(None, {"a": a, "b": b})),
            size**3 / _shortest_ns(lambda a=a, b=b, out=out: np.matmul(a, b, out=out)),
        )
    return best


def _shortest_ns(work: Callable[[], object]) -> int:
    took_ns: list[int] = []
    while len(took_ns) < _LEAST_TRIES or sum(took_ns) < _BUDGET_NS:
        start_ns = time.perf_counter_ns()
        work()
        took_ns.append(time.perf_counter_ns() - start_ns)
    return min(took_ns)


def product_model() -> bytes:
    """Return an ONNX file of c = a b for matrices of any size, written by hand because the runtime has no such library.

    Source: onnx.proto, ModelProto and the messages in it.
    """
    two_dimensions = _field(2, _field(1, b"") * 2)
    float_tensor = _field(1, _number(1, 1) + two_dimensions)
    values = {name: _field(1, name.encode()) + _field(2, float_tensor) for name in "abc"}
    node = _field(1, b"a") + _field(1, b"b") + _field(2, b"c") + _field(4, b"MatMul")
    graph = _field(1, node) + _field(2, b"product")
    graph += _field(11, values["a"]) + _field(11, values["b"]) + _field(12, values["c"])
    ir_version, opset = 8, 13
    return _number(1, ir_version) + _field(7, graph) + _field(8, _number(2, opset))


def _field(number: int, content: bytes) -> bytes:
    """Encode a field of fewer than 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content


def _number(number: int, value: int) -> bytes:
    """Encode a field of a number below 128."""
    return bytes([number << 3, value])
