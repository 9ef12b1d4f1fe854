"""Taps of a real sensor: cut out of recordings with poses, or read from files as the paper's authors publish them.

A tap is followed from first touch to full force in up to FRAMES scans, at even steps of its summed z, over the free
scans just before it, so that no drift is in it. The authors' files, .npy with an object array of dicts (`depth`, an
image of the pad's area that is bright where it touches; `LRs`, (scans, 48) zeroed), hold a pickle. The loader knows
arrays, lists, dicts and numbers alone, and calls nothing that a pickle names.

Source of the layout: Wu and Liu 2024, https://github.com/wmtlab/tactileSR.
"""

import io
import pickle
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import GAP_NS, PoseTrack
from firmware_bridge.recording.csv_reader import CSV_POSES
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.pad_constants import Pad as SensorPad
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import deformation
from firmware_bridge.zeroing.free_stretch import free_stretch
from train.data.presses import PressSet, load_presses
from train.errors import DatasetError
from train.physics.gripped import FRAMES, SCALE
from train.surfaces.depth_image import Pose
from train.surfaces.poses import over_surface

MOST_BYTES: Final = 1 << 30  # largest file of published taps that is read
_FREE: Final = 10  # scans before a tap from which it is zeroed
_TOUCH: Final = 0.02  # share of a tap's peak, in summed z, at which a free pad ends


@dataclass(frozen=True, slots=True)
class RecordedTap:
    """One tap from first touch to full force."""

    counts: NDArray[np.float32]  # (frames, 3, rows, cols) zeroed, the last at full force
    pose: Pose  # of the pad over the surface, as stated
    image: NDArray[np.floating] | None = None  # (H, W) of the pad's area, bright where it touches, where published


def recorded_taps(path: Path, entry: SensorEntry, sensor: str) -> list[RecordedTap]:
    """Return the taps of one sensor in a recording that have a pose, or those of a published file.

    RecordingError, BaselineRefusedError or DatasetError if there are none, or the pad is never free.
    """
    if path.suffix == ".npy":
        return _published_taps(path)
    recording = load_recording(path)
    tracks = {one.sensor: one for one in recording.tracks}
    track = recording.tracks[0] if len(tracks) == 1 else tracks.get(sensor)
    if track is None:
        raise DatasetError(f"{path} has the sensors {', '.join(tracks)}, none of them {sensor}")
    if not recording.poses:
        raise DatasetError(
            f"{path} has no poses: record with --poses, or add columns {', '.join(CSV_POSES)} to the CSV"
        )
    raw = entry.mounting.place_counts(track.counts) if path.suffix.lower() == ".csv" else track.counts
    rest = free_stretch(raw).baseline(track.sensor, np.nan)
    mounting = recording.mountings.get(track.sensor, entry.mounting)
    counts = np.nan_to_num(np.stack([deformation(scan, rest, mounting) for scan in raw]))
    times = track.time_ns if track.time_ns is not None and not recording.poses_by_row else np.arange(len(raw))
    poses = iter([one for one in recording.poses if one.sensor in (None, track.sensor)])
    course, due, taps = PoseTrack(), next(poses, None), []
    for frames, peak in _cut(counts):
        time = int(times[peak])
        while due is not None and due.time_ns <= time + GAP_NS * (not recording.poses_by_row):
            course.add(due.time_ns, due.pose, holds=due.holds)
            due = next(poses, None)
        if (stated := course.at(time)) is not None:
            pose = over_surface(Pose(0.0, 0.0, 0.0), stated.x_mm, stated.y_mm, stated.turn_deg)
            taps.append(RecordedTap(frames, pose))
    if not taps:
        raise DatasetError(f"{path} has no tap with a pose: is it of a free pad, or do the poses end before?")
    return taps


def load_tap_parts(path: Path, sensor: str, pad: SensorPad) -> dict[str, PressSet]:
    """Return a sensor's taps by part (training, validation, test), divided by its gains as in the runtime.

    DatasetError if it is no file of train.taps, or one of another sensor or scale.
    """
    taps = load_presses(path)
    if "split" not in taps.config:
        raise DatasetError(f"{path} has no poses that are held out: make it with python -m train.taps")
    if taps.config["sensor"] != sensor:
        raise DatasetError(f"{path} has taps of sensor {taps.config['sensor']}, expected {sensor}")
    if taps.scale != SCALE:
        raise DatasetError(f"{path} has patterns at x{taps.scale}, expected x{SCALE}: make it with --scale {SCALE}")
    if pad.gains is not None:
        taps = replace(taps, counts=(taps.counts / np.reshape(pad.gains, taps.counts.shape[2:])).astype(np.float32))
    return {part: taps.pick(np.isin(taps.pad, numbers)) for part, numbers in taps.config["split"].items()}


def _cut(counts: NDArray[np.float32]) -> Iterator[tuple[NDArray[np.float32], int]]:
    """Yield each tap of zeroed scans (n, 3, rows, cols): its frames up to full force, and the number of that scan."""
    z, begin = counts[:, 2].sum(axis=(1, 2)), 0
    while begin < len(z):
        level = np.minimum.accumulate(z[begin:])  # of the free pad, which drifts from tap to tap
        start = begin + int(np.argmax(z[begin:] - level >= ON_COUNTS))
        rest = level[start - begin]
        end = start + int(np.argmax(z[start:] - rest < OFF_COUNTS))
        if start == begin or end == start:
            return
        peak = start + int(np.argmax(z[start:end]))
        touched = z[begin : start + 1] - rest > _TOUCH * (z[peak] - rest)
        first = start - int(np.argmin(touched[::-1])) + 1
        free = counts[max(begin, first - _FREE) : first]
        yield _rise(counts[first : peak + 1] - np.median(free, axis=0)), peak
        begin = end


def _rise(counts: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return up to FRAMES of the scans of a rising press, at even steps of their summed z."""
    z = np.maximum.accumulate(counts[:, 2].sum(axis=(1, 2)))
    return counts[np.unique(np.searchsorted(z, z[-1] * np.linspace(1 / FRAMES, 1, FRAMES)))].astype(np.float32)


class _Number:
    """Kind of an array's numbers by a pickle, in place of numpy's dtype, whose forged state would corrupt memory."""

    def __init__(self, kind: str, *_: object) -> None:
        self._kind, self._order = kind, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._order = state[1]

    def read(self, held: Any) -> Any:
        """Return numbers (n,) of bytes, or the list that an array of objects holds."""
        if isinstance(held, list):
            return held
        if not re.fullmatch("[biuf][1248]", self._kind) or self._order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"it holds {self._kind!r}, expected numbers")
        return np.frombuffer(held, self._order.replace("|", "=") + self._kind)


class _Array:
    """Array by a pickle; `plain` is it, or a list where it is one of objects."""

    def __init__(self, *_: object) -> None:
        self.plain: Any = []

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, number, fortran, held = state
        read = number.read(held)
        self.plain = read if isinstance(read, list) else read.reshape(shape, order="F" if fortran else "C")


def _plain(held: Any) -> Any:
    return held.plain if isinstance(held, _Array) else held


class _Arrays(pickle.Unpickler):
    """Unpickler of lists, dicts, numbers and arrays, which calls none of what a pickle names."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a constructor of numpy's pickles; anything else is refused."""
        core = module in ("numpy.core.multiarray", "numpy._core.multiarray")
        if core and name == "scalar":
            return lambda number, held: number.read(held)[0]
        known = {"_reconstruct": _Array} if core else {"dtype": _Number, "ndarray": object} if module == "numpy" else {}
        if name not in known:
            raise pickle.UnpicklingError(f"it calls {module}.{name}")
        return known[name]


def _published_taps(path: Path) -> list[RecordedTap]:
    """Return the taps of a file in the authors' layout; DatasetError if it is none, or hostile."""
    if (size := path.stat().st_size) > MOST_BYTES:
        raise DatasetError(f"{path}: {size / 1e9:.1f} GB, at most {MOST_BYTES / 1e9:.0f} are read: cut it in parts")
    file = io.BytesIO(path.read_bytes())
    try:
        (npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0)(file)
        held = [_plain(one) for one in _Arrays(file).load().plain]
        return [_published_tap(one[0] if isinstance(one, list) else one) for one in held]
    except Exception as error:  # a pickle raises any exception on broken bytes, and each means that the file is broken
        said = " ".join(str(error).split())[:120] or type(error).__name__
        raise DatasetError(f"{path} is not a file of published taps, or a damaged or hostile one: {said}") from error


def _published_tap(held: Mapping[str, Any]) -> RecordedTap:
    image, flat = (np.asarray(_plain(held[name]), dtype=np.float64) for name in ("depth", "LRs"))
    if image.ndim != 2 or flat.ndim != 2 or flat.shape[1] != 3 * USPA44.taxel_count:
        raise ValueError(f"depth {image.shape} and LRs {flat.shape}, expected (H, W) and (scans, 48)")
    if not (np.isfinite(image).all() and np.abs(flat).max() < 1 << 16 and np.ptp(image) > 0):
        raise ValueError("depth or LRs that are no readings, or a depth without a figure")
    counts = flat.reshape(-1, USPA44.rows, USPA44.cols, 3).transpose(0, 3, 1, 2)[:, :, ::-1]  # rows begin below
    z = counts[:, 2].sum(axis=(1, 2))
    peak = int(np.argmax(z))
    return RecordedTap(_rise(counts[int(np.argmax(z > _TOUCH * z[peak])) : peak + 1]), Pose(0.0, 0.0, 0.0), image)
