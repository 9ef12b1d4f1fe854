"""Reader of the authors' recordings (`C.npy`, ...): pickled object arrays of dicts, read without executing any code.

Source: Wu and Liu 2024, Sec. IV-A, and the layout of the files that their code reads.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from firmware_bridge.geometry import AXES, USPA44
from train.data.plain_pickle import BROKEN, load_plain, plain_value
from train.errors import DatasetError
from train.surfaces.poses import position_and_angle

FRAMES_KEPT: Final = 16
FIRST_SHARE: Final = 0.3
"""Share of the largest sum of z from which frames are kept."""

_KEYS: Final = ("sample_idx", "depth", "LRs")
_BROKEN_HEADER: Final = (SyntaxError, TokenError)
"""Exceptions that numpy's reader of the header lets through."""
_READINGS: Final = USPA44.taxel_count * len(AXES)


@dataclass(frozen=True, slots=True)
class AuthorsTaps:
    """Taps on one of the authors' surfaces.

    Attributes:
        counts: (n, FRAMES_KEPT, 3, 4, 4) float32 as in the file, rows from the top.
        depth: n depth images (H, W) as in the file.
        position: (n,) 0 to 8.
        angle_deg: (n,) turn of the pad, in [deg].
    """

    counts: NDArray[np.float32]
    depth: tuple[NDArray[np.floating], ...]
    position: NDArray[np.int64]
    angle_deg: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.counts)


def load_authors_taps(path: Path) -> AuthorsTaps:
    """Read one of the authors' files.

    Raises:
        DatasetError: absent, of another format, cut short, or a pickle with names that no array needs.
    """
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about headers that look like Python 2's, and escapes in strings
            records = _records(file)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error
    except (*BROKEN, *_BROKEN_HEADER) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DatasetError(f"{path} is none of the authors' files: {reason}") from error
    if not records:
        raise DatasetError(f"{path} holds no records, expected up to 81")
    taps = [_tap(record, f"{path}, record {number}") for number, record in enumerate(records)]
    numbers = [number for number, _, _ in taps]
    if len(set(numbers)) < len(numbers):
        raise DatasetError(f"{path} has two records of one sample_idx, expected each once")
    places = [position_and_angle(number) for number in numbers]
    return AuthorsTaps(
        counts=np.stack([counts for _, counts, _ in taps]),
        depth=tuple(depth for _, _, depth in taps),
        position=np.array([position for position, _ in places]),
        angle_deg=np.array([angle_deg for _, angle_deg in places]),
    )


def kept_frames(readings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the frames to train on, (FRAMES_KEPT, 3, 4, 4), from readings (frames, 48) x, y, z by taxel.

    Frames are evenly spaced from the first with FIRST_SHARE of the largest sum of z to the one with the largest; in a
    short press some frames appear twice. Rows are reversed, because the file counts them from the bottom.

    Raises:
        ValueError: no frame, or no frame with a positive sum of z.
    """
    scans = readings.reshape(-1, USPA44.rows, USPA44.cols, len(AXES)).transpose(0, 3, 1, 2)[:, :, ::-1]
    force = scans[:, 2].sum(axis=(1, 2))
    if not len(force) or not force.max() > 0:
        raise ValueError("no frame has a positive sum of z")
    last = int(force.argmax())
    first = int(np.argmax(force >= FIRST_SHARE * force[last]))
    return scans[np.rint(np.linspace(first, last, FRAMES_KEPT)).astype(int)].astype(np.float32)


def _records(file: BinaryIO) -> list[Any]:
    """Return the objects of an npy file's object array."""
    if npy.read_magic(file) != (1, 0):
        raise ValueError("its npy version is not 1.0")
    shape, _, dtype = npy.read_array_header_1_0(file)
    if dtype != np.dtype(object):
        raise ValueError(f"its array is of {dtype}, expected objects")
    array = load_plain(file)
    if not isinstance(array, list) or len(array) != np.prod(shape, dtype=int):
        raise ValueError(f"its pickle holds no array of the {shape} objects that the header tells")
    return array


def _tap(record: Any, where: str) -> tuple[int, NDArray[np.float32], NDArray[np.floating]]:
    """Return number, kept frames and depth image of one record."""
    if not isinstance(record, dict) or not all(key in record for key in _KEYS):
        found = ", ".join(map(str, record)) if isinstance(record, dict) else type(record).__name__
        raise DatasetError(f"{where} has {found}, expected a dict with {', '.join(_KEYS)}")
    try:
        number = plain_value(record["sample_idx"])
        if not isinstance(number, int) or isinstance(number, bool):
            raise ValueError(f"sample_idx is {number!r}, expected a whole number")
        position_and_angle(number)
        readings = _numbers(record["LRs"], "LRs", _READINGS)
        depth = _numbers(record["depth"], "depth", None)
        return number, kept_frames(readings), depth
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{where}: {error}") from error


def _numbers(value: Any, name: str, width: int | None) -> NDArray[np.floating]:
    """Return a table of finite numbers, (rows, columns), from an array or a list of rows."""
    plain = plain_value(value)
    if isinstance(plain, list):
        rows = [plain_value(row) for row in plain]
        if not all(isinstance(number, int | float) for row in rows if isinstance(row, list) for number in row):
            raise ValueError(f"{name} holds something else than numbers")
        plain = np.array([np.asarray(row) for row in rows])
    if not isinstance(plain, np.ndarray) or plain.ndim != 2 or plain.dtype.kind not in "biuf":
        kind = f"{plain.dtype} {plain.shape}" if isinstance(plain, np.ndarray) else type(plain).__name__
        raise ValueError(f"{name} is {kind}, expected numbers in rows and columns")
    if width is not None and plain.shape[1] != width:
        raise ValueError(f"{name} has shape {plain.shape}, expected (frames, {width})")
    table = plain.astype(np.float64)
    if not (np.abs(table) <= np.finfo(np.float32).max).all():
        raise ValueError(f"{name} holds values that are not finite")
    return table
