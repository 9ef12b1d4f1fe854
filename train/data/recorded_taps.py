"""Taps of a real sensor, cut out of recordings with poses or as the paper's authors publish them, and their surfaces.

A tap is followed from first touch to full force in up to FRAMES scans, at even steps of its summed z, over the free
scans just before it, so that no drift is in it. The authors' files, .npy with an object array of dicts (`depth`, an
image of the pad's area that is bright where it touches; `LRs`, (scans, 48) zeroed), hold a pickle.

Source of the layout: Wu and Liu 2024, https://github.com/wmtlab/tactileSR.
"""

import io
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from edge.perception.run_options import OFF_COUNTS, ON_COUNTS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import GAP_NS, PadPose, PoseTrack
from firmware_bridge.recording.csv_reader import CSV_POSES
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.pad_constants import Pad as SensorPad
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import deformation
from firmware_bridge.zeroing.free_stretch import free_stretch
from train.data.presses import PressSet, load_presses
from train.data.real_grips import check_track
from train.errors import DatasetError, SurfaceError
from train.physics.gripped import FRAMES, MAX_INDENTATION_MM, SAMPLES, SCALE, GrippedPad, Taps
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.meshes import load_mesh
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM
from train.surfaces.poses import over_surface

MOST_BYTES: Final = 1 << 30  # largest file of published taps that is read
MOST_PIXELS: Final = 50_000_000  # of a depth image: its plate is 0.7 m wide at 0.1 mm a pixel
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

    RecordingError, BaselineRefusedError or DatasetError if there are none.
    """
    if path.suffix == ".npy":
        return _published_taps(path)
    recording = load_recording(path)
    presses = recorded_presses(recording, entry, sensor)
    if not recording.poses:
        raise DatasetError(
            f"{path} has no poses: record with --poses, or add columns {', '.join(CSV_POSES)} to the CSV"
        )
    taps = [
        RecordedTap(frames, over_surface(Pose(0.0, 0.0, 0.0), pose.x_mm, pose.y_mm, pose.turn_deg))
        for frames, pose in presses
        if pose is not None
    ]
    if not taps:
        raise DatasetError(f"{path} has no tap with a pose: is it of a free pad, or do the poses end before?")
    return taps


def recorded_presses(
    recording: Recording, entry: SensorEntry, sensor: str
) -> list[tuple[NDArray[np.float32], PadPose | None]]:
    """Return the rising scans (frames, 3, rows, cols) of each press on one sensor, and its pose where it has one.

    BaselineRefusedError or DatasetError if the sensor is not there or another one, or the pad is never free.
    """
    track, counts = _zeroed(recording, entry, sensor)
    times = track.time_ns if track.time_ns is not None and not recording.poses_by_row else np.arange(len(counts))
    poses = iter([pose for pose in recording.poses if pose.sensor in (None, track.sensor)])
    course, due, presses = PoseTrack(), next(poses, None), []
    for frames, peak in _cut(counts):
        time = int(times[peak])
        while due is not None and due.time_ns <= time + GAP_NS * (not recording.poses_by_row):
            course.add(due.time_ns, due.pose, holds=due.holds)
            due = next(poses, None)
        presses.append((frames, course.at(time)))
    return presses


def _zeroed(recording: Recording, entry: SensorEntry, sensor: str) -> tuple[Track, NDArray[np.float32]]:
    """Return the track of a sensor, and its scans (n, 3, rows, cols) over its free pad."""
    tracks = {track.sensor: track for track in recording.tracks}
    is_csv = recording.path.suffix.lower() == ".csv"
    track = recording.tracks[0] if is_csv else tracks.get(sensor)  # a CSV does not state its sensor
    if track is None:
        raise DatasetError(f"{recording.path} has the sensors {', '.join(tracks)}, none of them {sensor}")
    check_track(recording, track, entry)
    raw = entry.mounting.place_counts(track.counts) if is_csv else track.counts
    rest = free_stretch(raw).baseline(track.sensor, np.nan)
    mounting = recording.mountings.get(track.sensor, entry.mounting)
    return track, np.nan_to_num(np.stack([deformation(scan, rest, mounting) for scan in raw]))


def load_tap_parts(path: Path, sensor: str, pad: SensorPad, made_with: NDArray[np.float32]) -> dict[str, PressSet]:
    """Return a sensor's taps by part (training, validation, test), divided by its gains as in the runtime.

    DatasetError if it is no file of train.taps, or one of another sensor or scale, or with other constants than
    `made_with`, over their spread, by more than a twentieth of a range: how deep the pad was pressed follows from them.
    """
    taps = load_presses(path)
    if "split" not in taps.config:
        raise DatasetError(f"{path} has no poses that are held out: make it with python -m train.taps")
    if taps.config["sensor"] != sensor:
        raise DatasetError(f"{path} has taps of sensor {taps.config['sensor']}, expected {sensor}")
    if taps.scale != SCALE:
        raise DatasetError(f"{path} has patterns at x{taps.scale}, expected x{SCALE}: make it with --scale {SCALE}")
    if np.abs(taps.constants - made_with).max() > 0.1:
        raise DatasetError(f"{path} has other constants of the pad than the sensor file: make it again with train.taps")
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


_CORE: Final = {"_reconstruct": _Array, "scalar": lambda number, held: number.read(held)[0]}
_CONSTRUCTORS: Final[dict[str, dict[str, Any]]] = {  # stand-ins for those that numpy's pickles name, by their modules
    "numpy": {"dtype": _Number, "ndarray": object},
    "numpy.core.multiarray": _CORE,
    "numpy._core.multiarray": _CORE,
}


class _Arrays(pickle.Unpickler):
    """Unpickler of lists, dicts, numbers and arrays, which calls none of what a pickle names."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a constructor of numpy's pickles; anything else is refused."""
        if name not in _CONSTRUCTORS.get(module, {}):
            raise pickle.UnpicklingError(f"it calls {module}.{name}")
        return _CONSTRUCTORS[module][name]


def _published_taps(path: Path) -> list[RecordedTap]:
    """Return the taps of a file in the authors' layout; DatasetError if it is none, or hostile."""
    if (size := path.stat().st_size) > MOST_BYTES:
        raise DatasetError(f"{path}: {size / 1e9:.1f} GB, at most {MOST_BYTES / 1e9:.0f} are read: cut it in parts")
    file = io.BytesIO(path.read_bytes())
    try:
        (npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0)(file)
        held = [_plain(tap) for tap in _Arrays(file).load().plain]
        return [_published_tap(tap[0] if isinstance(tap, list) else tap) for tap in held]
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


Surface = Callable[[Pose, GrippedPad], NDArray[np.float32]]  # from a pose to heights (m, m) in [mm]
FIT_FROM: Final = 30  # taps by which the poses are fitted
_STEPS: Final = np.array([0.2, 0.2, 0.5, 0.2, 0.2, 0.5])  # by which the effect of a pose is found, in [mm] and [deg]
LEAST_LIKENESS: Final = 0.8
_FLAT_MM: Final = 0.1  # depth below the top at which a part of a flat figure carries nothing


def surface_of(path: Path, unit_mm: float = 1.0, pixel_mm: float = 0.1) -> Surface:
    """Return the surface of a mesh or depth image, PNG, whose middle is the origin; MeshError, DatasetError if none."""
    if path.suffix.lower() != ".png":
        relief = Relief(path.name, load_mesh(path, unit_mm))
        return lambda pose, pad: -depth_image(relief, pose, pad.size * SAMPLES, pad.cell_mm / SAMPLES)
    from matplotlib.image import imread  # of the development environment alone, and meshes do without

    try:
        with path.open("rb") as file:
            head = file.read(24)
        if (pixels := int.from_bytes(head[16:20]) * int.from_bytes(head[20:])) > MOST_PIXELS:
            raise ValueError(f"{pixels} pixels, at most {MOST_PIXELS} are read")
        image = imread(path)
    except (OSError, ValueError, SyntaxError) as error:
        raise DatasetError(f"{path} is no PNG file, or a damaged one: {error}") from error
    image = image if image.ndim == 2 else image[..., :3].mean(axis=2)
    if not np.ptp(image) > 0:
        raise DatasetError(f"{path}: all pixels are alike, expected figures that are brighter than the rest")
    return image_surface(image, pixel_mm)


def image_surface(image: NDArray[np.floating], pixel_mm: float) -> Surface:
    """Return the surface of a depth image (H, W) seen from above: figures are its brighter half."""
    high = image > (float(image.min()) + float(image.max())) / 2

    def heights(pose: Pose, pad: GrippedPad) -> NDArray[np.float32]:
        right_mm, down_mm = pad.places_mm
        cosine, sine = np.cos(np.radians(pose.angle_deg)), np.sin(np.radians(pose.angle_deg))
        x_mm, y_mm = (pose.x_mm + cosine * right_mm + sine * down_mm, pose.y_mm + sine * right_mm - cosine * down_mm)
        row, column = (
            np.floor(n / 2 + mm / pixel_mm).astype(int) for n, mm in zip(high.shape, (-y_mm, x_mm), strict=True)
        )
        inside = (row >= 0) & (row < len(high)) & (column >= 0) & (column < high.shape[1])
        drawn = np.where(high[np.where(inside, row, 0), np.where(inside, column, 0)], 0.0, -FIGURE_HEIGHT_MM)
        return np.where(inside, drawn, -NOTHING_MM).astype(np.float32)

    return heights


class Placed(NamedTuple):
    """Poses of the plate in the frame of the stated poses, and of the pad in its own, as fitted."""

    moved: NDArray[np.float64]  # (6,), x, y in [mm] and turn in [deg] of each
    likeness: float = 0.0  # median correlation of z with the simulated pad's

    def __call__(self, pose: Pose) -> Pose:
        """Return the pose over the surface of a stated one."""
        x_mm, y_mm, turn_deg, right_mm, down_mm, pad_deg = self.moved
        plate = over_surface(Pose(x_mm, y_mm, turn_deg), pose.x_mm, -pose.y_mm, -pose.angle_deg)
        return over_surface(plate, right_mm, down_mm, -pad_deg)

    def told(self) -> str:
        """Return it in a line."""
        x_mm, y_mm, turn_deg, right_mm, down_mm, pad_deg = self.moved
        return (
            f"they fit best with the surface moved by {x_mm:.2f}, {y_mm:.2f} mm and {turn_deg:.1f} deg, the pad by "
            f"{right_mm:.2f}, {down_mm:.2f} mm and {pad_deg:.1f} deg: likeness {self.likeness:.3f}"
        )


def placed(taps: Sequence[RecordedTap], surface: Surface, pad: GrippedPad) -> Placed:
    """Fit the poses of plate and pad by Gauss-Newton; DatasetError if the readings do not fit the surface.

    At the right ones the readings of all taps look like those of the simulated pad.
    """
    some = [taps[number] for number in np.unique(np.linspace(0, len(taps) - 1, FIT_FROM).astype(int))]
    wanted = _shape(np.stack([tap.counts[-1, 2] for tap in some]))

    def made(moved: NDArray[np.float64]) -> NDArray[np.float64]:
        return _shape(pressed([Placed(moved)(tap.pose) for tap in some], surface, pad).counts[:, -1, 2])

    moved, now = np.zeros(6), made(np.zeros(6))
    for _ in range(3):
        slopes = np.stack([(made(moved + step) - now).ravel() / step.sum() for step in np.diag(_STEPS)], axis=1)
        moved = moved + np.linalg.lstsq(slopes, (wanted - now).ravel(), rcond=1e-3)[0].clip(-2, 2)
        now = made(moved)
    fitted = Placed(moved, float(np.median((now * wanted).sum(axis=1))))
    if not fitted.likeness >= LEAST_LIKENESS:
        raise DatasetError(
            f"the readings do not fit what lies under the poses: likeness {fitted.likeness:.2f}, at least "
            f"{LEAST_LIKENESS} expected; are the poses those of this surface, from its middle, in mm, y down?"
        )
    return fitted


def _shape(z: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return z (n, rows, cols) as rows (n, taxels) without their mean, of length 1."""
    flat = z.reshape(len(z), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)


def pressed(poses: Sequence[Pose], surface: Surface, pad: GrippedPad) -> Taps:
    """Return taps of the simulated pad, to the largest indentation; DatasetError if no flat figure is under a pose."""
    try:
        heights_mm = np.stack([surface(pose, pad) for pose in poses])
        depth_mm = heights_mm.max(axis=(1, 2), keepdims=True) - heights_mm
        top = depth_mm < _FLAT_MM
        if ((depth_mm < MAX_INDENTATION_MM) & ~top).sum() > 0.2 * top.sum():
            raise DatasetError(
                "the surface is curved under the pad, expected flat figures: for curved parts use --mesh"
            )
        return pad.tap(heights_mm, np.inf)
    except (ValueError, SurfaceError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"the pad never touches the surface at a pose: {error}") from error
