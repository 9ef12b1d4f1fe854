"""Recording as npz, for numpy: arrays with a row for each scan, as docs/formats.md lists them."""

import json
import shutil
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import astuple
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from edge.errors import SinkError
from edge.perception.field import Out
from edge.perception.result_fields import FIELDS
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.npz_recording import NPZ_FORMAT, NPZ_VERSION
from firmware_bridge.recording.scan_messages import mounting_text
from firmware_bridge.scans.mounting import Mounting

KINDS: Final[Mapping[str, tuple[str, Any]]] = {
    **{field.name: (field.kind.array, field.kind.unknown) for field in FIELDS if Out.NPZ in field.out},
    "origin": ("<U8", ""),
}
"""numpy's type of each array, and the value of a row where it is unknown."""
_PIECE_BYTES: Final = 1 << 20


def write_npz(
    path: Path, rows: Iterable[Mapping[str, Any]], mountings: Mapping[str, Mounting], poses: Sequence[TimedPose]
) -> None:
    """Write a recording of rows, each the values of a scan by the names of KINDS; what a row lacks is unknown there.

    Raises:
        SinkError: patterns change their size.
        OSError: the file cannot be written.
    """
    with ExitStack() as opened:
        columns = _Columns(path.parent, opened)
        for row in rows:
            columns.add(row)
        texts = json.dumps({name: mounting_text(one) for name, one in mountings.items()})
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, value in (("format", NPZ_FORMAT), ("version", NPZ_VERSION), ("mountings", texts)):
                _add(archive, name, np.asarray(value))
            columns.add_to(archive)
            for name, array in _pose_arrays(poses).items():
                _add(archive, name, array)


class _Columns:
    """Arrays that grow by a row a scan, each in a file of its own, so that memory stays flat."""

    def __init__(self, folder: Path, opened: ExitStack) -> None:
        self._folder, self._opened = folder, opened
        self._rows = 0
        self._columns: dict[str, tuple[IO[bytes], np.dtype[Any], tuple[int, ...], bytes]] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        for name in [name for name in row if name not in self._columns]:
            kind, unknown = KINDS[name]
            shape, dtype = np.shape(row[name]), np.dtype(kind)
            file = self._opened.enter_context(TemporaryFile(dir=self._folder))  # noqa: SIM115 - closed with the others
            blank = np.full(shape, ("" if dtype.kind == "U" else 0) if unknown is None else unknown, dtype)
            self._columns[name] = file, dtype, shape, blank.tobytes()
            for _ in range(self._rows):
                file.write(blank.tobytes())
        for name, (file, dtype, shape, unknown) in self._columns.items():
            value = row.get(name)
            if value is None:
                file.write(unknown)
                continue
            array = np.asarray(value, dtype)
            if array.shape != shape:
                raise SinkError(f"{name} of {shape} and of {array.shape} in one recording: cut it in parts")
            file.write(array.tobytes())
        self._rows += 1

    def add_to(self, archive: zipfile.ZipFile) -> None:
        for name in sorted(self._columns, key=lambda name: name != "origin"):  # first: what loses its end has it
            file, dtype, shape, _ = self._columns[name]
            file.seek(0)
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                header = {"descr": dtype.str, "fortran_order": False, "shape": (self._rows, *shape)}
                npy.write_array_header_1_0(entry, header)
                shutil.copyfileobj(file, entry, _PIECE_BYTES)


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
        npy.write_array(entry, array)


def _pose_arrays(poses: Sequence[TimedPose]) -> dict[str, NDArray[Any]]:
    if not poses:
        return {}
    return {
        "pose_time_ns": np.array([one.time_ns for one in poses]),
        "pose": np.array([astuple(one.pose) for one in poses], np.float64),
        "pose_sensor": np.array([one.sensor or "" for one in poses]),
        "pose_holds": np.array([one.holds for one in poses]),
        "pose_used_from_ns": np.array([-1 if one.used_from_ns is None else one.used_from_ns for one in poses]),
    }
