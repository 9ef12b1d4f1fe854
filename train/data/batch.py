"""Batch to train on."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

_MIRRORED = torch.tensor([-1.0, 1.0, -1.0, 1.0, 1.0])
"""Signs of a pose's x, y, turn and errors in a mirror image."""


def _quarter(x: Tensor, y: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Return the parts of a vector after `turns` quarter turns from y to x: down becomes right, right becomes up."""
    return ((x, y), (y, -x), (-x, -y), (-y, x))[turns]


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

    def turned(self, quarters: Tensor) -> "Batch":
        """Return the batch with each window turned by so many quarters, (n,), from y to x.

        Without poses the windows are of one tap, or of taps whose schedule a turn of all pads does not change.
        """

        def image_of(maps: Tensor, vectors: bool) -> Tensor:
            image = maps.clone()
            for turns in range(1, 4):
                which = quarters == turns
                part = maps[which].rot90(turns, (-2, -1))
                if vectors:
                    x, y = _quarter(part[:, ::3], part[:, 1::3], turns)
                    part = torch.stack([x, y, part[:, 2::3]], dim=2).flatten(1, 2)
                image[which] = part
            return image

        poses = self.poses
        if poses is not None:
            x, y, *others = poses.unbind(dim=2)
            places = torch.stack([torch.stack(_quarter(x, y, turns)) for turns in range(4)])
            x, y = places[quarters, :, torch.arange(len(quarters))].unbind(dim=1)
            poses = torch.stack([x, y, *others], dim=2)
        return replace(
            self,
            window=image_of(self.window, True),
            pattern=image_of(self.pattern, False),
            traction=None if self.traction is None else image_of(self.traction, True),
            poses=poses,
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
