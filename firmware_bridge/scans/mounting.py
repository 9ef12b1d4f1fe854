"""Mounting of a sensor where it is used: the places of its taxels, and the directions of its axes.

Raw counts are put in their place when a scan is made, and stay raw; axes are turned when counts become deformation. So
a recording holds the raw counts of the chips, each at the place of its taxel. Forces from the vendor's software are
never zeroed: their axes are turned at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.can_id_maps import ModelMap
from firmware_bridge.scans.scan import Scan, VendorReading

AS_MAPPED: Final = tuple(range(USPA44.taxel_count))  # default order of the default pad's taxels


@dataclass(frozen=True)
class Mounting:
    """Mounting of one sensor; by default that of its id map. Invalid values raise a ValueError."""

    order: tuple[int, ...] = ()  # for each place, row-major from the top left, the id map's taxel there
    swap_xy: bool = False  # True where the wire's x is the pad's y, and the other way round
    signs: tuple[int, int, int] = (1, 1, 1)  # 1 or -1 for x (to the right), y (down), z (into the pad), after the swap
    taxel_count: int = USPA44.taxel_count

    def __post_init__(self) -> None:
        count = self.taxel_count
        object.__setattr__(self, "order", self.order or tuple(range(count)))
        if sorted(self.order) != list(range(count)):
            raise ValueError(f"order is {list(self.order)}, expected each of 0..{count - 1} once")
        if len(self.signs) != len(AXES) or not set(self.signs) <= {1, -1}:
            raise ValueError(f"signs are {list(self.signs)}, expected three of 1 and -1")

    @property
    def moves_taxels(self) -> bool:
        """True if some taxel lies elsewhere than in the id map."""
        return self.order != tuple(range(self.taxel_count))

    @property
    def turns_axes(self) -> bool:
        """True if the pad's axes differ from the wire's, or point the other way."""
        return self.swap_xy or self.signs != (1, 1, 1)

    def correct(self, deformation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Turn deformation (3, rows, cols), in place but along the wire's axes, to the pad's axes, in [counts]."""
        turned = deformation[[1, 0, 2]] if self.swap_xy else deformation.copy()
        turned *= np.asarray(self.signs, dtype=np.float32)[:, None, None]
        return turned

    def place_counts(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of all taxels, (..., rows, cols), from the order of the id map at the places on the pad."""
        return values.reshape(*values.shape[:-2], -1)[..., list(self.order)].reshape(values.shape)

    def place(self, scan: Scan) -> Scan:
        """Reorder a scan from the order of the id map to the places on the pad, and turn the vendor's newtons."""
        counts, fresh, renewed = map(self.place_counts, (scan.counts, scan.fresh, scan.renewed))
        for array in (counts, fresh, renewed):
            array.setflags(write=False)
        vendor = None if scan.vendor is None else self._place_vendor(scan.vendor)
        return replace(scan, counts=counts, fresh=fresh, renewed=renewed, vendor=vendor)

    def then(self, correction: "Mounting") -> "Mounting":
        """Return this mounting with a correction that was measured on a sensor already mounted by it."""
        order = np.asarray(self.order)[list(correction.order)]
        swap = [1, 0, 2] if correction.swap_xy else [0, 1, 2]
        signs = [self.signs[axis] * sign for axis, sign in zip(swap, correction.signs, strict=True)]
        return Mounting(
            tuple(order.tolist()),
            self.swap_xy != correction.swap_xy,
            (signs[0], signs[1], signs[2]),
            self.taxel_count,
        )

    def _place_vendor(self, vendor: VendorReading) -> VendorReading:
        newtons, temperature_k, ups_hz = (
            None if array is None else self.place_counts(array)
            for array in (vendor.newtons, vendor.temperature_k, vendor.ups_hz)
        )
        return VendorReading(None if newtons is None else self.correct(newtons), temperature_k, ups_hz)


def placed_map(model: ModelMap, mountings: Mapping[str, Mounting], prefix: str = "") -> ModelMap:
    """Return an id map with taxels at their places on the pad; `mountings` are by names of sensors with `prefix`."""
    place_of = {
        sensor: {taxel: place for place, taxel in enumerate(mounting.order)}
        for sensor, mounting in mountings.items()
        if mounting.moves_taxels
    }
    if not place_of and not prefix:
        return model
    placed = {
        can_id: (prefix + sensor, place_of[prefix + sensor][taxel] if prefix + sensor in place_of else taxel)
        for can_id, (sensor, taxel) in model.taxels.items()
    }
    return replace(model, taxels=MappingProxyType(placed))
