"""Error against run time: every bundled model and the classical methods, one row each.

The error is that of the frozen test set; "covered" are the pixels whose truth lies in the interval that a model with
deviations says holds 90 % of them. The run time is taken as on a robot, one inference at each tick of the
sensor's rate with the processor idle between: back to back it is less than half of that.
"""

import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from edge.bundle import BUNDLE_DIR
from edge.classical import CONTACT_LEVEL, Method, fitted_methods
from edge.errors import ModelError
from edge.frozen import FrozenSet, load_frozen_set
from edge.judge import by_surface, judge, judge_model, mean_error
from edge.session import ModelSession
from firmware_bridge.schedule import Ticker


@dataclass(frozen=True, slots=True)
class Pace:
    """Run time at the sensor's rate.

    Attributes:
        p50_us: median, in [us].
        p99_us: 99th percentile, in [us].
        max_us: longest, in [us].
        missed: ticks by which the run before was not done.
        cpu_percent: processor time of the whole process, in [% of one core].
    """

    p50_us: float
    p99_us: float
    max_us: float
    missed: int
    cpu_percent: float


@dataclass(frozen=True, slots=True)
class Row:
    """A method with some taps given: its errors, and its run time."""

    method: str
    given: int
    error: dict[str, float]
    psnr_db_by_surface: dict[str, float]
    pace: Pace


def pace(run: Callable[[int], object], rate_hz: float, ticks: int) -> Pace:
    """Run once a tick, `run` being given the tick's number."""
    took_ns = np.zeros(ticks)
    ticker = Ticker(rate_hz)
    cpu_before_s, before_s = time.process_time(), time.perf_counter()
    for tick in range(ticks):
        ticker.wait()
        start_ns = time.perf_counter_ns()
        run(tick)
        took_ns[tick] = time.perf_counter_ns() - start_ns
    cpu_s, wall_s = time.process_time() - cpu_before_s, time.perf_counter() - before_s
    p50, p99 = np.percentile(took_ns, [50, 99]) / 1e3
    return Pace(float(p50), float(p99), float(took_ns.max() / 1e3), ticker.late, 100 * cpu_s / wall_s)


def classical_rows(frozen: FrozenSet, rate_hz: float, ticks: int) -> Iterator[Row]:
    """The methods without a network; they see the newest tap alone."""
    newest = frozen.newest.astype(np.float32)
    for name, method in fitted_methods(BUNDLE_DIR / "classical.npz", frozen.scale).items():
        errors = judge(method(newest), frozen, CONTACT_LEVEL)

        def run(tick: int, method: Method = method) -> object:
            return method(newest[[tick % len(newest)]])

        yield _row(name, 1, errors, frozen, pace(run, rate_hz, ticks))


def model_rows(path: Path, frozen: FrozenSet, rate_hz: float, ticks: int) -> Iterator[Row]:
    """One model, with one tap given and with all it takes.

    Raises:
        ModelError: the model cannot be used, or was made for another scale than the test set.
    """
    session = ModelSession(path)
    contract = session.contract
    if contract.scale != frozen.scale:
        raise ModelError(f"{path}: contract key 'scale' is {contract.scale}, the test set's is {frozen.scale}")
    for given in sorted({1, contract.taps}):
        windows = frozen.windows(contract.taps, given)
        errors = judge_model(session, frozen, given)

        def run(tick: int, windows: NDArray[np.float32] = windows) -> object:
            return session.run(contract.scale_window(windows[tick % len(windows)]))

        yield _row(session.name, given, errors, frozen, pace(run, rate_hz, ticks))


def _row(method: str, given: int, errors: dict[str, NDArray[np.float64]], frozen: FrozenSet, paced: Pace) -> Row:
    return Row(method, given, mean_error(errors), by_surface(errors["psnr_db"], frozen), paced)


def bench(models: Iterable[Path], rate_hz: float, ticks: int) -> Iterator[Row]:
    """All rows, one by one as they are measured."""
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    yield from classical_rows(frozen, rate_hz, ticks)
    for path in models:
        yield from model_rows(path, frozen, rate_hz, ticks)


COLUMNS: Final = (
    *("method", "taps given", "PSNR dB", "SSIM", "global SSIM", "RMSE %", "IoU", "edge mm", "covered %"),
    *("p50 us", "p99 us", "max us", "missed", "CPU %"),
)


def header(rate_hz: float, ticks: int) -> str:
    """What was measured where, and the head of a Markdown table."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, onnxruntime {onnxruntime.__version__}"
    return f"{ticks} ticks a row at {rate_hz:g} Hz; {machine}\n\n{_line(COLUMNS)}\n{'|---' * len(COLUMNS)}|"


def table_line(row: Row) -> str:
    """A row as a line of a Markdown table."""
    error, paced = row.error, row.pace
    errors = (f"{error['psnr_db']:.2f}", *(f"{error[name]:.3f}" for name in ("ssim", "ssim_global")))
    errors += (f"{error['rmse_percent']:.2f}", f"{error['contact_iou']:.3f}", f"{error['boundary_mm']:.2f}")
    errors += (f"{100 * error['coverage_90']:.1f}" if "coverage_90" in error else "-",)
    times = (f"{paced.p50_us:.0f}", f"{paced.p99_us:.0f}", f"{paced.max_us:.0f}")
    return _line((row.method, str(row.given), *errors, *times, str(paced.missed), f"{paced.cpu_percent:.1f}"))


def surface_table(rows: Sequence[Row]) -> str:
    """PSNR in [dB] of each surface, a column for each method."""
    lines = [_line(["surface, PSNR dB", *(f"{row.method} ({row.given})" for row in rows)])]
    lines.append("|---" * (len(rows) + 1) + "|")
    for surface in rows[0].psnr_db_by_surface:
        lines.append(_line([surface, *(f"{row.psnr_db_by_surface[surface]:.1f}" for row in rows)]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
