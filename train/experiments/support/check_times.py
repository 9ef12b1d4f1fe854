"""Run time of each check of a pattern, and of the whole scan with and without them, at the sensor's rate."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.bench.timing import timed
from edge.inference.expected_error import doubt
from edge.inference.familiarity import contact_features
from edge.inference.onnx_session import ModelSession
from edge.perception.pattern_check import PatternCheck
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import Ticker
from train.errors import CheckpointError
from train.experiments.support.pushed import PushedSensor
from train.experiments.support.wrong_taps import EVERY_TAP
from train.report import Row

_RATE_HZ: Final = 100.0
_WARM: Final = 10
_EVERY_SCAN: Final = replace(EVERY_TAP, every_scan=True)


def time_rows(path: Path, windows: NDArray[np.floating], ticks: int) -> list[Row]:
    """Return the run times of a model's checks and scans, one of them at each tick, in turn.

    Args:
        path: of the model.
        windows: (n, K, 3, rows, cols) of firm contacts, as zeroed counts.
        ticks: of each.
    """
    with_checks, without = ModelSession(path), ModelSession(path)
    without.contract = replace(without.contract, trust={})
    checks = _checks(with_checks, windows)
    runs: dict[str, Callable[[int], object]] = checks | {
        "a scan": _scan(with_checks, windows, ticks + _WARM),
        "a scan, no checks": _scan(without, windows, ticks + _WARM),
    }
    took_ns: dict[str, list[int]] = {name: [] for name in runs}
    ticker = Ticker(_RATE_HZ, time.monotonic_ns, time.sleep)
    for number in range(ticks + _WARM):
        for name, run in runs.items():
            ticker.wait()
            started_ns = time.perf_counter_ns()
            run(number % len(windows))
            took_ns[name].append(time.perf_counter_ns() - started_ns)
    paced_us = {name: np.array(times[_WARM:]) / 1e3 for name, times in took_ns.items()}
    paced_us["all checks"] = paced_us["a scan"] - paced_us["a scan, no checks"]
    rows: list[Row] = []
    for name, times_us in paced_us.items():
        low, high = _median_interval(times_us)
        row: Row = {"model": with_checks.name, "part": name, "runs": len(times_us)}
        rows.append(row | {"paced us": f"{np.median(times_us):.0f} ({low:.0f}..{high:.0f})"})
        if name in checks:
            row = rows[-1]
            row["back to back us"] = round(float(np.median(timed(checks[name], [0] * ticks))) / 1e3, 1)
    return rows


def _median_interval(times_us: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the 95 % interval of a median, by its order statistics."""
    half = 0.98 / np.sqrt(len(times_us))
    return np.quantile(times_us, [max(0.5 - half, 0), min(0.5 + half, 1)])


def _checks(model: ModelSession, windows: NDArray[np.floating]) -> dict[str, Callable[[int], object]]:
    contract = model.contract
    trust = contract.read_trust()
    if trust is None:
        raise CheckpointError(f"{model.name} has no checks to time: export it with --trust")
    pad = contract.pad_row(None)
    check = PatternCheck(trust, contract)
    check.use_pad(pad)
    operator = trust.forward.of_pad(pad[: len(contract.pad_inputs)])
    units = [contract.scale_window(window[: contract.taps].astype(np.float32)) for window in windows]
    made: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]] = []
    for window in units:
        pattern = model.run(window, pad).copy()
        made.append((window[0], pattern, np.array(model.deviation), np.array(model.traction)))
    runs: dict[str, Callable[[int], object]] = {
        "familiar": lambda at: trust.contact.network(contact_features(made[at][0], pad)),
        "mismatch": lambda at: trust.forward.mismatch(operator, made[at][0], made[at][1], made[at][3], 0.075),
        "doubt": lambda at: doubt(made[at][1], made[at][2]),
        "all, and the evidence": lambda at: check.judge(at, *made[at], 0),
    }
    if contract.taps > 1:
        runs["earlier taps"] = lambda at: check.belonging(units[at], contract.taps)
    return runs


def _scan(model: ModelSession, windows: NDArray[np.floating], ticks: int) -> Callable[[int], object]:
    """Return a run that pushes the next scan of a contact that goes on after earlier taps."""
    ready: list[Iterator[tuple[PushedSensor, Scan]]] = []
    for number, window in enumerate(windows):
        sensor = PushedSensor(model, seed=number, options=_EVERY_SCAN)
        sensor.tap(window[: model.contract.taps])
        scans = [sensor.scan(window[0] + sensor.noise()) for _ in range(ticks // len(windows) + 1)]
        ready.append(zip(repeat(sensor), scans, strict=False))

    def run(at: int) -> object:
        sensor, scan = next(ready[at])
        return sensor.take(scan)

    return run
