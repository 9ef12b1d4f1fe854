"""Arrays from users' npz files: no pickle is loaded, and no memory is allocated by an unchecked header."""

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from math import prod
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from firmware_bridge.errors import NpzError

LONGEST_READ_BYTES: Final = 1 << 20
"""Most bytes of one read. zipfile reads a table of contents in one piece, and millions of empty members take gigabytes.
numpy reads arrays in pieces of 256 kB, or of one element: so no text in an array can be longer than this either."""
HIGHEST_CODE_POINT: Final = 0x10FFFF
_SURROGATES: Final = (0xD800, 0xDFFF)
_BROKEN: Final = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, TypeError, LookupError, OverflowError),
    RuntimeError,  # encrypted, with an unsupported compression, or nested too deep
    *(SyntaxError, TokenError, MemoryError, Warning),  # errors that numpy's reader of the header passes on
)
_HEADERS: Final = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_COMPRESSIONS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. zipfile unpacks others without a limit on the output of one piece."""


def read_npz(path: Path, names: Iterable[str], most_bytes: int) -> dict[str, NDArray[Any]]:
    """Read the arrays of these names that are in the file; others are not read.

    Args:
        path: path of the file.
        names: names of the arrays.
        most_bytes: largest allowed size of them together, in bytes.

    Raises:
        NpzError: not an archive of plain arrays of numbers and text, damaged, or larger.
        OSError: the file cannot be read.
    """
    try:
        with warnings.catch_warnings(), _ShortReads(io.FileIO(path)) as file, zipfile.ZipFile(file) as archive:
            warnings.simplefilter("error")  # numpy repairs headers of Python 2 with a warning, also for broken ones
            members = {info.filename: info for info in archive.infolist()}
            wanted = {name: members[f"{name}.npy"] for name in names if f"{name}.npy" in members}
            total_bytes = sum(info.file_size for info in wanted.values())
            if total_bytes > most_bytes:
                raise NpzError(f"arrays of {total_bytes:,} bytes, expected at most {most_bytes:,}")
            return {name: _read_member(archive, info) for name, info in wanted.items()}
    except NpzError:
        raise
    except _BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise NpzError(f"not a whole .npz archive of plain arrays: {reason[:200]}") from error


class _ShortReads(io.BufferedReader):
    """File that refuses to read more than LONGEST_READ_BYTES in one piece."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > LONGEST_READ_BYTES:
            raise zipfile.BadZipFile(f"a piece of {size:,} bytes, expected at most {LONGEST_READ_BYTES:,}")
        return super().read(size)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    if info.compress_type not in _COMPRESSIONS:
        raise NpzError(f"{info.filename} is compressed in another way than numpy's: save it again with numpy")
    with archive.open(info) as entry:
        version = npy.read_magic(entry)
        if version not in _HEADERS:
            raise NpzError(f"{info.filename} is of npy version {version}, expected (1, 0) or (2, 0)")
        shape, _, dtype = _HEADERS[version](entry)
        if dtype.hasobject or dtype.kind not in "biufU":
            raise NpzError(f"{info.filename} holds {dtype}, expected plain arrays of numbers or text")
        stated_bytes, held_bytes = prod(shape) * dtype.itemsize, info.file_size - entry.tell()
        if stated_bytes != held_bytes:
            raise NpzError(f"{info.filename} states {stated_bytes} bytes and holds {held_bytes}: it is damaged")
    with archive.open(info) as entry:
        array = npy.read_array(entry, allow_pickle=False)
        if entry.read(1):  # reading to the end also verifies the checksum
            raise NpzError(f"{info.filename} holds more than its array: it is damaged")
    if dtype.kind == "U" and array.size and dtype.itemsize:
        points = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(dtype.byteorder))
        low, high = _SURROGATES
        if points.max() > HIGHEST_CODE_POINT or ((points >= low) & (points <= high)).any():
            raise NpzError(f"{info.filename} holds text that is not Unicode")
    return array
