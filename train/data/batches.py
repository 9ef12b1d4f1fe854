"""Batch to train on, and the units of its windows."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

COUNTS_PER_UNIT: Final = (500.0, 500.0, 1000.0)
"""Counts of x, y, z that make one unit of network input."""
_MIRRORED = torch.tensor([-1.0, 1.0, -1.0, 1.0, 1.0])
"""Signs of a pose's x, y, turn and errors in a mirror image."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Windows and their truth.

    Attributes:
        window: (n, 3K, rows, cols) in network units.
        pattern: (n, H, W) in [mm].
        pad: (n, known), inputs of the pads, or None.
        traction: (n, 3, h, w) in [kPa], or None if it is not trained on.
        poses: (n, K, 5) of the taps in the newest one's axes, with their errors; None for a fixed schedule.
    """

    window: Tensor
    pattern: Tensor
    pad: Tensor | None = None
    traction: Tensor | None = None
    poses: Tensor | None = None

    def mirrored(self, which: Tensor) -> "Batch":
        """Return the batch with mirror images, left for right, of some windows, (n,) of bool.

        Without poses the windows are of one tap: a mirrored pad would turn the other way from tap to tap.
        """

        def flipped(maps: Tensor, vectors: bool) -> Tensor:
            image = maps.flip(-1)
            if vectors:
                image[:, ::3] *= -1  # x points the other way
            return torch.where(which.view(-1, *[1] * (maps.ndim - 1)), image, maps)

        return replace(
            self,
            window=flipped(self.window, True),
            pattern=flipped(self.pattern, False),
            traction=None if self.traction is None else flipped(self.traction, True),
            poses=None if self.poses is None else torch.where(which[:, None, None], self.poses * _MIRRORED, self.poses),
        )

    def share(self, rank: int, world: int, device: torch.device) -> "Batch":
        """Return the part of one of several processes, on its device."""

        def mine(part: Tensor) -> Tensor:
            return part[rank::world].to(device)

        return Batch(
            mine(self.window),
            mine(self.pattern),
            None if self.pad is None else mine(self.pad),
            None if self.traction is None else mine(self.traction),
            None if self.poses is None else mine(self.poses),
        )


def network_input(window_counts: NDArray[np.float32]) -> Tensor:
    """Convert windows (n, K, 3, rows, cols) in zeroed counts to network input (n, 3K, rows, cols)."""
    per_unit = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]
    return torch.from_numpy((window_counts / per_unit).reshape(len(window_counts), -1, *window_counts.shape[3:]))
