"""What the runtime's tests share: a tiny real model, a sensor at rest and under load, links that are scripts."""

import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from edge.contract import DEVIATION_NAME, INPUT_NAME, OUTPUT_NAME, Contract
from edge.sinks.base import Sink
from firmware_bridge.baseline import Baseline
from firmware_bridge.links.base import Link
from firmware_bridge.scan import ABSENT, Scan

ROOT = Path(__file__).parent.parent
PERIOD_NS = 10_000_000
TINY_DOUBT = 0.01
REST = (
    np.array([16_000, 16_400, 38_600], dtype=np.int32)[:, None, None] + np.arange(16, dtype=np.int32).reshape(4, 4) * 37
)
BASELINE = Baseline.of("4", REST, created_unix_s=1000.0, scans=100, origin="file")


def make_contract(**changes) -> Contract:
    values = {
        "version": 4,
        "batch": 1,
        "taps": 4,
        "scale": 10,
        "tap_order": "newest first",
        "angle_step_deg": 5.0,
        "counts_per_unit": (500.0, 500.0, 1000.0),
        "output_unit": "mm",
        "output_full_scale": 2.0,
        "contact_level": 0.25,
        "sensor": "uSPa44",
        "rows": 4,
        "cols": 4,
        "pitch_mm": 4.7,
        "arithmetic": "float32",
        "interval_factor": None,
        "confidence": {},
        "training_sha256": "ab" * 32,
        "test_set_sha256": "cd" * 32,
        "test_error": {"1": {"psnr_db": 30.1}, "4": {"psnr_db": 33.2, "rmse_percent": 2.1}},
    }
    return Contract(**(values | changes))


def write_model(
    path: Path,
    contract: Contract | None = None,
    *,
    metadata: dict[str, str] | None = None,
    input_name: str = INPUT_NAME,
    output_name: str = OUTPUT_NAME,
    with_deviation: bool | None = None,
    doubt: float = TINY_DOUBT,
    input_shape: list | None = None,
    element_type: int = TensorProto.FLOAT,
    gain: float = 1.0,
) -> Path:
    """A real graph: every taxel's z becomes a square of pixels, a tenth as strong for each earlier tap.

    The deviation, there if the contract has a factor for it unless asked otherwise, is `tiny_deviation`.
    """
    contract = contract or make_contract()
    with_deviation = contract.interval_factor is not None if with_deviation is None else with_deviation
    taps, scale = contract.taps, contract.scale
    weights = np.zeros((3 * taps, 1, scale, scale), dtype=np.float32)
    for tap in range(taps):
        weights[3 * tap + 2] = gain * 10.0**-tap
    shape = [(input_shape or [contract.batch])[0], *contract.pattern_shape]
    doubts = [
        helper.make_node("Abs", [output_name], ["size"]),
        helper.make_node("Mul", ["size", "doubt"], ["doubted"]),
        helper.make_node("Add", ["doubted", "doubt"], [DEVIATION_NAME]),
    ]
    output_names = [output_name, DEVIATION_NAME] if with_deviation else [output_name]
    graph = helper.make_graph(
        [
            helper.make_node("Cast", [input_name], ["floats"], to=TensorProto.FLOAT),
            helper.make_node("ConvTranspose", ["floats", "weights"], ["squares"], strides=[scale, scale]),
            helper.make_node("Squeeze", ["squares", "axis"], [output_name]),
            *(doubts if with_deviation else []),
        ],
        "tiny",
        [helper.make_tensor_value_info(input_name, element_type, input_shape or list(contract.window_shape))],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in output_names],
        [
            numpy_helper.from_array(weights, "weights"),
            numpy_helper.from_array(np.array([1]), "axis"),
            numpy_helper.from_array(np.array(doubt, dtype=np.float32), "doubt"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    helper.set_model_props(model, contract.to_metadata() if metadata is None else metadata)
    onnx.save(model, path)
    return path


def tiny_pattern(window_units: np.ndarray, scale: int = 10) -> np.ndarray:
    """What the tiny model makes of a window (taps, 3, rows, cols) in network units."""
    z = sum(window_units[tap, 2] * 10.0**-tap for tap in range(len(window_units)))
    return np.kron(z, np.ones((scale, scale)))


def tiny_deviation(pattern: np.ndarray) -> np.ndarray:
    """What the tiny model says of its pattern's deviation."""
    return TINY_DOUBT * (1 + np.abs(pattern))


def make_scan(
    number: int = 0,
    *,
    press_counts: float = 0.0,
    taxel: int = 5,
    sensor: str = "4",
    absent: tuple[int, ...] = (),
    stale: tuple[int, ...] = (),
    time_ns: int | None = None,
    noise: int = 0,
) -> Scan:
    """A scan with one taxel pressed; `absent` taxels gave no reading, `stale` ones are not renewed."""
    counts = REST.copy()
    counts[2].flat[taxel] += int(press_counts)
    if noise:
        counts += np.random.default_rng(number).integers(-noise, noise + 1, counts.shape, dtype=np.int32)
    fresh = np.ones((4, 4), dtype=bool)
    fresh.flat[list(absent)] = False
    renewed = fresh.copy()
    renewed.flat[list(stale)] = False
    counts[:, ~fresh] = ABSENT
    time_ns = (number + 1) * PERIOD_NS if time_ns is None else time_ns
    return Scan(sensor, number, time_ns, counts, fresh, renewed)


@contextmanager
def ended(process: subprocess.Popen, within_s: float = 60) -> Iterator[subprocess.Popen]:
    """Kills what is not over when the block is, or, so that nobody reads for ever, by then."""
    alarm = threading.Timer(within_s, process.kill)
    alarm.start()
    with process:
        try:
            yield process
        finally:
            alarm.cancel()
            process.kill()


class FakeModel:
    """The tiny model without onnxruntime; `on_run` is called before each run."""

    def __init__(self, contract: Contract | None = None, on_run=lambda: None) -> None:
        self.name = "fake"
        self.contract = contract or make_contract()
        self.windows: list[np.ndarray] = []
        self.deviation: np.ndarray | None = None
        self._on_run = on_run

    def run(self, window: np.ndarray) -> np.ndarray:
        self._on_run()
        self.windows.append(window.copy())
        pattern = tiny_pattern(window).astype(np.float32)
        if self.contract.interval_factor is not None:
            self.deviation = tiny_deviation(pattern)
        return pattern

    def run_together(self, windows: list[np.ndarray]) -> np.ndarray:
        patterns, deviations = [], []
        for window in windows:
            patterns.append(self.run(window))
            deviations.append(self.deviation)
        self.deviation = None if deviations[0] is None else np.stack(deviations)
        return np.stack(patterns)


class FakeLink(Link):
    """Gives one batch of scans at each read, waiting where a batch is an event; then ends, or fails."""

    def __init__(self, batches, *, error: Exception | None = None, kind="device", endless: bool = False) -> None:
        self.name = "fake"
        self.kind = kind
        self.ended = False
        self.reads = 0
        self.thread: threading.Thread | None = None
        self._batches = list(batches)
        self._error = error
        self._endless = endless
        self._given = 0

    def __enter__(self):
        return self

    def __exit__(self, *exc_info):
        pass

    def read(self, timeout_s: float) -> list[Scan]:
        self.thread = threading.current_thread()
        self.reads += 1
        if not self._batches:
            if self._error is not None:
                raise self._error
            if self._endless:
                time.sleep(min(timeout_s, 0.01))
                return []
            self.ended = True
            return []
        batch = self._batches.pop(0)
        if isinstance(batch, threading.Event):
            batch.wait(10)
            return []
        self._given += len(batch)
        return batch

    def counters(self) -> dict[str, int]:
        return {"scans": self._given}


class ListSink(Sink):
    """Keeps what it gets."""

    def __init__(self, on_write=lambda result: None) -> None:
        self.results = []
        self.counters = []
        self.events = []
        self.told_counters = []
        self.waits = 0
        self.closed = False
        self._on_write = on_write

    def write(self, result, counters) -> None:
        self.results.append(result)
        self.counters.append(dict(counters))
        self._on_write(result)

    def tell(self, event, counters) -> None:
        self.events.append(event)
        self.told_counters.append(dict(counters))

    def wait(self) -> None:
        self.waits += 1

    def close(self) -> None:
        self.closed = True
