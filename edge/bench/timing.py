"""Subjects of a bench, their run times, back to back and at the sensor's rate, and the process that takes them.

The process takes one job as JSON on stdin, and writes the result as JSON on stdout.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError, ModelError, UsageError
from edge.evaluation.classical_methods import fitted_methods
from edge.inference.bundled import BUNDLE_DIR, bundled_models
from edge.inference.onnx_session import ModelSession
from firmware_bridge.schedule import Clock, Sleep, Ticker

FROZEN_FILE: Final = BUNDLE_DIR / "frozen.npz"
CLASSICAL_FILE: Final = BUNDLE_DIR / "classical.npz"

Infer = Callable[[NDArray[np.float32]], object]
"""Inference on a window (K, 3, rows, cols) in zeroed counts, of as many taps as it takes or more."""


class Subject(NamedTuple):
    """Method or model that can be measured: the path of a model, or the scale of a method without a network."""

    name: str
    path: str | None = None
    scale: int = 10


def subjects(scale: int, folder: Path | None, refused: Callable[[str], object]) -> list[Subject]:
    """Return the methods without a network, the bundled models, and the user's own in a folder, named FOLDER/NAME.

    `refused` gets a line for each file in it that is no usable model; `scale` is that of the test set. Raises
    UsageError where there is no such folder, or no .onnx in it.
    """
    everyone = [Subject(name, None, scale) for name in fitted_methods(CLASSICAL_FILE, scale)]
    everyone += [Subject(path.stem, str(path)) for path in bundled_models()]
    if folder is None:
        return everyone
    if not folder.is_dir():
        raise UsageError(f"--models {folder}: not a folder: name the one that holds your .onnx files")
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise UsageError(f"--models {folder}: holds no .onnx file: export one with 'python -m export.to_onnx'")
    for path in paths:
        try:
            ModelSession(path)
        except ModelError as error:
            refused(f"left out: {' '.join(str(error).split())}")
        else:
            everyone.append(Subject(f"{folder.resolve().name}/{path.stem}", str(path.resolve())))
    return everyone


def chosen(everyone: list[Subject], names: list[str] | None) -> list[Subject]:
    """Return the subjects of these names, or all if there are no names; raises UsageError for an unknown one."""
    if names is None:
        return everyone
    known = {subject.name for subject in everyone}
    for name in names:
        if name not in known:
            raise UsageError(f"--only {name}: not one of {', '.join(sorted(known))}")
    return [subject for subject in everyone if subject.name in names]


def opened(subject: Subject, threads: int) -> Infer:
    """Return the subject ready to run."""
    if subject.path is None:
        method = fitted_methods(CLASSICAL_FILE, subject.scale)[subject.name]
        return lambda window: method(window[None, 0])
    model = ModelSession(Path(subject.path), threads)
    taps, scale_window = model.contract.taps, model.contract.scale_window
    return lambda window: model.run(scale_window(window[:taps]))


Run = Callable[[int], object]  # one inference; its argument is a number that selects the input


def summary(took_ns: Sequence[int]) -> dict[str, Any]:
    """Return how many run times in [ns] there are, and their percentiles in [us]."""
    percentiles_us = np.percentile(np.asarray(took_ns, dtype=np.float64) / 1e3, [50, 99, 99.9, 100]).tolist()
    return {"runs": len(took_ns)} | dict(zip(("p50_us", "p99_us", "p999_us", "max_us"), percentiles_us, strict=True))


def _timed(run: Run, numbers: Sequence[int], clock: Clock) -> list[int]:
    """Return the time of each of these runs, one after the other, in [ns]."""
    took_ns: list[int] = []
    for number in numbers:
        start_ns = clock()
        run(number)
        took_ns.append(clock() - start_ns)
    return took_ns


def back_to_back(run: Run, most_runs: int, clock: Clock = time.perf_counter_ns) -> dict[str, Any]:
    """Time as many runs as fit into two seconds, 90 at least and `most_runs` at most, one right after the other."""
    estimate_ns = max(1, min(_timed(run, range(5), clock)))
    runs = min(most_runs, max(90, 2_000_000_000 // estimate_ns))
    return summary(_timed(run, range(runs), clock))


def paced(
    run: Run,
    rate_hz: float,
    ticks: int,
    clock: Clock = time.monotonic_ns,
    sleep: Sleep = time.sleep,
    cpu_clock: Clock = time.process_time_ns,
) -> dict[str, Any]:
    """Time one run at each tick from 1 on, idle between; ticks that pass during a longer run have none.

    Missed are ticks whose run was not done, or not begun, when the next was due; the CPU is of the whole process, in [%
    of one core].
    """
    took_ns: list[int] = []
    in_time = 0
    cpu_before_ns, before_ns = cpu_clock(), clock()
    ticker = Ticker(rate_hz, clock, sleep)
    tick = min(ticker.wait(), ticks)  # one at least, even if the machine stands still from the first on
    while tick <= ticks:
        start_ns = clock()
        run(tick)
        end_ns = clock()
        took_ns.append(end_ns - start_ns)
        in_time += end_ns <= ticker.deadline_ns(tick + 1)
        tick = ticker.wait()
    wall_ns = clock() - before_ns
    cpu_percent = 100 * (cpu_clock() - cpu_before_ns) / wall_ns
    return summary(took_ns) | {"ticks": ticks, "missed": ticks - in_time, "cpu_percent": cpu_percent}


def main() -> int:
    """Do a job, of which "do" is the name in JOBS; returns 1, with a line on stderr, where it cannot be done."""
    job = json.load(sys.stdin)
    try:
        result = JOBS[job.pop("do")](**job)
    except EdgeError as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 1
    sys.stdout.write(json.dumps(result))
    return 0


def _first(subject: dict[str, Any], threads: int, window: list[Any]) -> dict[str, Any]:
    """Return the time of the first pattern, and the most memory in [MB] that this process has held by then."""
    infer = opened(Subject(**subject), threads)
    infer(np.array(window, dtype=np.float32))
    first_ns, status = time.monotonic_ns(), Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    resident_mb = next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:")), None)
    return {"first_ns": first_ns, "resident_mb": resident_mb}


def _time(subject: dict[str, Any], threads: int, rate_hz: float, ticks: int) -> dict[str, Any]:
    """Return run times on the test set's windows in turn, with all taps that there are."""
    from edge.evaluation.test_set import load_frozen_set  # here, or it would add to the start-up

    frozen = load_frozen_set(FROZEN_FILE)
    windows = frozen.windows(1 + frozen.earlier.shape[1])
    infer = opened(Subject(**subject), threads)

    def run(number: int) -> object:
        return infer(windows[number % len(windows)])

    return {"back_to_back": back_to_back(run, ticks), "paced": paced(run, rate_hz, ticks)}


JOBS: Final = {"first": _first, "time": _time}
