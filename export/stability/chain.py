"""Extreme readings through the whole chain, from raw counts or windows to the record: finite, bounded, never sure."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import TAXELS, bundled_models
from edge.inference.onnx_session import ModelSession
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.runtime import Runtime
from export.stability.case import Case, timed
from export.stability.layer_contact import CELL_MM, INDENTATION_MM, SIZE, punch
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer

PART: Final = "chain"
SCALES: Final = (1e-6, 1e-3, 1.0, 1e3, 1e6)
BULK_OVER_SHEAR: Final = (10.0, 1e2, 1e3, 1e4)
_MOST_MM: Final = 5.0
"""Bound of a pattern and its deviations, in a record, and over the amplitude of a window, at least that of noise: a tap
of amplitude 1 indents the pad by a few tenths of a millimetre, and the pad is 4.5 mm thick."""
_QUIET_UNITS: Final = 0.02
_REST: Final = np.broadcast_to(np.array([16_000, 16_400, 38_600])[:, None, None], USPA44.scan_shape).astype(np.int32)
_LARGEST_RAW: Final = 65_535
_SCAN_NS: Final = 10_000_000
_PRESS_COUNTS: Final = 3000


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases of every bundled model."""
    for path in bundled_models()[:2] if quick else bundled_models():
        session = ModelSession(path)
        for severity, window in windows(session, quick).items():
            yield _window(session, severity, window)
        for severity, raw in scans().items():
            yield _scan(session, severity, raw)


def windows(session: ModelSession, quick: bool = False) -> Mapping[str, NDArray[np.float32]]:
    """Return windows in network units by name: scales of a press, alike and opposite taxels, stiff layers."""
    contract = session.contract
    shape = (contract.taps, *USPA44.scan_shape)
    press = np.zeros(shape, dtype=np.float32)
    press[:, 2, 1:3, 1:3] = _PRESS_COUNTS
    press[:, 0, 1:3, 1] = -_PRESS_COUNTS / 10
    one = np.zeros(shape, dtype=np.float32)
    one[:, 2, 3, 3] = _LARGEST_RAW
    rows, cols = np.indices(shape[2:])
    opposite = np.broadcast_to(np.where((rows + cols) % 2, -1, 1), shape) * np.float32(_PRESS_COUNTS)
    counts = {f"press x {scale:g}": press * np.float32(scale) for scale in SCALES}
    counts |= {
        "one taxel at full range": one,
        "all taxels equal": np.full(shape, _PRESS_COUNTS, dtype=np.float32),
        "neighbours opposite": opposite.astype(np.float32),
        "earlier taps opposite": press * np.where(np.arange(contract.taps) % 2, -1, 1)[:, None, None, None],
    }
    for ratio in BULK_OVER_SHEAR[:: 3 if quick else 1]:
        counts[f"K/G {ratio:g}"] = np.broadcast_to(_read(ratio), shape).astype(np.float32)
    return {name: contract.scale_window(values.astype(np.float32)) for name, values in counts.items()}


def scans() -> Mapping[str, NDArray[np.int32]]:
    """Return raw scans by name, as a broken chip or bus may send them."""
    full = np.full_like(_REST, _LARGEST_RAW)
    rows, cols = np.indices(_REST.shape[1:])
    broken = _pressed_raw()
    broken[:, 0, 0] = ABSENT
    wild = _pressed_raw()
    wild[:, 0, 0] = _LARGEST_RAW
    return {
        "a chip sends nothing": broken,
        "a chip sends its largest": wild,
        "all at the largest": full,
        "all at zero": np.zeros_like(_REST),
        "neighbours at zero and largest": np.where((rows + cols) % 2, 0, full).astype(np.int32),
    }


def _pressed_raw() -> NDArray[np.int32]:
    raw = _REST.copy()
    raw[2, 1:3, 1:3] += _PRESS_COUNTS
    return raw


def _read(bulk_over_shear: float) -> NDArray[np.float64]:
    """Return the counts of a round punch on a layer with this ratio of moduli, (3, rows, cols)."""
    poisson = (3 * bulk_over_shear - 2) / (2 * (3 * bulk_over_shear + 1))
    layer = replace(Layer(), poisson=poisson)
    solved = ContactSolver(layer, SIZE, CELL_MM).solve(punch()[None], INDENTATION_MM)
    pressure = solved.pressure_mpa.astype(np.float64)
    per_side = SIZE // USPA44.rows
    inner = pressure[0, : per_side * USPA44.rows, : per_side * USPA44.cols]
    z = inner.reshape(USPA44.rows, per_side, USPA44.cols, per_side).mean(axis=(1, 3))
    return np.stack([np.zeros_like(z), np.zeros_like(z), _PRESS_COUNTS * z / max(float(z.max()), 1e-12)])


def _window(session: ModelSession, severity: str, window: NDArray[np.float32]) -> Case:
    pattern, run_ms = timed(lambda: session.run(window))
    amplitude = float(np.sqrt(np.square(window[0], dtype=np.float64).mean())) + _QUIET_UNITS
    value = _largest(pattern, session.deviation) / amplitude
    return Case(PART, session.name, severity, "largest over the amplitude, mm", value, _MOST_MM, run_ms)


def _scan(session: ModelSession, severity: str, raw: NDArray[np.int32]) -> Case:
    """Return the case of a scan after a free pad, in a runtime that fills in dead taxels."""
    baseline = Baseline.of("4", _REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
    estimator = load_estimator(TAXELS, (USPA44.rows, USPA44.cols))
    runtime = Runtime(session, source="replay", baselines={"4": baseline}, estimator=estimator)
    series, largest, states = ScanSeries("4", USPA44), 0.0, []
    for number in range(20):
        result = runtime.push(series.close(_REST.copy() if number < 5 else raw.copy(), number * _SCAN_NS))
        states.append(result.state)
        if result.pattern is not None:
            largest = max(largest, _largest(result.pattern, result.deviation))
    return Case(
        PART, session.name, severity, "largest in a record, mm", largest, _MOST_MM, note=", ".join({*states[5:]})
    )


def _largest(pattern: NDArray[np.float32], deviation: NDArray[np.float32] | None) -> float:
    """Return the largest value of both maps; not a number unless all are finite and every deviation is above zero."""
    maps = [pattern] if deviation is None else [pattern, deviation]
    sure = all(np.isfinite(one).all() for one in maps) and (deviation is None or bool((deviation > 0).all()))
    return max(float(np.abs(one).max()) for one in maps) if sure else float("nan")
