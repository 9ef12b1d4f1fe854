"""Layout of `shm:NAME`: latest values in shared memory. docs/middleware.md holds it as tables.

Each sensor has a slot, and each slot two halves: the writer fills the half that is not the newest and then counts
`sequence` up, so that a reader never waits, not even for a writer that was stopped or killed half-way. A reader's copy
is whole if the half holds that sequence and its checksum is right. On x86-64 stores and loads keep their order and the
checksum fails only for a copy that took longer than a period; elsewhere it replaces the barriers that Python lacks.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np

from edge.perception.field import PLACE_IN_HEADER
from edge.perception.result_fields import FIELDS

FOLDER: Final = "/dev/shm"
MAGIC: Final = b"TESR-SHM"
VERSION: Final = 1
SLOTS: Final = 32
LINE_BYTES: Final = 64
"""Size of a cache line: values that different processes write and read often lie in lines of their own."""
HEADER_BYTES: Final = 192
HEARTBEAT_AT: Final = 128

_SIZES: Final = ("version", "header_bytes", "slots", "slot_bytes", "half_bytes", "first_half_at")
_SHAPES: Final = ("rows", "cols", "height", "width", "zeroed_at", "counts_at", "pattern_at", "deviation_at")
HEADER: Final = (
    ("magic", "8s"),
    *((name, "I") for name in (*_SIZES, *_SHAPES)),
    *(("writer_pid", "Q"), ("pattern_unit", "16s")),
    *((name, "I") for name in ("traction_at", "traction_height", "traction_width")),
)
"""Name and struct's character of each field from byte 0 on; then, at HEARTBEAT_AT, `heartbeat_ns`, a q.

`traction_at` is 0 where the model gives no traction, and with writers from before tractions, whose halves lack the
fields from `wrench_origin` on.
"""

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
    """Places of all values for a sensor of rows x cols taxels and patterns of height x width pixels.

    Attributes:
        traction_shape: (3, h, w), where there is a traction.
    """

    rows: int
    cols: int
    height: int
    width: int
    traction_shape: tuple[int, int, int] | None = None

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
            *(MAGIC, VERSION, HEADER_BYTES, SLOTS, self.slot_bytes, self.half_bytes, LINE_BYTES),
            *(self.rows, self.cols, self.height, self.width),
            *(self.maps[name][2] for name in ("zeroed", "counts", "pattern", "deviation")),
            writer_pid,
            pattern_unit.encode()[:16],
            *((0, 0, 0) if self.traction_shape is None else (self.maps["traction"][2], *self.traction_shape[1:])),
        )


def _aligned(size: int, to: int) -> int:
    return -(-size // to) * to
