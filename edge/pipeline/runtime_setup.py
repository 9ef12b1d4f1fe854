"""Models, recordings and runtimes with the settings of a source; and results of scans that are in an array."""

import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.errors import UsageError
from edge.inference.bundled import TAXELS_FILE, find_model, taps_of
from edge.inference.contract import Model
from edge.perception.gain_learning import load_contact_model
from edge.perception.result import Result
from edge.perception.run_options import RuntimeOptions
from edge.perception.runtime import Runtime
from edge.perception.taxel_health import load_estimator
from edge.pipeline.result_stream import Stream
from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import of_single_csv, sensor_settings, stored_baselines, unmapped, with_recorded
from edge.validation import check_kind, check_positive
from firmware_bridge.links.registry import recording_paths
from firmware_bridge.pad_geometry import AXES, CHANNELS, MOST_TAXELS, TAXELS, USPA44, pad_of
from firmware_bridge.recording.tracks import Recording, Track, check_raw
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ABSENT, HIGHEST_COUNT
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import Baseline

if TYPE_CHECKING:
    from edge.inference.onnx_session import ModelSession


def load_model(model: str | Path) -> "ModelSession":
    """Load a model, a file or a bundled one by its name, or raise a ModelError."""
    from edge.inference.onnx_session import ModelSession

    return ModelSession(find_model(model), taps=taps_of(model))


def open_runtime(
    model: str | Path | Model,
    source: Source,
    *,
    baselines: Mapping[str, Baseline] | str | Path | None = None,
    counts_per_newton: float | Mapping[str, float] | None = None,
    pad: Pad | Mapping[str, Pad] | None = None,
    **options: Any,
) -> Runtime:
    """Return a runtime that makes results of an open source's scans, by a model of `load_model`, its name or file.

    Baselines, or their file, summed z counts per newton, and the pads are of all sensors or of each by name, and
    override those of the source's sensor file. A sensor without a baseline is zeroed from its first 100 scans, during
    which its pad must be still and free. Options are those of `RuntimeOptions`, with the defaults of `edge-sr`. Raises
    ModelError, RecordingError for the baseline file, or UsageError.
    """
    chosen = RuntimeOptions(**options)
    if not isinstance(model, (str, Path)):
        check_kind("model", model, "run_together", "the name of one, its file, or what load_model returned")
    if not isinstance(source, Source):
        raise UsageError(f"source is {source!r}, expected an open one: with open_source(...) as source")
    sensor_file, nominal = source.sensor_file, source.sensor_file.geometry == USPA44
    return Runtime(
        load_model(model) if isinstance(model, (str, Path)) else model,
        source=source.kind,
        estimator=load_estimator(TAXELS_FILE, (USPA44.rows, USPA44.cols)) if nominal else None,
        contacts=load_contact_model() if nominal and chosen.learn else None,
        geometry=sensor_file.geometry,
        baselines=of_single_csv(stored_baselines(baselines, sensor_file), source.name),
        counts_per_newton=(sensor_file.counts_per_newton or None) if counts_per_newton is None else counts_per_newton,
        scale_intervals=sensor_file.scale_intervals if counts_per_newton is None else {},
        mountings=sensor_file.mountings,
        pad=sensor_file.pads if pad is None else pad,
        measured=sensor_file.measured_pads if pad is None else None,
        options=chosen,
        unix_time_s=source.unix_time_s,
    )


def open_recording(
    path: str | Path,
    *more: str | Path,
    sensor: str | Path | None = None,
    zero: bool = False,
    paced: bool = False,
    rate_hz: float | None = None,
    begins: threading.Event | None = None,
) -> Source:
    """Open a recording, .mcap, .npz or .csv, as a source, to compute its results again as `edge-sr replay` does.

    Every scan gets a result, however slow the loop is, with the time, mounting and baseline of the recording. Those of
    other sensors may be played beside it. A `sensor` file of the doctor takes the place of the recorded settings.
    `zero` takes the baselines from the first 100 scans instead. With `paced` it is played at the recorded speed, from
    when `begins` is set, as if live: a loop that is too slow loses scans. `rate_hz` is the scans a second of each
    sensor, where the file does not state it, or to play it at another speed. Raises RecordingError, SourceError for
    the rate, or SensorFileError.
    """
    from edge.pipeline.baseline_capture import free_baselines
    from firmware_bridge.links.replay import ReplayLink

    paths = [path for file in (path, *more) for path in recording_paths(str(file))]
    replay = ReplayLink(paths, rate_hz, paced=paced, begins=begins)
    tracks = [track for recording in replay.recordings for track in recording.tracks]
    # A sensor file names the pad; without one the recording's grid does.
    file = sensor_settings(sensor, unmapped(tracks[0].geometry) if sensor is None else None)
    stored = with_recorded(file, [replay])
    baselines: dict[str, Baseline] = {}
    for recording in () if zero else replay.recordings:
        # By the clock of an undated recording, they would be half a century old in a run of today.
        undated = {"created_unix_s": math.nan} if paced and not recording.unix_offset_ns else {}
        baselines |= {name: replace(baseline, **undated) for name, baseline in recording.baselines.items()}
    if not zero:
        baselines = baselines or stored.baselines
        baselines |= free_baselines(replay, stored.mountings, baselines, rate_hz=rate_hz)
    sensors = {*stored.sensors, *baselines}
    if sensor is None:  # else a note reports the sensors that the file lacks
        sensors |= {track.sensor for track in tracks}
    as_wired = SensorEntry(Mounting(taxel_count=file.geometry.taxel_count))
    entries = {
        name: replace(stored.sensors.get(name, as_wired), baseline=baselines.get(name)) for name in sorted(sensors)
    }
    replay.place(file.mountings)
    return Source(replay, sensor_file=replace(stored, sensors=entries), rate_hz=rate_hz)


def infer(
    model: str | Path | Model, counts: ArrayLike, baseline: ArrayLike | Baseline, *, rate_hz: float = 100.0
) -> list[Result]:
    """Return a result for each scan of an array, as `edge-sr` makes it of the same scans of a sensor.

    Counts are raw and whole, (n, 3, rows, cols) or (3, rows, cols), or (n, 48) or (n, 16, 3) as the vendor orders those
    of a uSPa44: x, y, z of taxel 1, of taxel 2, ...; -1 where a taxel gave no reading. The baseline is a Baseline, or
    counts of the free pad in one of these shapes, of which the median is taken. Raises UsageError for other arrays,
    RecordingError for counts over a baseline, and ModelError.
    """
    from firmware_bridge.links.replay import ReplayLink

    check_positive("rate_hz", rate_hz)
    readings = _checked("counts", counts, lowest=ABSENT)
    scans = np.ascontiguousarray(readings, dtype=np.int32)
    if (scans != readings).any():
        raise UsageError("counts are not whole numbers, expected raw counts: no means, and nothing subtracted")
    check_raw("counts", scans)
    if not isinstance(baseline, Baseline):
        baseline = Baseline.from_counts("array", _checked("counts of the baseline", baseline, lowest=0), 0.0)
    recording = Recording(Path("array"), (Track(baseline.sensor, scans, None),), rate_hz)
    sensor_file = sensor_settings(None, unmapped(pad_of(*scans.shape[2:])))
    sensor_file = replace(sensor_file, sensors={baseline.sensor: SensorEntry(baseline=baseline)})
    with Source(ReplayLink([recording], paced=False), sensor_file=sensor_file) as source:
        return list(Stream(source, open_runtime(model, source)))


def _checked(name: str, counts: Any, *, lowest: int) -> NDArray[Any]:
    """Return counts as (n, 3, rows, cols); those in the vendor's order have the axes of each taxel together."""
    try:
        array = np.asarray(counts)
    except ValueError as error:
        raise UsageError(f"{name} are no array of numbers: {error}") from error
    if np.ma.is_masked(counts):
        raise UsageError(f"{name} are masked in part, expected an array without a mask: -1 where there is no reading")
    if array.dtype.kind not in "iuf" or array.dtype == np.float16:  # which holds counts to within 32
        raise UsageError(f"{name} are of type {array.dtype}, expected whole numbers: raw counts, nothing subtracted")
    if not np.isfinite(array).all():
        raise UsageError(f"{name} hold NaN or infinity, expected raw counts: -1 where a taxel gave no reading")
    if array.ndim in (1, 2) and array.shape[-1] == CHANNELS:
        array = array.reshape(-1, TAXELS, len(AXES))
    if array.ndim in (2, 3) and array.shape[-2:] == (TAXELS, len(AXES)):
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
