"""Checks of refusals, and valid inputs to be damaged."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridge_samples import REST_COUNTS as REST

from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline


def one_line(error: pytest.ExceptionInfo) -> bool:
    return "\n" not in str(error.value) and len(str(error.value)) < 1000


def archive(compressed: bool = False, **arrays: Any) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def recording_arrays() -> dict[str, object]:
    counts = np.stack([REST, REST + 1]).astype(np.int32)
    times = {"scan": np.arange(2), "time_ns": np.arange(2) * 10_000_000}
    return {"format": "tactile-recording", "version": 1, "sensor": np.array(["4", "4"]), "counts": counts, **times}


def npy(value: object) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(value))
    return file.getvalue()


def stored(members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as whole:
        for name, content in members.items():
            whole.writestr(f"{name}.npy", content)
    return file.getvalue()


def sensor_toml(folder: Path) -> bytes:
    """Return a sensor file with all that one may hold."""
    pad = Pad(thickness_mm=4.5, intervals={"poisson": (0.4, 0.49)}, gains=(1.0,) * CHANNELS)
    entry = SensorEntry(
        baseline=Baseline.of("4", REST.astype(np.float32), 1000.0, 100, "file"), counts_per_newton=1200.5, pad=pad
    )
    save_sensor_file(folder / "whole.toml", SensorFile(adapter="D30", sensors={"4": entry}))
    return (folder / "whole.toml").read_bytes()
