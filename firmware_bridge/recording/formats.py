"""Recordings of scans, read from disk: CSV rows, or files of the sinks npz: and mcap:."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import NpzError, RecordingError
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS
from firmware_bridge.recording.csv_reader import load_csv
from firmware_bridge.recording.mounting_text import read_mounting
from firmware_bridge.recording.npz_poses import NPZ_POSES, npz_poses
from firmware_bridge.recording.npz_reader import read_npz
from firmware_bridge.recording.tracks import A_RATE, HIGHEST_COUNT, MOST_SENSORS, Recording, Track, is_rate, origin_of
from firmware_bridge.scans.scan import ABSENT, LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS, NS_PER_S

if TYPE_CHECKING:
    from firmware_bridge.scans.mounting import Mounting
    from firmware_bridge.zeroing.baseline import Baseline

NPZ_FORMAT: Final = "tactile-recording"
NPZ_VERSION: Final = 1
_NPZ_REQUIRED: Final = ("format", "version", "sensor", "scan", "time_ns", "counts")
_NPZ_ORIGINS: Final = ("origin", "source")
"""Arrays that hold the origin of the scans; `source` in older files, which have no `origin`."""
_NPZ_BASELINE: Final = ("baseline", "baseline_counts", "baseline_age_s")

_CUT_OFF: Final = "{} is damaged: its end is missing, and only its whole arrays are read; copy it again"
MOST_NPZ_BYTES: Final = 1 << 31
"""Most bytes of the arrays that are read: a day of one sensor at 100 Hz."""


def load_recording(path: str | Path) -> Recording:
    """Read a recording; the ending of its name, .csv, .npz or .mcap, selects the format, and a folder is a rosbag2.

    Raises:
        RecordingError: the file cannot be read, or is not a recording.
    """
    path = Path(path)
    readers = {".csv": load_csv, ".npz": _load_npz, ".mcap": _load_mcap}
    reader = _load_mcap if path.is_dir() else readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: a recording ends in .csv, .npz or .mcap, or is a folder of a rosbag2")
    try:
        recording = reader(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    if recording.origin != "emulated":
        return recording
    return replace(recording, notes=(*recording.notes, f"{path} was recorded from an emulated sensor"))


def _load_npz(path: Path) -> Recording:
    notes: list[str] = []
    names = (*_NPZ_REQUIRED, *_NPZ_ORIGINS, *NPZ_POSES, "rate_hz", "mountings")
    arrays = _npz_arrays(path, names, lambda: notes.append(_CUT_OFF.format(path)))
    for name in _NPZ_REQUIRED:
        if name not in arrays:
            lost = f"; {notes[0]}" if notes else ""
            raise RecordingError(f"{path}, array '{name}': missing, expected what the npz sink writes{lost}")
    form, version = arrays["format"], arrays["version"]
    if str(form) != NPZ_FORMAT:
        _refuse_array(path, "format", repr(str(form)[:40]), f"'{NPZ_FORMAT}'")
    if version.shape or version.dtype.kind not in "iu" or int(version) != NPZ_VERSION:
        _refuse_array(path, "version", str(version)[:40], f"{NPZ_VERSION}")
    counts = _check_npz_counts(path, arrays["counts"])
    for name, kinds in (("sensor", "U"), ("scan", "iu"), ("time_ns", "iu")):
        array = arrays[name]
        if array.dtype.kind not in kinds or array.shape != counts.shape[:1]:
            kind = "text" if kinds == "U" else "whole numbers"
            _refuse_array(path, name, f"{array.dtype} of shape {array.shape}", f"{kind} of shape {counts.shape[:1]}")
    tracks = [
        Track(sensor, counts[mine], _npz_times(path, sensor, arrays["time_ns"][mine]))
        for sensor in _npz_sensors(path, arrays["sensor"])
        for mine in [arrays["sensor"] == sensor]
    ]
    return Recording(
        path,
        tuple(tracks),
        _npz_rate_hz(path, arrays.get("rate_hz")),
        mountings=_npz_mountings(path, arrays.get("mountings"), tracks),
        notes=tuple(notes),
        origin=_npz_origin(path, arrays, len(counts)),
        poses=None if notes and NPZ_POSES[1] not in arrays else npz_poses(path, arrays),
    )


def _load_mcap(path: Path) -> Recording:
    from firmware_bridge.recording.mcap_reader import load_mcap  # imported here, since it loads the mcap package

    return load_mcap(path)


def npz_baselines(recording: Recording) -> "dict[str, Baseline]":
    """Return the baselines of the first scan of each sensor of an npz, dated by the clock of the scans.

    Raises:
        RecordingError: the values there cannot be a baseline.
    """
    from firmware_bridge.zeroing.baseline import (  # imported here, since most readers of a recording do not need it
        LAST_UNIX_S,
        Baseline,
    )

    path = recording.path
    arrays = _npz_arrays(path, ("sensor", *_NPZ_BASELINE))
    if not all(name in arrays for name in _NPZ_BASELINE):
        return {}
    ids, counts, ages_s = (arrays[name] for name in _NPZ_BASELINE)
    scans = len(arrays["sensor"])
    scan_shape = recording.tracks[0].counts.shape[1:]
    for name, kind, shape in zip(_NPZ_BASELINE, "Uff", ((scans,), (scans, *scan_shape), (scans,)), strict=True):
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            _refuse_array(path, name, f"{arrays[name].dtype} of shape {arrays[name].shape}", f"shape {shape}")
    baselines: dict[str, Baseline] = {}
    for track in recording.tracks:
        first = int(np.argmax(arrays["sensor"] == track.sensor))
        own, text, age_s = counts[first].astype(np.float32), str(ids[first]), float(ages_s[first])
        if not text or track.time_ns is None:
            continue
        known = np.isnan(own) | ((own >= 0) & (own <= HIGHEST_COUNT + 1))
        if not known.all() or not is_sensor_name(text):
            _refuse_array(path, "baseline_counts", "others", f"0..{HIGHEST_COUNT + 1}, or none")
        own.setflags(write=False)
        taken_s = int(track.time_ns[0]) / NS_PER_S - (age_s if 0 <= age_s <= LAST_UNIX_S else math.nan)
        baselines[track.sensor] = Baseline(track.sensor, own, taken_s, 1, "file", text)
    return baselines


def _npz_arrays(
    path: Path, names: Sequence[str], damaged: Callable[[], object] = lambda: None
) -> dict[str, NDArray[Any]]:
    try:
        return read_npz(path, names, MOST_NPZ_BYTES, damaged)
    except NpzError as error:
        raise RecordingError(f"{path}: {error}") from error


def _npz_sensors(path: Path, sensors: NDArray[np.str_]) -> list[str]:
    names = list(dict.fromkeys(sensors.tolist()))
    if len(names) > MOST_SENSORS:
        _refuse_array(path, "sensor", f"{len(names)} sensors", f"at most {MOST_SENSORS}")
    for name in names:
        if not is_sensor_name(name):
            _refuse_array(path, "sensor", repr(name[:20]), f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
    return names


def _npz_mountings(path: Path, text: NDArray[Any] | None, tracks: Sequence[Track]) -> "dict[str, Mounting]":
    if text is None:
        return {}
    try:
        texts = json.loads(str(text))
        return {
            one.sensor: read_mounting(texts[one.sensor], one.counts[0, 0].size) for one in tracks if one.sensor in texts
        }
    except (ValueError, TypeError, RecursionError) as error:
        _refuse_array(path, "mountings", " ".join(str(error).split())[:120], "JSON as the npz sink writes it")


def _npz_times(path: Path, sensor: str, times: NDArray[np.integer]) -> NDArray[np.int64]:
    if times.min() < 0 or times.max() > LAST_TIME_NS:
        _refuse_array(path, "time_ns", f"times {times.min()}..{times.max()}", f"0..{LAST_TIME_NS}")
    if (times[1:] < times[:-1]).any():  # not a difference, which wraps around
        _refuse_array(path, "time_ns", f"times of sensor {sensor!r} that go back", "times that never fall")
    return times.astype(np.int64)


def _check_npz_counts(path: Path, counts: NDArray[Any]) -> NDArray[np.int32]:
    shape = counts.shape
    grid = len(shape) == 4 and shape[1] == len(AXES) and 0 < shape[2] * shape[3] <= MOST_TAXELS
    if counts.dtype.kind not in "iu" or not grid or counts.size == 0:
        most = f"{MOST_TAXELS} taxels at most"
        expected = f"whole numbers of shape (scans, {len(AXES)}, rows, cols), {most}, at least one scan"
        _refuse_array(path, "counts", f"{counts.dtype} of shape {counts.shape}", expected)
    if counts.min() < ABSENT or counts.max() > HIGHEST_COUNT:
        got = f"counts {counts.min()}..{counts.max()}"
        _refuse_array(path, "counts", got, f"0..{HIGHEST_COUNT}, or {ABSENT} where a taxel is absent")
    absent = counts == ABSENT
    if (absent.any(axis=1) != absent.all(axis=1)).any():
        _refuse_array(path, "counts", "a taxel absent on some axes", "all of a taxel's axes absent or none")
    return counts.astype(np.int32)


def _npz_origin(path: Path, arrays: Mapping[str, NDArray[Any]], scans: int) -> Literal["device", "emulated"] | None:
    for name in _NPZ_ORIGINS:
        array = arrays.get(name)
        if array is None:
            continue
        if array.dtype.kind != "U" or array.shape != (scans,):
            _refuse_array(path, name, f"{array.dtype} of shape {array.shape}", f"text of shape {(scans,)}")
        return origin_of(np.unique(array).tolist())
    return None


def _npz_rate_hz(path: Path, rate: NDArray[Any] | None) -> float | None:
    if rate is None:
        return None
    if rate.shape or rate.dtype.kind not in "iuf" or not is_rate(float(rate)):
        _refuse_array(path, "rate_hz", str(rate)[:40], A_RATE)
    return float(rate)


def _refuse_array(path: Path, name: str, got: str, expected: str) -> NoReturn:
    raise RecordingError(f"{path}, array '{name}': {' '.join(got.split())}, expected {expected}")
