"""How a sensor sits where it is used: which of its taxels lies where, and which way its axes point.

Raw counts are put in their place where a scan is made, and stay raw; axes are turned, and gains evened out, where
counts become deformation. So a record tells what the chips said, at the place where they lie. Forces that the vendor's
software tells are never zeroed: their axes are turned at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import AXES, USPA44
from firmware_bridge.scans.can_id_maps import ModelMap
from firmware_bridge.scans.scan import Scan, VendorReading

AS_MAPPED: Final = tuple(range(USPA44.taxel_count))
"""The default order, of the default pad."""


@dataclass(frozen=True)
class Mounting:
    """How one sensor sits; by default as its id map says.

    An order or gains that are left out, or empty, are those of the id map for so many taxels.

    Attributes:
        order: of each place on the pad, row-major from the top left, the taxel of the id map that lies there.
        swap_xy: the wire's x is the pad's y, and the other way round.
        signs: 1 or -1 of x (to the right), y (down) and z (into the pad), after the swap.
        gains: by which x, y and z of every place are multiplied, axis by axis, after the swap; 3 * taxels numbers.
        taxel_count: of the sensor.

    Raises:
        ValueError: one of these cannot be.
    """

    order: tuple[int, ...] = ()
    swap_xy: bool = False
    signs: tuple[int, int, int] = (1, 1, 1)
    gains: tuple[float, ...] = ()
    taxel_count: int = USPA44.taxel_count

    def __post_init__(self) -> None:
        count = self.taxel_count
        object.__setattr__(self, "order", self.order or tuple(range(count)))
        object.__setattr__(self, "gains", self.gains or (1.0,) * (len(AXES) * count))
        if sorted(self.order) != list(range(count)):
            raise ValueError(f"order is {list(self.order)}, expected each of 0..{count - 1} once")
        if len(self.signs) != len(AXES) or not set(self.signs) <= {1, -1}:
            raise ValueError(f"signs are {list(self.signs)}, expected three of 1 and -1")
        if len(self.gains) != len(AXES) * count or not all(0 < gain < np.inf for gain in self.gains):
            raise ValueError(f"gains are {list(self.gains)}, expected {len(AXES) * count} positive numbers")

    @property
    def moves_taxels(self) -> bool:
        """Some taxel lies elsewhere than its id map says."""
        return self.order != tuple(range(self.taxel_count))

    @property
    def evens_gains(self) -> bool:
        """Some reading is multiplied by another number than 1."""
        return any(gain != 1 for gain in self.gains)

    @property
    def reverses_axes(self) -> bool:
        """The pad's axes are others than the wire's, or point the other way."""
        return self.swap_xy or self.signs != (1, 1, 1)

    @property
    def turns_axes(self) -> bool:
        """Counts become deformation in another way than by the baseline alone."""
        return self.reverses_axes or self.evens_gains

    def correct(self, deformation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Deformation (3, rows, cols), in place but along the wire's axes, as the pad's axes have it, in counts."""
        turned = deformation[[1, 0, 2]] if self.swap_xy else deformation.copy()
        turned *= self._factors.reshape(turned.shape)
        return turned

    def place(self, scan: Scan) -> Scan:
        """A scan of taxels in the order of the id map, as they lie on the pad; what the vendor says of it as well.

        Counts stay along the wire's axes; the vendor's newtons are given along the pad's, by its own calibration still.
        """
        shape = scan.fresh.shape
        order = list(self.order)
        counts = scan.counts.reshape(len(AXES), -1)[:, order].reshape(scan.counts.shape)
        fresh, renewed = (array.ravel()[order].reshape(shape) for array in (scan.fresh, scan.renewed))
        for array in (counts, fresh, renewed):
            array.setflags(write=False)
        vendor = None if scan.vendor is None else self._place_vendor(scan.vendor)
        return replace(scan, counts=counts, fresh=fresh, renewed=renewed, vendor=vendor)

    def then(self, found: "Mounting") -> "Mounting":
        """This mounting, corrected by what was found of a sensor that had it already."""
        order = np.asarray(self.order)[list(found.order)]
        swap = [1, 0, 2] if found.swap_xy else [0, 1, 2]
        signs = [self.signs[axis] * sign for axis, sign in zip(swap, found.signs, strict=True)]
        gains = np.asarray(self.gains).reshape(len(AXES), -1)[swap][:, list(found.order)]
        gains *= np.asarray(found.gains).reshape(len(AXES), -1)
        return Mounting(
            tuple(order.tolist()),
            self.swap_xy != found.swap_xy,
            (signs[0], signs[1], signs[2]),
            tuple(gains.ravel().tolist()),
            self.taxel_count,
        )

    def _place_vendor(self, vendor: VendorReading) -> VendorReading:
        order = list(self.order)
        newtons = vendor.newtons
        if newtons is not None:
            along = newtons.reshape(len(AXES), -1)[[1, 0, 2] if self.swap_xy else [0, 1, 2]][:, order]
            along *= np.asarray(self.signs, dtype=np.float32)[:, None]
            newtons = along.reshape(newtons.shape)
        temperature_k, ups_hz = (
            None if array is None else array.ravel()[order].reshape(array.shape)
            for array in (vendor.temperature_k, vendor.ups_hz)
        )
        return VendorReading(newtons, temperature_k, ups_hz)

    @cached_property
    def _factors(self) -> NDArray[np.float32]:
        gains = np.asarray(self.gains, dtype=np.float32).reshape(len(AXES), -1)
        return gains * np.asarray(self.signs, dtype=np.float32)[:, None]


def placed_map(model: ModelMap, mountings: Mapping[str, Mounting]) -> ModelMap:
    """The same ids, for taxels where they lie: what costs little, since a scan is sorted by the map in any case.

    Args:
        model: of the sensors as they are wired.
        mountings: by sensor name; a sensor without one lies as the map says.
    """
    place_of = {
        sensor: {taxel: place for place, taxel in enumerate(mounting.order)}
        for sensor, mounting in mountings.items()
        if mounting.moves_taxels
    }
    if not place_of:
        return model
    placed = {
        can_id: (sensor, place_of[sensor][taxel] if sensor in place_of else taxel)
        for can_id, (sensor, taxel) in model.taxels.items()
    }
    return replace(model, taxels=MappingProxyType(placed))
