"""A batch to learn from."""

from dataclasses import dataclass, fields

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
        """The part of one of several processes, on its device."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return Batch(**{name: None if part is None else part[rank::world].to(device) for name, part in parts.items()})
