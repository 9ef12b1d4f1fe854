"""Maps from CAN frames to taxel readings of XELA uSkin sensors. No I/O.

One taxel per frame, eight bytes: byte 0 unused, X, Y, Z as unsigned big-endian 16 bit, byte 7
unused. The unused bytes are not zero. The id of a taxel depends on the controller's age:

    layout C (current)     id = SDA << 8 | taxel << 4 | controller
    layout A (2018-2019)   id = 0x700 | board << 4 | taxel         speaks only after a trigger
    layout B (early 2020)  id = board << 8 | n, n = 0..31          two sensors a board; trigger

A sensor's label does not show its map; with the wrong one, half of the taxels stay silent.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.pad_geometry import MOST_TAXELS, USPA44, USPA46, SensorGeometry

CONTROLLERS: Final = range(16)

BOARDS: Final = range(1, 8)


@dataclass(frozen=True, slots=True)
class ModelMap:
    """Map from CAN ids to the taxels of sensors."""

    name: str  # name of the sensor model or layout
    geometry: SensorGeometry  # geometry of each sensor
    taxels: Mapping[int, tuple[str, int]]  # CAN id -> (sensor, taxel)
    triggered: bool = False  # True where a controller stays silent until it gets its trigger

    def __post_init__(self) -> None:
        if not 0 < self.geometry.taxel_count <= MOST_TAXELS:
            raise ValueError(f"{self.name} has {self.geometry.taxel_count} taxels, expected 1 to {MOST_TAXELS}")

    @property
    def triggers(self) -> tuple[CanFrame, ...]:
        """Frames that start the controllers, if they need any: each board obeys only its own."""
        return tuple(CanFrame(0x200 | board, bytes((0x07, 0x00))) for board in BOARDS) if self.triggered else ()

    def wire_order(self, sensor: str) -> list[tuple[int, int]]:
        """Return (CAN id, taxel) of one sensor by ascending id, which is the order of SDA, then taxel."""
        return sorted((can_id, taxel) for can_id, (name, taxel) in self.taxels.items() if name == sensor)


def layout_c(geometry: SensorGeometry) -> ModelMap:
    """Return the id map of a current controller whose SDAs are the rows, their taxels numbered from right to left."""
    rows, cols = geometry.rows, geometry.cols
    if rows > 8 or cols > 16:  # more than ids can name
        raise ValueError(f"{rows} x {cols} taxels, expected at most 8 x 16")
    taxels = {
        sda << 8 | taxel << 4 | controller: (str(controller), sda * cols + (cols - 1 - taxel))
        for controller in CONTROLLERS
        for sda in range(rows)
        for taxel in range(cols)
    }
    return ModelMap(geometry.name, geometry, MappingProxyType(taxels))


USPA44_MAP: Final = layout_c(USPA44)
USPA46_MAP: Final = layout_c(USPA46)  # ids from the manual; columns from right to left, as inferred from uSPa44
# Two SDAs of two rows each; columns as inferred from uSPa44, the same board.
_XR1944: Final = {
    sda << 8 | taxel << 4 | controller: (str(controller), (sda * 2 + taxel // 4) * 4 + (3 - taxel % 4))
    for controller in CONTROLLERS
    for sda in range(2)
    for taxel in range(8)
}
_A: Final = {0x700 | board << 4 | taxel: (str(board), taxel) for board in BOARDS for taxel in range(16)}
_B: Final = {board << 8 | n: (f"{board}{'ab'[n // 16]}", n % 16) for board in BOARDS for n in range(32)}
XR1944_MAP: Final = ModelMap("XR1944", USPA44, MappingProxyType(_XR1944))
LAYOUT_A_MAP: Final = ModelMap("layout A", USPA44, MappingProxyType(_A), triggered=True)
LAYOUT_B_MAP: Final = ModelMap("layout B", USPA44, MappingProxyType(_B), triggered=True)

ID_MAPS: Final = {
    "uSPa44": USPA44_MAP,
    "uSPa46": USPA46_MAP,
    "XR1944": XR1944_MAP,
    "A": LAYOUT_A_MAP,
    "B": LAYOUT_B_MAP,
}
"""Maps by the name that a user enters."""
