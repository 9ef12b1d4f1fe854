"""State of a map as a live page shows it, with what has changed since another."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.mapping.footprint import Grid
from firmware_bridge.poses.pad_pose import PadPose


class Box(NamedTuple):
    """Rows and columns of a map, from the first to below the last."""

    top: int
    left: int
    bottom: int
    right: int


class MapState(NamedTuple):
    """State of a map, numbered from 1: layers (H, W), poses of the pads by sensor, and patterns by their fate."""

    number: int
    grid: Grid
    contact: NDArray[np.float32]
    doubted: NDArray[np.float32]
    pads: Mapping[str, PadPose]
    counts: Mapping[str, int]

    def since(self, before: "MapState | None") -> Box | None:
        """Return the part that has changed since another state, or since an empty map; None for nothing."""
        if before is None:
            changed = ~np.isnan(self.contact) | (self.doubted != 0)
        else:  # bits are compared, since a NaN is not equal to itself
            changed = (self.contact.view(np.int32) != before.contact.view(np.int32)) | (self.doubted != before.doubted)
        rows, cols = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
        return Box(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1) if len(rows) else None
