"""Map as a live page shows it, with what has changed since each earlier state."""

from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.mapping.footprint import Grid
from firmware_bridge.poses.pad_pose import PadPose

STATES: Final = 32
"""States from which a page needs what has changed alone: eight seconds; an older one gets the whole map."""


class Box(NamedTuple):
    """Rows and columns of a map, from the first to below the last."""

    top: int
    left: int
    bottom: int
    right: int


class MapState(NamedTuple):
    """State of a map.

    Attributes:
        number: from 1.
        grid: of the map.
        contact: (H, W), NaN where nothing is known.
        doubted: (H, W).
        pads: pose of each pad on the map, by its sensor.
        counts: patterns fused, doubted and left out, by name.
        changes: number of each of the latest states, with what it changed; None for nothing.
    """

    number: int
    grid: Grid
    contact: NDArray[np.float32]
    doubted: NDArray[np.float32]
    pads: Mapping[str, PadPose]
    counts: Mapping[str, int]
    changes: tuple[tuple[int, Box | None], ...]

    def since(self, number: int) -> Box | None:
        """Return what has changed since a state; None for nothing."""
        height, width = self.contact.shape
        if not self.changes or self.changes[0][0] > number + 1:
            return Box(0, 0, height, width)
        boxes = [box for at, box in self.changes if at > number and box is not None]
        if not boxes:
            return None
        top, left = min(box.top for box in boxes), min(box.left for box in boxes)
        return Box(top, left, max(box.bottom for box in boxes), max(box.right for box in boxes))


class LiveMap:
    """States of one map, one after the other; each is replaced as a whole, so that a reader sees no half of one."""

    def __init__(self, grid: Grid) -> None:
        """Begin with an empty map."""
        self._grid = grid
        self._number = 0
        self._contact = np.full((grid.pixels, grid.pixels), np.nan, dtype=np.float32)
        self._doubted = np.zeros_like(self._contact)
        self._changes: deque[tuple[int, Box | None]] = deque(maxlen=STATES)

    def next(
        self,
        contact: NDArray[np.float32],
        doubted: NDArray[np.float32],
        pads: Mapping[str, PadPose],
        counts: Mapping[str, int],
    ) -> MapState:
        """Return the next state, of layers that nobody changes any more."""
        # Bits are compared, since a NaN is not equal to itself.
        changed = (contact.view(np.int32) != self._contact.view(np.int32)) | (doubted != self._doubted)
        self._contact, self._doubted = contact, doubted
        self._number += 1
        self._changes.append((self._number, _box(changed)))
        return MapState(self._number, self._grid, contact, doubted, dict(pads), dict(counts), tuple(self._changes))


def _box(changed: NDArray[np.bool_]) -> Box | None:
    rows, cols = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    return Box(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1) if len(rows) else None
