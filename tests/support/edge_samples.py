"""Samples for the runtime's tests: a tiny real model, a sensor at rest and under load, scripted links."""

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import prod
from pathlib import Path
from struct import unpack_from
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
from bridge_samples import wait_for as wait_for
from onnx import TensorProto, helper, numpy_helper

from edge.inference.contract import (
    CONTRACT_VERSION,
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    TRACTION_NAME,
    Contract,
)
from edge.perception.runtime import Runtime
from edge.pipeline.sink import Sink
from firmware_bridge.links.base import Link, SourceKind
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.zeroing.baseline import Baseline

ROOT = Path(__file__).parents[2]
PERIOD_NS = 10_000_000
TINY_DOUBT = 0.01
REST = (
    np.array([16_000, 16_400, 38_600], dtype=np.int32)[:, None, None] + np.arange(16, dtype=np.int32).reshape(4, 4) * 37
)
BASELINE = Baseline.of("4", REST.astype(np.float32), created_unix_s=1000.0, scans=100, origin="file")


def make_contract(**changes) -> Contract:
    values = {
        "version": CONTRACT_VERSION,
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


def make_pad_contract(**changes) -> Contract:
    """Return the contract of a model that takes a pad and gives traction."""
    pad_inputs = (("thickness_mm", 4.5, 0.5), ("counts_per_newton", 1000.0, 500.0))
    return make_contract(**({"pad_inputs": pad_inputs, "takes_gains": True, "traction_scale": 2} | changes))


def make_wrench_result(number: int = 0, press_counts: float = 20_000, **settings):
    """Return the result of a model with traction for a press on taxel 5: 0.44 N there, on a pad without data."""
    contract = make_pad_contract(interval_factor=1.6)
    runtime = Runtime(FakeModel(contract), **{"source": "device", "baselines": {"4": BASELINE}} | settings)
    return runtime.push(make_scan(number, press_counts=press_counts, time_ns=time.monotonic_ns()))


def write_model(path: Path, contract: Contract | None = None, *, metadata=None, doubt=TINY_DOUBT, gain=1.0) -> Path:
    """Write a real graph: every taxel's z becomes a square of pixels, a tenth as strong for each earlier tap.

    The deviation, there if the contract has a factor for it, is `tiny_deviation`. A pad, likewise, makes all stronger
    by `tiny_stiffness`; a traction, likewise, is the newest tap's x, y, z in squares.
    """
    contract = contract or make_contract()
    pad_width, taps, scale, traction_scale = contract.pad_width, contract.taps, contract.scale, contract.traction_scale
    weights = np.zeros((3 * taps, 1, scale, scale), dtype=np.float32)
    for tap in range(taps):
        weights[3 * tap + 2] = gain * 10.0**-tap
    nodes = [
        helper.make_node("Cast", [INPUT_NAME], ["floats"], to=TensorProto.FLOAT),
        helper.make_node("ConvTranspose", ["floats", "weights"], ["soft"], strides=[scale, scale]),
        helper.make_node("Mul", ["soft", "stiffness"], ["squares"]),
        helper.make_node("Squeeze", ["squares", "axis"], [OUTPUT_NAME]),
    ]
    if pad_width:
        nodes[:0] = [
            helper.make_node("MatMul", [PAD_NAME, "pad_weights"], ["stiffer"]),
            helper.make_node("Add", ["stiffer", "one"], ["stiff"]),
            helper.make_node("Unsqueeze", ["stiff", "last"], ["stiffness"]),
        ]
    if contract.interval_factor is not None:
        nodes += [
            helper.make_node("Abs", [OUTPUT_NAME], ["size"]),
            helper.make_node("Mul", ["size", "doubt"], ["doubted"]),
            helper.make_node("Add", ["doubted", "doubt"], [DEVIATION_NAME]),
        ]
    constants = {}
    if traction_scale is not None:
        strides = [traction_scale, traction_scale]
        nodes += [
            helper.make_node("ConvTranspose", ["floats", "newest"], ["forces"], strides=strides),
            helper.make_node("Mul", ["forces", "stiffness"], [TRACTION_NAME]),
        ]
        constants["newest"] = np.zeros((3 * taps, 3, *strides), dtype=np.float32)
        constants["newest"][[0, 1, 2], [0, 1, 2]] = gain
    constants |= {
        "weights": weights,
        "axis": np.array([1]),
        "last": np.array([2, 3]),
        "one": np.array([[1]], dtype=np.float32),
        "pad_weights": np.arange(1, (pad_width or 1) + 1, dtype=np.float32)[:, None],
        "doubt": np.array(doubt, dtype=np.float32),
        **({} if pad_width else {"stiffness": np.ones((1, 1, 1, 1), dtype=np.float32)}),
    }
    return save_graph(path, nodes, contract, constants, contract.to_metadata() if metadata is None else metadata)


def save_graph(path: Path, nodes: list, contract: Contract, constants: dict, metadata: dict) -> Path:
    """Write a graph of nodes with the inputs and outputs of a contract; constants are arrays by name."""
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)) for name, shape in shapes.items()]
        for shapes in (contract.input_shapes, contract.output_shapes)
    )
    weights = [numpy_helper.from_array(values, name) for name, values in constants.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


def tiny_stiffness(pad_row: np.ndarray) -> float:
    return 1 + float(pad_row @ np.arange(1, len(pad_row) + 1))


def tiny_traction(window_units: np.ndarray, scale: int) -> np.ndarray:
    """Return the tiny model's traction (3, h, w) for a window (taps, 3, rows, cols)."""
    return np.kron(window_units[0], np.ones((1, scale, scale)))


def tiny_pattern(window_units: np.ndarray) -> np.ndarray:
    """Return the tiny model's pattern for a window (taps, 3, rows, cols) in network units."""
    z = sum(window_units[tap, 2] * 10.0**-tap for tap in range(len(window_units)))
    return np.kron(z, np.ones((10, 10)))


def tiny_deviation(pattern: np.ndarray) -> np.ndarray:
    return TINY_DOUBT * (1 + np.abs(pattern))


def make_scan(number=0, *, press_counts=0.0, taxel=5, sensor="4", absent=(), stale=(), time_ns=None, noise=0) -> Scan:
    """Return a scan with one taxel pressed; `absent` taxels gave no reading, `stale` ones are not renewed."""
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


def unpack(message):
    """Return header and maps of a packed message, by the layout in docs/middleware.md alone, all of which is used."""
    (length,) = unpack_from("<I", message)
    header, at, maps = json.loads(message[4 : 4 + length]), 4 + length, {}
    assert at % 4 == 0
    for name, shape in header["maps"]:
        maps[name] = np.frombuffer(message, "<f4", prod(shape), at).reshape(shape)
        at += maps[name].nbytes
    assert at == len(message)
    return header, maps


@contextmanager
def ended(process: subprocess.Popen, within_s: float = 60) -> Iterator[subprocess.Popen]:
    """Yield a process, and kill it at the end of the block, or after a time so that no reader waits for ever."""
    alarm = threading.Timer(within_s, process.kill)
    alarm.start()
    with process:
        try:
            yield process
        finally:
            alarm.cancel()
            process.kill()


class FakeModel:
    """Tiny model without onnxruntime."""

    def __init__(self, contract: Contract | None = None) -> None:
        self.name, self.contract = "fake", contract or make_contract()
        self.windows, self.pads = [], []
        self.deviation: np.ndarray | None = None
        self.traction: np.ndarray | None = None

    def run(self, window: np.ndarray, pad: np.ndarray | None = None, poses: np.ndarray | None = None) -> np.ndarray:
        self.windows.append(window.copy())
        self.pads.append(pad)
        stiffness = np.float32(1 if pad is None else tiny_stiffness(pad))
        pattern = tiny_pattern(window).astype(np.float32) * stiffness
        if self.contract.interval_factor is not None:
            self.deviation = tiny_deviation(pattern)
        if self.contract.traction_scale is not None:
            self.traction = tiny_traction(window, self.contract.traction_scale).astype(np.float32) * stiffness
        return pattern

    def run_together(self, windows, pads=None, poses=None) -> np.ndarray:
        nothing = [None] * len(windows)
        each = zip(windows, pads or nothing, poses or nothing, strict=True)
        made = [(self.run(*one), self.deviation, self.traction) for one in each]
        patterns, deviations, tractions = zip(*made, strict=True)
        self.deviation = None if deviations[0] is None else np.stack(deviations)
        self.traction = None if tractions[0] is None else np.stack(tractions)
        return np.stack(patterns)


def inferred(runtime, scans) -> list:
    """Return the results of scans of several sensors in contact, inferred in one call."""
    for scan in scans:
        assert runtime.take(scan) == []
    return runtime.infer()


class FakeLink(Link):
    """Link with one batch of scans a read, which waits where a batch is an event, and then ends or fails.

    A batch that is a function is called instead; `through` is set once all batches were handed on.
    """

    def __init__(
        self, batches, *, error=None, kind: SourceKind = "device", endless=False, prefix="", lasts=False
    ) -> None:
        self.name, self.prefix, self.lasts = "fake", prefix, lasts
        self.kind: SourceKind = kind
        self.ended, self.through = False, threading.Event()
        self.reads = self._given = 0
        self._batches, self._error, self._endless = list(batches), error, endless

    def __enter__(self):
        return self

    def __exit__(self, *exc_info):
        pass

    def read(self, timeout_s: float) -> list[Scan]:
        self.reads += 1
        if not self._batches:
            self.through.set()
            if self._error is not None:
                raise self._error
            if self._endless:
                time.sleep(min(timeout_s, 0.01))
            self.ended = not self._endless
            return []
        batch = self._batches.pop(0)
        if not isinstance(batch, list):
            batch.wait(10) if isinstance(batch, threading.Event) else batch()
            return []
        self._given += len(batch)
        return [replace(scan, sensor=self.prefix + scan.sensor) for scan in batch] if self.prefix else batch

    def counters(self) -> dict[str, int]:
        return {"scans": self._given}


def fake_source(kind: SourceKind = "replay", *, unix_offset_ns=None, origin=None, **of_sensors) -> Any:
    """Return what sinks see of an open source: `of_sensors` is what its sensor file says."""
    file = SimpleNamespace(**{"mountings": {}, "frames": {}, "geometry": USPA44} | of_sensors)
    return SimpleNamespace(kind=kind, unix_offset_ns=unix_offset_ns, origin=origin, sensor_file=file)


class Clock:
    """Clock that a test sets."""

    now_ns = 10**12

    def __call__(self) -> int:
        return self.now_ns


class ListSink(Sink):
    """Sink that keeps the results it gets."""

    def __init__(self, on_write=lambda result: None) -> None:
        self.results, self.counters, self.events, self.told_counters = [], [], [], []
        self.waits, self.closed = 0, False
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
