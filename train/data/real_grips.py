"""Recordings of real grips, played through the shipped runtime, and how well patterns show the flat faces they hold."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from edge.inference.bundled import TAXELS_FILE
from edge.inference.onnx_session import ModelSession
from edge.perception.run_options import ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Runtime
from edge.perception.taxel_health import load_estimator
from firmware_bridge.pad_geometry import AXES, TAXELS, USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.zeroing.baseline import LOAD_LIMIT_COUNTS, Baseline, deformation
from train.errors import DatasetError
from train.physics.sensor_noise import neighbours

REST_SCANS: Final = 20  # scans at the end of a recording, where one of the grips has been released
_Z: Final = AXES.index("z")
_AS_WIRED: Final = Mounting()
_UNKNOWN: Final = SensorFile()


@dataclass(frozen=True, slots=True)
class Grip:
    """Raw recording of one sensor in one trial, whose scans are not independent."""

    trial: str
    counts: NDArray[np.integer]  # (n, 3, rows, cols) raw, each taxel in its place
    free: Baseline  # of the sensor's free pad
    mounting: Mounting = _AS_WIRED  # by which its axes are turned

    def zeroed(self) -> NDArray[np.float32]:
        """Return the scans over the free pad, along the pad's axes."""
        return np.stack([deformation(scan, self.free, self.mounting) for scan in self.counts])


def z_of(counts: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return readings of z, (n, taxels), from scans (n, 3, rows, cols)."""
    return counts[:, _Z].reshape(-1, TAXELS)


def loaded(counts: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return a mask of scans (n,) from zeroed counts (n, 3, rows, cols) in which some taxel is pressed."""
    return counts[:, _Z].max(axis=(1, 2)) > LOAD_LIMIT_COUNTS


def recordings_folder() -> Path:
    """Return the folder in TACTILE_RECORDINGS, or the default one next to the repository."""
    beside = Path(__file__).parents[2] / "../shared/recordings/imanlab"
    return Path(os.environ.get("TACTILE_RECORDINGS", beside))


def recording_paths(folder: Path) -> list[Path]:
    """Return the recordings `xela_SENSOR.csv` in a folder with one subfolder for each trial."""
    return sorted(folder.glob("*/xela_*.csv"))


def check_track(recording: Recording, track: Track, entry: SensorEntry) -> None:
    """Print what is not read of a recording, and refuse what would teach something wrong of the sensor of an entry.

    DatasetError if its pad is of another model, or only one of recording and file is of an emulated sensor.
    """
    sys.stderr.writelines(f"{note}\n" for note in recording.notes)
    if track.geometry != USPA44 or entry.mounting.taxel_count != USPA44.taxel_count:
        got = f"{track.geometry.taxel_count} taxels, and {entry.mounting.taxel_count} in the sensor file"
        raise DatasetError(f"{recording.path} has {got}, expected the {USPA44.taxel_count} of a {USPA44.name} in both")
    if (recording.origin == "emulated") == bool(entry.emulated):
        return
    of, expected = ("a device", "an emulated sensor") if entry.emulated else ("an emulated sensor", "a device")
    raise DatasetError(
        f"{recording.path} is of {of}, expected one of {expected} as in the sensor file: pass a recording of the same "
        "sensor, or write a file of it with edge-sr doctor --out"
    )


def recorded_grips(folder: Path, known: SensorFile = _UNKNOWN) -> list[Grip]:
    """Load the recordings of sensors as a sensor file has them mounted, or raise a DatasetError or RecordingError.

    The rest level is taken from the end of the trial that ends with the least load: there the grip was released.
    """
    paths = recording_paths(folder)
    if not paths:
        raise DatasetError(
            f"{folder} holds no recordings: expected a folder of TRIAL/xela_SENSOR.csv; of an experiment it is "
            "TACTILE_RECORDINGS"
        )
    grips: list[Grip] = []
    for sensor in dict.fromkeys(path.stem for path in paths):
        entry = known.sensors.get(sensor.removeprefix("xela_"), SensorEntry())
        counts = {path: _placed_counts(path, entry) for path in paths if path.stem == sensor}
        ends = {path: entry.mounting.signs[_Z] * float(read[-REST_SCANS:, _Z].mean()) for path, read in counts.items()}
        last = min(ends, key=ends.__getitem__)
        rest = Baseline.from_counts(sensor, counts[last][-REST_SCANS:], created_unix_s=0.0)
        for path, read in counts.items():
            grips.append(Grip(path.parent.name, read, rest, entry.mounting))
            if (freer := -grips[-1].zeroed()[:, _Z].sum(axis=(1, 2)).min()) > ON_COUNTS:
                raise DatasetError(
                    f"in {path} the summed z is up to {freer:.0f} counts lower than where {last} ends, expected a free "
                    "pad there: let go of it before a recording ends"
                )
    return grips


def grips_of(folder: Path, sensor: str, known: SensorFile) -> list[Grip]:
    """Return the recordings of one sensor, as of `recorded_grips`; DatasetError if one is of a free pad alone."""
    grips = [one for one in recorded_grips(folder, known) if one.free.sensor.removeprefix("xela_") == sensor]
    if not grips:
        raise DatasetError(f"{folder} has no recording xela_{sensor}.csv of this sensor")
    for one in grips:
        if not loaded(one.zeroed()).any():
            raise DatasetError(f"nothing presses the pad in {one.trial} of {folder}, expected a grip of a flat face")
    return grips


def _placed_counts(path: Path, entry: SensorEntry) -> NDArray[np.integer]:
    """Return the raw counts of a CSV, whose taxels are in the order of the id map, with each taxel in its place."""
    recording = load_recording(path)
    check_track(recording, recording.tracks[0], entry)
    return entry.mounting.place_counts(recording.tracks[0].counts)


def recorded_contacts(folder: Path, known: SensorFile = _UNKNOWN) -> dict[str, NDArray[np.float32]]:
    """Return the scans under load of each sensor, (n, 3, rows, cols) zeroed, without repeats; DatasetError if none."""
    contacts: dict[str, list[NDArray[np.float32]]] = {}
    for grip in recorded_grips(folder, known):
        renewed = np.append(True, (np.diff(grip.counts, axis=0) != 0).any(axis=(1, 2, 3)))
        zeroed = grip.zeroed()[renewed]
        if (pressed := loaded(zeroed)).any():
            contacts.setdefault(grip.free.sensor, []).append(zeroed[pressed])
    if not contacts:
        raise DatasetError(f"nothing presses a pad in the recordings of {folder}: expected contacts of many shapes")
    return {sensor: np.concatenate(parts) for sensor, parts in contacts.items()}


def neighbours_mean(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the mean of each taxel's edge neighbours, (n, taxels): bilinear at its place, with fewer at the rim."""
    beside = neighbours(USPA44.rows, USPA44.cols) > 0
    return z @ (beside / beside.sum(axis=0))


class Played(NamedTuple):
    """Output of the runtime for the scans of one grip that are under load: zeroed counts without a hidden taxel."""

    zeroed: NDArray[np.float32]
    patterns: NDArray[np.float32]  # (n, H, W) in [mm], NaN where there was none
    believed: NDArray[np.bool_]  # (n,) unless any reason spoke against it


def play(grip: Grip, model: ModelSession, hidden: int | None = None, pad: Pad | None = None) -> Played:
    """Play a whole recording through a runtime that is set up as shipped, except that every scan is inferred."""
    name = grip.free.sensor
    estimator = load_estimator(TAXELS_FILE, (USPA44.rows, USPA44.cols))
    options, free, mounted = RuntimeOptions(every_scan=True), {name: grip.free}, {name: grip.mounting}
    runtime = Runtime(
        model, source="replay", estimator=estimator, baselines=free, mountings=mounted, pad=pad, options=options
    )
    series = ScanSeries(name, USPA44)
    none = np.full(model.contract.pattern_shape, np.nan, dtype=np.float32)
    patterns, believed = [], []
    for number, raw in enumerate(grip.counts.astype(np.int32)):
        if hidden is not None:
            raw.reshape(3, -1)[:, hidden] = ABSENT
        result = runtime.push(series.close(raw, number * 16_750_000))
        patterns.append(none if result.pattern is None else result.pattern)
        believed.append(result.trusted is not False)
    zeroed = grip.zeroed()
    here = loaded(zeroed)
    return Played(zeroed[here], np.stack(patterns)[here], np.array(believed)[here])


def hidden_taxels(
    grip: Grip, model: ModelSession, operator: NDArray[np.floating], pad: Pad | None = None
) -> NDArray[np.floating]:
    """Return the z of each taxel, (n, taxels) in counts, as a pattern tells it that was made while it was silent.

    The operator (H * W, taxels) reads z off a pattern; NaN where there was none. Source: Wu and Liu 2024, Eq. 7-8.
    """
    shape, silent = model.contract.pattern_shape, (play(grip, model, one, pad).patterns for one in range(TAXELS))
    readers = operator.T.reshape(TAXELS, *shape)
    return np.stack([np.tensordot(*parts, axes=2) for parts in zip(silent, readers, strict=True)], axis=1)


def share_touched(patterns: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the share of the pad above half of the pattern's 95th percentile, (n,) of patterns (n, H, W)."""
    return _above_half(patterns).mean(axis=(1, 2))


def unevenness(patterns: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return standard deviation over mean in the inner 80 % of the pad, (n,) of patterns (n, H, W)."""
    rim = patterns.shape[1] // 10
    inner = patterns[:, rim:-rim, rim:-rim]
    return inner.std(axis=(1, 2)) / inner.mean(axis=(1, 2))


def has_hole(patterns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return True where pixels below half of the 95th percentile are enclosed, (n,) of patterns (n, H, W)."""
    return np.array([(binary_fill_holes(above) & ~above).any() for above in _above_half(patterns)], dtype=bool)


def _above_half(patterns: NDArray[np.floating]) -> NDArray[np.bool_]:
    return patterns > 0.5 * np.quantile(patterns, 0.95, axis=(1, 2), keepdims=True)
