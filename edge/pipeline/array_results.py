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
from edge.pipeline.source_setup import sensor_settings
from edge.validation import check_positive
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS, PADS, USPA44, pad_of
from firmware_bridge.recording.tracks import HIGHEST_COUNT, Recording, Track
from firmware_bridge.scans.can_id_maps import ModelMap
from firmware_bridge.scans.pad_constants import GAINS
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import Baseline

SENSOR: Final = "array"  # name of the sensor of an array, unless the baseline names another


def infer(
    model: str | Path | Model, counts: ArrayLike, baseline: ArrayLike | Baseline, *, rate_hz: float = 100.0
) -> list[Result]:
    """Return a result for each scan of an array, as `edge-sr` makes it of the same scans of a sensor.

    Args:
        model: as in `open_runtime`; load it once with `load_model` if there are many arrays.
        counts: (n, 3, rows, cols) raw counts in the order of their times, or one scan (3, rows, cols); or (n, 48) or
            (n, 16, 3) as the vendor orders those of a uSPa44: x, y, z of taxel 1, of taxel 2, ... Whole numbers of any
            type; -1 where a taxel gave no reading.
        baseline: counts of the free pad in one of these shapes, whose median is taken, or their mean; or a Baseline.
        rate_hz: scans a second, in [Hz].

    Raises:
        UsageError: counts are not whole; an array is of another shape, or out of range; the rate is.
        ModelError: as in `open_runtime`.
    """
    from firmware_bridge.links.replay import ReplayLink

    check_positive("rate_hz", rate_hz)
    readings = _checked("counts", counts, lowest=ABSENT)
    scans = np.ascontiguousarray(readings, dtype=np.int32)
    if (scans != readings).any():
        raise UsageError("counts are not whole numbers, expected raw counts: no means, and nothing subtracted")
    if not isinstance(baseline, Baseline):
        baseline = Baseline.from_counts(SENSOR, _checked("baseline", baseline, lowest=0), 0.0)
    recording = Recording(Path("array"), (Track(baseline.sensor, scans, None),), rate_hz)
    pad = pad_of(*scans.shape[2:])
    known = sensor_settings(None, pad.name if pad in PADS else ModelMap(pad.name, pad, {}))
    known = replace(known, sensors={baseline.sensor: SensorEntry(baseline=baseline)})
    with Source(ReplayLink([recording], paced=False), sensor_file=known) as source:
        return list(Stream(source, open_runtime(model, source)))


def _checked(name: str, counts: Any, *, lowest: int) -> NDArray[Any]:
    """Return counts as (n, 3, rows, cols); those in the vendor's order have the axes of each taxel together."""
    array = np.asarray(counts)
    if array.dtype.kind not in "iuf":
        raise UsageError(f"{name} are of type {array.dtype}, expected numbers: raw counts, nothing subtracted")
    if not np.isfinite(array).all():
        raise UsageError(f"{name} hold NaN or infinity, expected raw counts: -1 where a taxel gave no reading")
    if array.ndim in (1, 2) and array.shape[-1] == GAINS:
        array = array.reshape(-1, GAINS // len(AXES), len(AXES))
    if array.ndim in (2, 3) and array.shape[-2:] == (GAINS // len(AXES), len(AXES)):
        vendors = array.reshape(-1, USPA44.rows, USPA44.cols, len(AXES))
        array = np.moveaxis(vendors, -1, 1)
    expected = (
        f"expected ({len(AXES)}, rows, cols) or (n, {len(AXES)}, rows, cols), or a uSPa44's (n, 48) or (n, 16, 3)"
    )
    if array.ndim not in (3, 4) or array.shape[-3] != len(AXES) or 0 in array.shape:
        raise UsageError(f"{name} have shape {np.shape(counts)}, {expected}")
    if array.shape[-2] * array.shape[-1] > MOST_TAXELS:
        raise UsageError(f"{name} have {array.shape[-2] * array.shape[-1]} taxels, expected at most {MOST_TAXELS}")
    if array.min() < lowest or array.max() > HIGHEST_COUNT:
        raise UsageError(f"{name} are {array.min():g} to {array.max():g}, expected {lowest} to {HIGHEST_COUNT}")
    return array.reshape(-1, *array.shape[-3:]).astype(np.float64)
