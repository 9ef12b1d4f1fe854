"""Scans and patterns in one .npz, which `--source replay:` plays again.

A zip archive cannot grow at several places, so during the run `FILE.npz.parts` grows by a row a scan; `close` turns the
rows into arrays. Memory stays flat however long the run is. Each row is written at once, so that a crash, or kill -9,
costs no recorded scan: afterwards `python -m edge.sinks.npz FILE.npz` makes the .npz.
"""

import argparse
import json
import os
import shutil
import sys
import zipfile
from collections.abc import Mapping, Sequence
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from edge.errors import SinkError
from edge.perception.field import Columns, Out
from edge.perception.result import Result
from edge.perception.result_fields import FIELDS
from edge.pipeline.sink import Sink
from edge.sinks.npz_poses import ROWS as POSE_ROWS
from edge.sinks.npz_poses import add_pose_arrays, pose_rows
from edge.terminal.forced_end import finishing
from edge.terminal.progress_bar import Progress
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.formats import NPZ_FORMAT, NPZ_VERSION
from firmware_bridge.recording.mounting_text import mounting_text
from firmware_bridge.scans.mounting import Mounting

LAYOUT: Final = "layout.json"
MOUNTINGS: Final = "mountings.json"
ROWS: Final = "rows"
CHUNK_SCANS: Final = 256


class NpzSink(Sink):
    """Writer of records into `path`, by way of parts next to it.

    Arrays have one row a scan; docs/formats.md lists them.
    """

    def __init__(
        self,
        path: Path,
        scan_shape: tuple[int, ...],
        pattern_shape: tuple[int, ...],
        *,
        deviations: bool = False,
        traction_shape: tuple[int, ...] | None = None,
        poses_shape: tuple[int, ...] | None = None,
        mountings: Mapping[str, Mounting] | None = None,
        origin: SourceKind | None = None,
    ) -> None:
        """Start the parts.

        Args:
            path: of the .npz; one that exists is left alone.
            scan_shape: (3, rows, cols).
            pattern_shape: (H, W).
            deviations: patterns come with deviations.
            traction_shape: (3, h, w), where patterns come with tractions.
            poses_shape: (taps, 5) of the most taps, where patterns are made from taps with poses.
            mountings: of the sensors, by name.
            origin: kind of source that the scans come from, where results are of a recording; else that of the results.

        Raises:
            SinkError: the file exists, or its parts cannot be written, or parts of an unfinished run lie there.
        """
        self._path = path
        self._scans = 0
        self._failed = False
        self._origin = origin
        self._poses: FileIO | None = None
        shapes = {
            "": (),
            "scan": scan_shape,
            "pattern": pattern_shape,
            "deviation": pattern_shape if deviations else None,
            "traction": traction_shape,
            "poses": poses_shape,
        }
        self._layout: dict[str, tuple[str, tuple[int, ...]]] = {}
        columns = []
        for field in FIELDS:
            shape, column = shapes[field.kind.shape], field.in_array()
            if Out.NPZ in field.out and shape is not None:
                kind = field.kind.array
                if field.kind.shape == "poses":
                    column = column._replace(make=partial(_filled_up, taps=shape[0]))
                self._layout[field.name] = (kind, (len(field.parts),) if field.parts else shape)
                columns.append(column._replace(unknown=np.full(shape, column.unknown, kind)) if shape else column)
        self._columns = Columns(columns)
        self._layout["origin"] = self._layout["source"]
        self._cells = [(name, np.dtype(kind), shape) for name, (kind, shape) in self._layout.items()]
        parts = parts_dir(path)
        if path.is_dir():
            raise SinkError(f"cannot record into {path}: it is a directory")
        if path.exists():
            raise SinkError(f"{path} exists: give another name, or delete it first")
        try:
            parts.mkdir()
            (parts / LAYOUT).write_text(json.dumps(self._layout))
            texts = {name: mounting_text(one) for name, one in (mountings or {}).items()}
            (parts / MOUNTINGS).write_text(json.dumps(texts))
            self._rows = (parts / ROWS).open("wb", buffering=0)
        except FileExistsError as error:
            raise SinkError(
                f"{parts} holds a recording that was not finished: {_remedy(path)}, or delete it"
            ) from error
        except OSError as error:
            raise SinkError(f"cannot record into {parts}: {error.strerror}") from error

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add one row to every array."""
        row = [*self._columns.of(result), self._origin or result.source]
        data = b"".join(_row_bytes(*cell, value) for cell, value in zip(self._cells, row, strict=True))
        try:
            _write_whole(self._rows, data)
        except OSError as error:
            raise self._failure(error) from error
        self._scans += 1

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Add one row for each pose."""
        try:
            if self._poses is None:
                self._poses = (parts_dir(self._path) / POSE_ROWS).open("wb", buffering=0)
            _write_whole(self._poses, pose_rows(poses))
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Make arrays of the rows. Without a single scan nothing is written."""
        self._rows.close()
        if self._poses is not None:
            self._poses.close()
        if self._failed:
            return
        if self._scans:
            with finishing(draft_of(self._path)):
                gather(self._path)
        else:
            shutil.rmtree(parts_dir(self._path), ignore_errors=True)

    def _failure(self, error: OSError) -> SinkError:
        self._failed = True
        reason = error.strerror or error
        return SinkError(f"recording into {self._path} stopped: {reason}; of {self._scans} scans {_remedy(self._path)}")


def parts_dir(path: Path) -> Path:
    """Return the folder in which the rows of `path` grow."""
    return path.with_name(path.name + ".parts")


def draft_of(path: Path) -> Path:
    """Return the name under which the .npz grows until it is whole."""
    return path.with_name(path.name + ".draft")


def gather(path: Path) -> int:
    """Make the .npz of its rows, delete them, and return the number of scans.

    A last row that a crash left incomplete is left out.

    Raises:
        SinkError: there are no rows, or no room, or the file exists already.
    """
    parts, draft = parts_dir(path), draft_of(path)
    if not parts.exists():
        what = "is finished, and can be read as it is" if path.exists() else "is not there, finished or not"
        raise SinkError(f"{path} {what}: a recording that a crash interrupted has {parts}")
    if path.exists():
        raise SinkError(f"{path} exists, and is not replaced by what {parts} holds: move it away, then {_remedy(path)}")
    try:
        row = np.dtype([(name, kind, tuple(shape)) for name, (kind, shape) in _read_layout(parts).items()])
        scans = (parts / ROWS).stat().st_size // row.itemsize
        if scans == 0:
            raise SinkError(f"{parts} holds no scan: delete it")
        rows = np.memmap(parts / ROWS, dtype=row, mode="r", shape=scans)
        with (
            zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
            Progress(path.name, scans * row.itemsize, "B") as bar,
        ):
            mountings = parts / MOUNTINGS  # earlier releases left parts without it
            texts = mountings.read_text() if mountings.exists() else "{}"
            for name, value in (("format", NPZ_FORMAT), ("version", NPZ_VERSION), ("mountings", texts)):
                with archive.open(f"{name}.npy", "w") as entry:
                    npy.write_array(entry, np.asarray(value))
            for name in sorted(row.names or (), key=lambda name: name != "origin"):  # first: what loses its end has it
                column = rows[name]
                header = {"descr": column.dtype.str, "fortran_order": False, "shape": column.shape}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    npy.write_array_header_1_0(entry, header)
                    for start in range(0, scans, CHUNK_SCANS):
                        chunk = column[start : start + CHUNK_SCANS].tobytes()
                        entry.write(chunk)
                        bar.advance(len(chunk))
            add_pose_arrays(archive, parts / POSE_ROWS)
        with draft.open("rb") as file:
            os.fsync(file.fileno())  # otherwise a power cut could leave an empty .npz, and no rows
        draft.replace(path)
        shutil.rmtree(parts)
    except OSError as error:
        draft.unlink(missing_ok=True)
        if isinstance(error, SinkError):
            raise
        reason = error.strerror or error
        raise SinkError(f"cannot gather {parts}: {reason}; the parts are kept: {_remedy(path)}") from error
    return scans


def _write_whole(file: FileIO, data: bytes) -> None:
    while data:  # a disk that fills takes a part of it, and refuses the rest
        data = data[file.write(data) :]


def _filled_up(poses: NDArray[np.float32], taps: int) -> NDArray[np.float32]:
    """Return the poses (K, 5) of fewer taps, with NaN for the others."""
    return np.pad(poses, ((0, taps - len(poses)), (0, 0)), constant_values=np.nan)


def _read_layout(parts: Path) -> dict[str, tuple[str, list[int]]]:
    try:
        return json.loads((parts / LAYOUT).read_text())
    except ValueError as error:
        raise SinkError(f"{parts / LAYOUT} cannot be read: these parts cannot be gathered") from error


def _row_bytes(name: str, kind: np.dtype, shape: tuple[int, ...], value: ArrayLike) -> bytes:
    row = np.asarray(value, dtype=kind)
    if row.shape != shape:
        raise SinkError(f"{name} has shape {row.shape}, expected {shape}")
    if isinstance(value, str) and row.item() != value:
        raise SinkError(f"{name} {value!r} is too long to record")
    return row.tobytes()


def _remedy(path: Path) -> str:
    return f"`python -m edge.sinks.npz {path}` makes the .npz"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the .npz from the parts that a crash left; return an exit code."""
    parser = argparse.ArgumentParser(prog="python -m edge.sinks.npz", description=main.__doc__)
    parser.add_argument("file", type=Path, metavar="FILE.npz", help="name of the recording")
    path: Path = parser.parse_args(arguments).file
    try:
        scans = gather(path)
    except SinkError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"{path}: {scans} scans\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
