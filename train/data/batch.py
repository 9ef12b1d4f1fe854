"""A batch to learn from."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Batch:
    """Windows and their truth.

    Attributes:
        window: (n, 3K, rows, cols) in network units.
        pattern: (n, H, W) in [mm].
        pad: (n, known), what is known of the pads, or None.
        traction: (n, 3, h, w) in [kPa], or None where it is not learned.
    """

    window: Tensor
    pattern: Tensor
    pad: Tensor | None = None
    traction: Tensor | None = None

    def share(self, rank: int, world: int, device: torch.device) -> "Batch":
        """Return the part of one of several processes, on its device."""

        def mine(part: Tensor) -> Tensor:
            return part[rank::world].to(device)

        return Batch(
            mine(self.window),
            mine(self.pattern),
            None if self.pad is None else mine(self.pad),
            None if self.traction is None else mine(self.traction),
        )
