"""Latest result of each sensor in shared memory, for a control loop on the same machine. Linux.

docs/middleware.md holds the layout as tables. The writer fills the half of a slot that is not the newest, then counts
`sequence` up, so that a reader never waits, not even for a writer that was killed half-way. A copy is whole if the half
holds that sequence and its checksum is right; the checksum stands for the barriers that Python lacks.
"""

import fcntl
import math
import mmap
import os
import re
import struct
import time
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.record_fields import FIELDS, PLACE_IN_HEADER, Column, Columns
from edge.perception.result import Result
from edge.pipeline.sink import Sink

FOLDER: Final = Path("/dev/shm")
MAGIC: Final = b"TESR-SHM"
SLOTS: Final = 32
LINE_BYTES: Final = 64
"""Size of a cache line: values that different processes write and read often lie in lines of their own."""
HEADER_BYTES: Final = 192
HEARTBEAT_AT: Final = 128

HEADER: Final = (
    ("magic", "8s"),
    *((name, "I") for name in ("version", "header_bytes", "slots", "slot_bytes", "half_bytes", "first_half_at")),
    *((name, "I") for name in ("rows", "cols", "height", "width")),
    *((name, "I") for name in ("zeroed_at", "counts_at", "pattern_at", "deviation_at")),
    *(("writer_pid", "Q"), ("pattern_unit", "16s")),
    *((name, "I") for name in ("traction_at", "traction_height", "traction_width")),
)
"""Name and struct's character of each field from byte 0 on; then, at HEARTBEAT_AT, `heartbeat_ns`, a q."""

IN_MEMORY: Final = sorted((field for field in FIELDS if (field.byte or 0) > 0), key=lambda field: field.byte or 0)
"""Single values and vectors of a result, in the order of their bytes."""
MEMBERS: Final = (
    *(("checksum", "I"), ("reserved", "I"), ("sequence", "Q")),
    *((name, field.kind.packed) for field in IN_MEMORY for name in field.names),
)
"""Name and struct's character of each member of a half; its maps follow."""
MAPS_IN_MEMORY: Final = tuple(field for field in FIELDS if field.byte == PLACE_IN_HEADER)


def struct_of(fields: tuple[tuple[str, str], ...]) -> struct.Struct:
    """Return the struct of fields side by side, little-endian."""
    return struct.Struct("<" + "".join(kind for _, kind in fields))


def offsets_of(fields: tuple[tuple[str, str], ...]) -> dict[str, int]:
    """Return the byte at which each field begins."""
    return {name: struct_of(fields[:index]).size for index, (name, _) in enumerate(fields)}


@dataclass(frozen=True, slots=True)
class Layout:
    """Places of all values for a sensor of rows x cols taxels and patterns of height x width pixels."""

    rows: int
    cols: int
    height: int
    width: int
    traction_shape: tuple[int, int, int] | None = None  # (3, h, w), where there is a traction

    @property
    def maps(self) -> dict[str, tuple[np.dtype, tuple[int, ...], int]]:
        """Type, shape and place in a half of each map, by name."""
        shapes: dict[str, tuple[int, ...] | None] = dict.fromkeys(("pattern", "deviation"), (self.height, self.width))
        shapes |= {"scan": (3, self.rows, self.cols), "traction": self.traction_shape}
        at, maps = struct_of(MEMBERS).size, {}
        for field in MAPS_IN_MEMORY:
            if (shape := shapes[field.kind.shape]) is not None:
                maps[field.name] = (np.dtype(field.kind.array), shape, at)
                at = _aligned(at + int(np.prod(shape)) * 4, 8)
        return maps

    @property
    def half_bytes(self) -> int:
        """Size of one half of a slot."""
        kind, shape, at = list(self.maps.values())[-1]
        return _aligned(at + int(np.prod(shape)) * kind.itemsize, LINE_BYTES)

    @property
    def slot_bytes(self) -> int:
        """Size of a slot: its sequence, alone in its line, and two halves."""
        return LINE_BYTES + 2 * self.half_bytes

    @property
    def total_bytes(self) -> int:
        """Size of everything."""
        return HEADER_BYTES + SLOTS * self.slot_bytes

    def header(self, writer_pid: int, pattern_unit: str) -> bytes:
        """Return the header's fields, without the heartbeat."""
        return struct_of(HEADER).pack(
            *(MAGIC, 1, HEADER_BYTES, SLOTS, self.slot_bytes, self.half_bytes, LINE_BYTES),
            *(self.rows, self.cols, self.height, self.width),
            *(self.maps[name][2] for name in ("zeroed", "counts", "pattern", "deviation")),
            writer_pid,
            pattern_unit.encode()[:16],
            *((0, 0, 0) if self.traction_shape is None else (self.maps["traction"][2], *self.traction_shape[1:])),
        )


_HEAD: Final = struct_of(MEMBERS)
_COLUMNS: Final = Columns(field.in_memory() for field in IN_MEMORY)
_WORD: Final = 8


class SharedMemorySink(Sink):
    """Writer of the layout; readers cost it nothing, however many and slow they are."""

    def __init__(self, name: str, contract: Contract) -> None:
        """Make the segment; one that a crash left over is replaced."""
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", name):
            raise SinkError(f"shm:{name} cannot be a name: expected letters, digits, '_', '.' and '-', 100 at most")
        self._path = FOLDER / name
        self._layout = Layout(contract.rows, contract.cols, *contract.pattern_shape, contract.traction_shape)
        try:
            self._file, self._memory = self._create(contract.output_unit)
        except SinkError:
            raise
        except OSError as error:
            raise SinkError(f"cannot make shared memory {self._path}: {error.strerror}") from error
        # This view stores eight bytes in one piece, where struct stores byte by byte.
        self._words = memoryview(self._memory).cast("Q")
        self._slots: dict[str, int] = {}
        self._draft = bytearray(self._layout.half_bytes)
        self._maps = {
            map_name: np.frombuffer(self._draft, kind, math.prod(shape), at).reshape(shape)
            for map_name, (kind, shape, at) in self._layout.maps.items()
        }
        self._map_columns = Columns(
            Column(field.attribute, field.make, math.nan) for field in MAPS_IN_MEMORY if field.name in self._maps
        )

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Replace the sensor's values."""
        sensor = result.scan.sensor
        slot_at = self._slots.get(sensor)
        if slot_at is None:
            if len(self._slots) == SLOTS:
                raise SinkError(f"shared memory {self._path} has room for {SLOTS} sensors, and {sensor} is one more")
            slot_at = self._slots[sensor] = HEADER_BYTES + len(self._slots) * self._layout.slot_bytes
        sequence = self._words[slot_at // _WORD] + 1
        self._fill(result, sequence)
        half_at = slot_at + LINE_BYTES + (sequence & 1) * self._layout.half_bytes
        self._memory[half_at : half_at + len(self._draft)] = self._draft
        self._words[slot_at // _WORD] = sequence
        self.wait()

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Store the heartbeat only: events have no place here, and the age of the values shows an outage."""
        self.wait()

    def wait(self) -> None:
        """Store the heartbeat, which shows that the writer lives while no scan comes."""
        self._words[HEARTBEAT_AT // _WORD] = time.monotonic_ns()

    def close(self) -> None:
        """Free the name; readers that still see the memory see that the run ended."""
        if self._file < 0:
            return
        self._words[HEARTBEAT_AT // _WORD] = 0
        self._unlink(self._file)
        self._words.release()
        self._memory.close()
        os.close(self._file)
        self._file = -1

    def _fill(self, result: Result, sequence: int) -> None:
        _HEAD.pack_into(self._draft, 0, 0, 0, sequence, *_COLUMNS.flat(result))
        # A map that this result lacks is filled with NaN, so that no older values stay.
        for place, values in zip(self._maps.values(), self._map_columns.of(result), strict=True):
            place[:] = values
        checksum = zlib.crc32(memoryview(self._draft)[8:])  # from `sequence` on
        self._draft[:4] = checksum.to_bytes(4, "little")

    def _create(self, pattern_unit: str) -> tuple[int, mmap.mmap]:
        """Make the segment whole under another name first, so that no reader sees a part of it."""
        draft = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        draft.unlink(missing_ok=True)
        descriptor = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held as long as this process lives
            os.posix_fallocate(descriptor, 0, self._layout.total_bytes)  # no memory: an error here, a signal later
            memory = mmap.mmap(descriptor, self._layout.total_bytes)
            header = self._layout.header(os.getpid(), pattern_unit)
            memory[: len(header)] = header
            memory[HEARTBEAT_AT : HEARTBEAT_AT + _WORD] = time.monotonic_ns().to_bytes(_WORD, "little")
            while True:
                try:
                    self._path.hardlink_to(draft)
                    break
                except FileExistsError:
                    self._take_over()
        except OSError:
            os.close(descriptor)
            raise
        finally:
            draft.unlink(missing_ok=True)
        return descriptor, memory

    def _take_over(self) -> None:
        """Remove the segment of a writer that has died; a SinkError where it lives, or the file is none of ours."""
        try:
            descriptor = os.open(self._path, os.O_RDWR | os.O_NOFOLLOW)
        except FileNotFoundError:
            return
        try:
            head = os.pread(descriptor, HEADER_BYTES, 0)
            if len(head) < HEADER_BYTES or not head.startswith(MAGIC):
                raise SinkError(f"{self._path} is another program's shared memory: choose another name after shm:")
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                (pid,) = struct.unpack_from("<Q", head, offsets_of(HEADER)["writer_pid"])
                raise SinkError(f"{self._path} is written by process {pid}: end it, or choose another name") from error
            os.pwrite(descriptor, bytes(_WORD), HEARTBEAT_AT)  # for readers that still look at it
            self._unlink(descriptor)
        finally:
            os.close(descriptor)

    def _unlink(self, descriptor: int) -> None:
        """Free the name, unless it is another's by now."""
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), self._path.stat()):
                self._path.unlink()


def _aligned(size: int, to: int) -> int:
    return -(-size // to) * to
