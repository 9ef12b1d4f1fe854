"""Arrays from users' npz files: no pickle is loaded, and no memory is allocated by an unchecked header."""

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from firmware_bridge.errors import NpzError

LONGEST_READ_BYTES: Final = 1 << 20
"""Most bytes of one read: zipfile reads a table of contents in one piece, whose members could take gigabytes."""
_SURROGATES: Final = (0xD800, 0xDFFF)
_BROKEN: Final = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, TypeError, LookupError, OverflowError),
    RuntimeError,  # encrypted, with an unsupported compression, or nested too deep
    *(SyntaxError, TokenError, MemoryError, Warning),  # errors that numpy's reader of the header passes on
)
_HEADERS: Final = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_LOCAL: Final = struct.Struct("<4sHHHIIIIHH")
"""Head of a member: mark, version, flags, compression, time, check sum, sizes, and lengths of name and extra field."""
_CENTRAL: Final = struct.Struct("<4sHHHHIIIIHHHHHII")
"""The same in the directory, with three more fields of nothing, attributes, and the place of the member."""
_END: Final = struct.Struct("<4sHHHHIIH")
_MOST_SALVAGED_BYTES: Final = 1 << 31
_COMPRESSIONS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. zipfile unpacks others without a limit on the output of one piece."""


def read_npz(
    path: Path, names: Iterable[str], most_bytes: int, damaged: Callable[[], object] | None = None
) -> dict[str, NDArray[Any]]:
    """Read the arrays of these names that are in the file; others are not read.

    Args:
        path: path of the file.
        names: names of the arrays.
        most_bytes: largest allowed size of them together.
        damaged: called where the file has lost its end, to read the arrays that are whole; without it that is refused.

    Raises:
        NpzError: not an archive of plain arrays of numbers and text, damaged, or larger.
        OSError: the file cannot be read.
    """
    try:
        with warnings.catch_warnings(), _ShortReads(io.FileIO(path)) as file, ExitStack() as opened:
            warnings.simplefilter("error")  # numpy repairs headers of Python 2 with a warning, also for broken ones
            begins = file.read(4) == b"PK\3\4"
            if damaged is not None and begins and not zipfile.is_zipfile(file):
                copy = opened.enter_context(TemporaryFile())
                _copy_whole(file, copy)
                file = copy
                damaged()
            archive = opened.enter_context(zipfile.ZipFile(file))
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


def _copy_whole(file: BinaryIO, copy: BinaryIO) -> None:
    """Copy an archive that lost its end, where its directory is, with a directory of its members that are whole."""
    size_bytes, at, directory, count = file.seek(0, io.SEEK_END), 0, bytearray(), 0
    while True:
        file.seek(at)
        head = file.read(_LOCAL.size)
        if len(head) < _LOCAL.size or not head.startswith(b"PK\3\4"):
            break
        _, version, flags, method, time, crc, packed, whole, name_bytes, extra_bytes = _LOCAL.unpack(head)
        name, extra = file.read(name_bytes), file.read(extra_bytes)
        if extra.startswith(b"\1\0\x10\0"):  # sizes of eight bytes, as for a member of unknown length
            whole, packed = struct.unpack_from("<QQ", extra, 4)
        end = file.tell() + packed
        if end > min(size_bytes, _MOST_SALVAGED_BYTES) or flags & 8:
            break
        sizes = (crc, packed, whole, len(name), 0, 0, 0, 0, 0, at)
        directory += _CENTRAL.pack(b"PK\1\2", version, version, flags, method, time, *sizes) + name
        at, count = end, count + 1
    file.seek(0)
    while left := min(at - file.tell(), LONGEST_READ_BYTES):
        copy.write(file.read(left))
    copy.write(directory + _END.pack(b"PK\5\6", 0, 0, count, count, len(directory), at, 0))


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
        if points.max() > 0x10FFFF or ((points >= low) & (points <= high)).any():
            raise NpzError(f"{info.filename} holds text that is not Unicode")
    return array
