"""Calibrated run times, stored for later runs: for this machine, these versions and this model file only."""

import hashlib
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime

from edge.budgeting.run_times import ROUND_TICKS, ROUNDS, RunTime
from firmware_bridge.bounded_read import read_bounded
from firmware_bridge.in_place import write_in_place

FILE_NAME: Final = "calibration.json"
MOST_FILE_BYTES: Final = 1 << 20
"""Largest file; the entry of a model takes 200 bytes."""
MOST: Final = 1e12
"""Limit of every figure, in [us] or [s]."""
CPU_KEYS: Final = ("model name", "CPU implementer", "CPU part")
"""Keys of /proc/cpuinfo; the first on x86, the others on ARM."""


class CalibrationCache:
    """Store of run times by model file, in one JSON file; a fault of it costs a calibration, never the run.

    Attributes:
        notes: faults, a line each.
    """

    def __init__(self, path: Path | None, rate_hz: float, unix_time_s: Callable[[], float] = time.time) -> None:
        """Read the stored run times.

        Args:
            path: of the file; None stores nothing.
            rate_hz: rate at which run times are measured, in [Hz].
            unix_time_s: returns the time of an entry, in [s] since 1970.
        """
        self.notes: list[str] = []
        self._path = path
        if path is None:
            self.notes.append("there is no home folder to keep run times in: measured at each start")
        self._place = {**machine(), "rate_hz": rate_hz, "ticks": ROUNDS * ROUND_TICKS}
        self._unix_time_s = unix_time_s
        self._entries = self._read()

    def find(self, model: Path) -> tuple[RunTime, float] | None:
        """Return the stored run time of a model file, and its age in [s]; None if there is no usable one.

        Raises:
            OSError: the model file cannot be read.
        """
        entry = self._entries.get(self._key(model))
        if entry is None:
            return None
        p50_us, p99_us, unix_s = (_positive(entry, key) for key in ("p50_us", "p99_us", "unix_s"))
        if p50_us is None or p99_us is None or unix_s is None or p50_us > p99_us:
            self.notes.append(f"{self._path} is damaged at {model.stem}: measured again")
            return None
        return RunTime(p50_us, p99_us), max(self._unix_time_s() - unix_s, 0.0)

    def keep(self, run_times: Mapping[Path, RunTime]) -> None:
        """Add run times by model file, and write the file if there are any.

        Raises:
            OSError: a model file cannot be read.
        """
        now_s = self._unix_time_s()
        for model, run_time in run_times.items():
            self._entries[self._key(model)] = {"model": model.stem, **asdict(run_time), "unix_s": now_s}
        if self._path is None or not run_times:
            return
        text = json.dumps(self._entries, indent=1)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # In place, so that another run never reads half a file.
            write_in_place(
                self._path, lambda draft: draft.write_text(text), lambda draft: draft.read_text(), keep_before=False
            )
        except OSError as error:
            self.notes.append(f"run times are not kept: {self._path}: {error.strerror}")

    def _key(self, model: Path) -> str:
        facts = {**self._place, "model_sha256": hashlib.sha256(model.read_bytes()).hexdigest()}
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def _read(self) -> dict[str, Any]:
        try:
            entries = {} if self._path is None else json.loads(read_bounded(self._path, MOST_FILE_BYTES))
        except FileNotFoundError:
            return {}
        except OSError as error:
            self.notes.append(f"run times are measured at each start: {self._path}: {error.strerror}")
            self._path = None
            return {}
        except (ValueError, RecursionError):
            entries = None
        if not isinstance(entries, dict):
            self.notes.append(f"{self._path} is damaged: measured again")
            return {}
        return entries


def _positive(entry: object, key: str) -> float | None:
    value = entry.get(key) if isinstance(entry, dict) else None
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < MOST else None


def cache_path(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Return the path of the stored run times: below $XDG_CACHE_HOME, else ~/.cache; None without a home.

    Source: XDG Base Directory Specification 0.8, by which a relative path is ignored.
    """
    folder = Path(environment.get("XDG_CACHE_HOME", ""))
    try:
        folder = folder if folder.is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        return None
    return folder / "edge-sr" / FILE_NAME


def machine() -> dict[str, str | int | None]:
    """Return the facts that run times depend on, except the model: processor, cores, host and versions."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    cpu = sorted({line.strip() for line in lines if line.partition(":")[0].strip() in CPU_KEYS})
    try:
        version = importlib.metadata.version("tactile-edge-sr")
    except importlib.metadata.PackageNotFoundError:
        version = None  # run from a checkout that is not installed
    return {
        "cpu": "; ".join(cpu) or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "host": platform.node(),
        "onnxruntime": onnxruntime.__version__,
        "numpy": np.__version__,
        "version": version,
    }
