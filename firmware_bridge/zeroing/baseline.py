"""Zeroing: the baseline of a free pad, and the difference of a scan to it. Counts wrap round at 2^16."""

import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import BaselineRefusedError, RecordingError
from firmware_bridge.in_place import read_bounded, write_in_place
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, LONGEST_SENSOR_NAME, Scan, is_sensor_name
from firmware_bridge.strict_table import Table, is_number, numbers, one_of, reader, whole

COUNTS_ON_CIRCLE: Final = 0x10000
FEWEST_SCANS: Final = 100
FEWEST_RECORDED: Final = 30  # of a recording, where a pad may be free for only half a second

# Limits for 100 scans. A still, free pad shows noise of sigma 1.1..2.8 counts on x and y, 2..4.7 on z,
# so its 5th to 95th percentile spans up to 12 and 20 counts, and the medians of its first and last third
# differ by up to 6. A gripper that holds an object as still as it can spans at least 38 on z.
SPREAD_LIMIT_COUNTS: Final = (15.0, 15.0, 25.0)
CREEP_LIMIT_COUNTS: Final = 10.0
# Between the 120 counts that warming up adds to a free pad and the 350 that 0.3 N on one taxel add.
LOAD_LIMIT_COUNTS: Final = 200.0

Origin = Literal["start-up", "demand", "file", "recording", "unsure"]

FILE_FORMAT: Final = "tactile-baseline"
FILE_VERSION: Final = 1
LAST_UNIX_S: Final = 1e11  # latest valid time, in [s] since 1970 (the year 5138)
_FILE_REMEDY: Final = "zero again and save a new file"
_read_entries: Final = reader(
    lambda value: isinstance(value, list) and value != [] and all(isinstance(entry, dict) for entry in value),
    "a list of at least one object",
)
_read_sensor: Final = reader(
    lambda value: isinstance(value, str) and is_sensor_name(value),
    f"a name of 1 to {LONGEST_SENSOR_NAME} printable characters",
)
_read_date: Final = reader(
    lambda value: value is None or is_number(value, 1, LAST_UNIX_S), "seconds since 1970, or null"
)


@dataclass(frozen=True, slots=True)
class Baseline:
    """Baseline of one sensor: the counts of its free pad."""

    sensor: str
    # (3, rows, cols) in 0..65536, read-only; NaN where a taxel was silent. `id` identifies them as they were taken, and
    # `moved` adds the drift since.
    counts: NDArray[np.float32]
    created_unix_s: float  # time of its scans, in [s] since 1970; NaN if it is unknown
    scans: int  # number of scans whose median it is
    # Where it is of the very recording that is played: "recording" where the pad is free, "unsure" where it may hold
    # something all the time.
    origin: Origin
    id: str  # short text that identifies sensor, counts and time

    def __repr__(self) -> str:
        return f"<Baseline {self.id} of sensor {self.sensor}: {self.scans} scans, {self.origin}>"

    @classmethod
    def from_counts(cls, sensor: str, counts: NDArray[np.integer], created_unix_s: float) -> Self:
        """Return the median of whole scans (n, 3, rows, cols) of a free, still pad, or raise a BaselineRefusedError."""
        if not isinstance(counts, np.ndarray) or counts.dtype.kind not in "iuf" or np.ma.is_masked(counts):
            raise BaselineRefusedError(f"counts of sensor {sensor}: expected an array of numbers without a mask")
        if counts.ndim != 4 or not counts.size or not 0 <= counts.min() <= counts.max() < COUNTS_ON_CIRCLE:
            got = f"shape {counts.shape}, {counts.min():g} to {counts.max():g}" if counts.size else "none"
            expected = f"(n, 3, rows, cols), 0 to {COUNTS_ON_CIRCLE - 1}, nothing subtracted"
            raise BaselineRefusedError(f"counts of sensor {sensor}: {got}, expected {expected}")
        median = counts[0] + np.median(unwrapped(counts), axis=0)
        return cls.of(sensor, median % COUNTS_ON_CIRCLE, created_unix_s, len(counts), "start-up")

    @classmethod
    def of(cls, sensor: str, counts: NDArray[np.floating], created_unix_s: float, scans: int, origin: Origin) -> Self:
        """Return a baseline of counts (3, rows, cols), with its id."""
        own = np.array(counts, dtype=np.float32)
        own.setflags(write=False)
        content = f"{sensor} {created_unix_s!r} {scans} {own.shape} ".encode() + own.tobytes()
        return cls(sensor, own, created_unix_s, scans, origin, _sha256_hex(content)[:8])

    def age_s(self, now_unix_s: float) -> float:
        """Return its age at `now_unix_s`, in [s]."""
        return now_unix_s - self.created_unix_s

    def moved(self, drift_counts: NDArray[np.floating]) -> Self:
        """Return the same baseline, with its id, for a pad that has drifted by (3, rows, cols) in [counts] since."""
        counts = ((self.counts + drift_counts.astype(np.float64)) % COUNTS_ON_CIRCLE).astype(np.float32)
        counts.setflags(write=False)
        return replace(self, counts=counts)


def deformation(
    scan_counts: NDArray[np.integer], baseline: Baseline, mounting: Mounting | None = None
) -> NDArray[np.float32]:
    """Return the difference of a scan's raw counts to the baseline, the short way round the circle of counts.

    Shapes (3, rows, cols); NaN where a taxel is absent. Without a mounting the axes are as wired.
    """
    half = COUNTS_ON_CIRCLE // 2
    # float32 holds halves exactly up to 2^23, so this does not round.
    signed = scan_counts.astype(np.float32)
    signed -= baseline.counts
    if not (signed.min() >= -half and signed.max() < half):  # rare: beyond half a turn, or a taxel that is not zeroed
        signed += half
        signed %= COUNTS_ON_CIRCLE
        signed -= half
    if scan_counts.min() == ABSENT:
        signed[scan_counts == ABSENT] = np.nan
    return signed if mounting is None else mounting.correct(signed)


class BaselineEstimator:
    """Estimator of the baseline of one sensor from its scans.

    It refuses a pad that moves, and one that is loaded by more than LOAD_LIMIT_COUNTS against a reference. Without a
    reference a load that lies on the pad all the time looks like a free pad, and becomes part of the baseline.
    """

    def __init__(
        self,
        min_scans: int = FEWEST_SCANS,
        reference: Baseline | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Wait for at least 3 complete scans with a new reading; `clock` returns the time in [s] since 1970."""
        if min_scans < 3:
            raise ValueError(f"min_scans is {min_scans}, expected at least 3")
        self._min_scans, self._reference, self._clock = min_scans, reference, clock
        self._taken: list[NDArray[np.int32]] = []
        self._silent: NDArray[np.bool_] | None = None

    @property
    def scans(self) -> int:
        """Number of scans so far."""
        return len(self._taken)

    def push(self, scan: Scan, silent: NDArray[np.bool_] | None = None) -> Baseline | None:
        """Add the next scan, and return the baseline once there are enough.

        A scan is complete without the `silent` taxels (rows, cols), and the baseline NaN there. One left out once stays
        so until there is a baseline, since an intermittent one would delay it for ever. Begins again, and raises a
        BaselineRefusedError, where the pad moved or was loaded.
        """
        if silent is not None and silent.any():
            self._silent = silent.copy() if self._silent is None else self._silent | silent
        silent = self._silent
        # A repeated scan is no second sample, and would hide a spread.
        complete = scan.complete if silent is None else bool((scan.fresh | silent).all())
        if not complete or not scan.renewed.any():
            return None
        self._taken.append(scan.counts)
        if len(self._taken) < self._min_scans:
            return None
        counts = np.stack(self._taken)
        if silent is not None:
            counts[:, :, silent] = 0
        self._taken.clear()
        self._silent = None
        refuse_motion(counts)
        baseline = Baseline.from_counts(scan.sensor, counts, self._clock())
        if silent is not None:
            free_counts = np.where(silent, np.float32(np.nan), baseline.counts)
            baseline = Baseline.of(scan.sensor, free_counts, baseline.created_unix_s, baseline.scans, baseline.origin)
        if self._reference is not None:
            refuse_load(baseline, self._reference)
        return baseline


def save_baselines(
    path: str | Path, baselines: Iterable[Baseline], orders: Mapping[str, Sequence[int]] = MappingProxyType({})
) -> None:
    """Write baselines, one per sensor, as one JSON file, or raise a RecordingError; the one before stays as NAME.bak.

    `orders` are those of the taxels of each sensor whose mounting differs from its id map.
    """
    path = Path(path)
    entries = [
        {
            "id": baseline.id,
            "sensor": baseline.sensor,
            "created_unix_s": None if math.isnan(baseline.created_unix_s) else baseline.created_unix_s,
            "scans": baseline.scans,
            "counts": baseline.counts.tolist(),
            **({"order": list(orders[baseline.sensor])} if baseline.sensor in orders else {}),
        }
        for baseline in baselines
    ]
    text = json.dumps({"format": FILE_FORMAT, "version": FILE_VERSION, "baselines": entries}, indent=1, allow_nan=False)
    try:
        write_in_place(
            path,
            lambda draft: draft.write_text(text + "\n", encoding="utf-8"),
            lambda draft: load_baselines(draft, orders),
        )
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error


def load_baselines(path: str | Path, orders: Mapping[str, Sequence[int]] = MappingProxyType({})) -> dict[str, Baseline]:
    """Read baselines, by sensor, or raise a RecordingError; `orders` are the present ones, as in `save_baselines`.

    If its taxels lay in another order, each would get the baseline of another one.
    """
    path = Path(path)
    try:
        document = json.loads(read_bounded(path, 1 << 20).decode())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: not JSON ({error}): {_FILE_REMEDY}") from error
    top = Table(path, "", document if isinstance(document, dict) else {}, RecordingError, _FILE_REMEDY)
    top.take("format", one_of(FILE_FORMAT))
    top.take("version", one_of(FILE_VERSION))
    baselines: dict[str, Baseline] = {}
    for entry in top.take("baselines", _read_entries):
        table = Table(path, "", entry, RecordingError, _FILE_REMEDY)
        sensor = table.take("sensor", _read_sensor)
        if sensor in baselines:
            table.refuse("sensor", repr(sensor), "each sensor once")
        created_unix_s = table.take("created_unix_s", _read_date, required=False)
        scans, counts = table.take("scans", whole), table.take("counts", _read_counts)
        dated = math.nan if created_unix_s is None else created_unix_s
        baselines[sensor] = Baseline.of(sensor, counts, dated, scans, "file")
        right = baselines[sensor].id
        if entry.get("id", right) != right:
            table.refuse("id", repr(entry["id"]), f"'{right}', which the counts give, or none: the file was changed")
        now = orders.get(sensor)
        if entry.get("order") != (None if now is None else list(now)):
            raise RecordingError(
                f"{path}: the taxels of sensor {sensor} lay in another order: zero again with the sensor file"
            )
    return baselines


def unwrapped(counts: NDArray[np.integer]) -> NDArray[np.int32]:
    """Return the differences of scans (n, 3, rows, cols) to the first, the short way round the circle of counts."""
    return (counts - counts[0]).astype(np.int16).astype(np.int32)  # sixteen bits go round the same circle


def refuse_motion(counts: NDArray[np.int32]) -> None:
    """Raise a BaselineRefusedError if a pad moved or crept during scans (n, 3, rows, cols), n at least 3."""
    moved = unwrapped(counts)
    # Percentiles, not the range: the sensor has single readings far off, which are no motion.
    spread = np.percentile(moved, 95, axis=0) - np.percentile(moved, 5, axis=0)
    limits = np.asarray(SPREAD_LIMIT_COUNTS)[:, None, None]
    worst = _worst(spread / limits)
    if spread[worst] > limits[worst[0], 0, 0]:
        _refuse(worst, f"moved by {spread[worst]:.0f} counts", limits[worst[0], 0, 0], "keep the pad still and free")
    third = len(moved) // 3
    creep = np.abs(np.median(moved[-third:], axis=0) - np.median(moved[:third], axis=0))
    worst = _worst(creep)
    if creep[worst] > CREEP_LIMIT_COUNTS:
        remedy = "keep the pad still and free, and let it rest after a load"
        _refuse(worst, f"crept by {creep[worst]:.0f} counts", CREEP_LIMIT_COUNTS, remedy)


def refuse_load(baseline: Baseline, reference: Baseline) -> None:
    """Raise a BaselineRefusedError if a taxel lies more than LOAD_LIMIT_COUNTS above a reference: it was loaded."""
    z = len(AXES) - 1
    # A taxel that is missing in either baseline is no evidence of a load.
    counts = np.where(np.isnan(baseline.counts), 0, baseline.counts)
    load = deformation(np.rint(counts).astype(np.int32) % COUNTS_ON_CIRCLE, reference)
    load[np.isnan(baseline.counts) | np.isnan(reference.counts)] = 0
    row, col = _worst(load[z])
    if load[z, row, col] > LOAD_LIMIT_COUNTS:
        what = f"is {load[z, row, col]:.0f} counts above the baseline {reference.id}"
        _refuse((z, row, col), what, LOAD_LIMIT_COUNTS, "free the pad, or zero without that baseline")


def _worst(values: NDArray[np.floating]) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(int(values.argmax()), values.shape))


def _refuse(where: tuple[int, ...], what: str, limit: float, remedy: str) -> None:
    axis, row, col = where
    raise BaselineRefusedError(
        f"taxel ({row}, {col}) {AXES[axis]} {what} while zeroing, at most {limit:.0f} allowed: {remedy}"
    )


def _sha256_hex(data: bytes) -> str:
    """Return the hash of some bytes by Python's own code: `hashlib` loads OpenSSL, 3.7 MB and 5 ms of every start."""
    for name in ("_sha2", "_sha256"):  # of Python 3.12 and later, and of 3.11
        with suppress(ImportError):
            return import_module(name).sha256(data).hexdigest()
    return import_module("hashlib").sha256(data).hexdigest()


def _read_counts(value: Any) -> NDArray[np.float64]:
    expected = f"numbers 0..{COUNTS_ON_CIRCLE}, as {len(AXES)} axes of rows of equal length"
    try:
        shape = np.shape(value)
    except ValueError as error:
        raise ValueError(expected) from error
    if len(shape) != 3 or shape[0] != len(AXES) or not all(shape):
        raise ValueError(expected)
    return np.array(numbers(shape, expected, 0, math.nextafter(COUNTS_ON_CIRCLE, 0))(value)).reshape(shape)
