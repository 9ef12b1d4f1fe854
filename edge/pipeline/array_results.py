"""Results of scans that a program has in an array."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.errors import UsageError
from edge.inference.model_interface import Model
from edge.perception.result import Result
from edge.pipeline.result_stream import Stream
from edge.pipeline.runtime_setup import open_runtime
from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import settled
from edge.validation import check_positive
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS, PADS, pad_of
from firmware_bridge.recording.tracks import HIGHEST_COUNT, Recording, Track
from firmware_bridge.scans.can_id_maps import ModelMap
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import Baseline

SENSOR: Final = "array"
"""Name of the sensor of an array, unless the baseline names another."""


def infer(
    model: str | Path | Model, counts: ArrayLike, baseline: ArrayLike | Baseline, *, rate_hz: float = 100.0
) -> list[Result]:
    """Return a result for each scan of an array, as `edge-sr` makes it of the same scans of a sensor.

    Args:
        model: as in `open_runtime`; load it once with `load_model` if there are many arrays.
        counts: (n, 3, rows, cols) raw counts in the order of their times, or one scan (3, rows, cols); -1 where a taxel
            gave no reading.
        baseline: raw counts of the free pad, of one shape with `counts`, whose median is taken; or a Baseline.
        rate_hz: scans a second, in [Hz].

    Raises:
        UsageError: an array is not of whole numbers, or of another shape, or out of range; the rate is.
        ModelError: as in `open_runtime`.
    """
    from firmware_bridge.links.replay import ReplayLink

    check_positive("rate_hz", rate_hz)
    scans = _checked("counts", counts, lowest=ABSENT)
    if not isinstance(baseline, Baseline):
        baseline = Baseline.from_counts(SENSOR, _checked("baseline", baseline, lowest=0), 0.0)
    recording = Recording(Path("array"), (Track(baseline.sensor, scans, None),), rate_hz)
    pad = pad_of(*scans.shape[2:])
    known = settled(None, pad.name if pad in PADS else ModelMap(pad.name, pad, {}))
    known = replace(known, sensors={baseline.sensor: SensorEntry(baseline=baseline)})
    with Source(ReplayLink([recording], paced=False), sensor_file=known) as source:
        return list(Stream(source, open_runtime(model, source)))


def _checked(name: str, counts: Any, *, lowest: int) -> NDArray[np.int32]:
    """Return raw counts as (n, 3, rows, cols).

    Raises:
        UsageError: they are no raw counts.
    """
    array = np.asarray(counts)
    if array.dtype.kind not in "iu":
        raise UsageError(f"{name} are of type {array.dtype}, expected whole numbers: raw counts, nothing subtracted")
    expected = f"expected ({len(AXES)}, rows, cols) or (n, {len(AXES)}, rows, cols)"
    if array.ndim not in (3, 4) or array.shape[-3] != len(AXES) or 0 in array.shape:
        raise UsageError(f"{name} have shape {array.shape}, {expected}")
    if array.shape[-2] * array.shape[-1] > MOST_TAXELS:
        raise UsageError(f"{name} have {array.shape[-2] * array.shape[-1]} taxels, expected at most {MOST_TAXELS}")
    if array.min() < lowest or array.max() > HIGHEST_COUNT:
        raise UsageError(f"{name} are {array.min()} to {array.max()}, expected {lowest} to {HIGHEST_COUNT}")
    return np.ascontiguousarray(array.reshape(-1, *array.shape[-3:]), dtype=np.int32)
