"""Frame of a pad on the robot, as its user measured it."""

import math
from dataclasses import dataclass
from typing import Final

LARGEST_MM: Final = 1e5
_OFF: Final = 1e-3
"""Most by which a quaternion's norm may differ from 1."""


@dataclass(frozen=True)
class PadFrame:
    """Place of a pad in a frame of the robot: the middle of its face, x to the right, y down, z into the pad.

    Attributes:
        parent: name of the robot's frame, such as "tool0".
        place_mm: x, y, z of the middle of the face in the parent, in [mm].
        quaternion: x, y, z, w of the turn from the parent's axes to the pad's.

    Raises:
        ValueError: one of these is invalid.
    """

    parent: str
    place_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if not self.parent or self.parent.startswith("/") or not self.parent.isprintable() or " " in self.parent:
            raise ValueError(f"parent is {self.parent[:40]!r}, expected the name of a frame such as tool0")
        if len(self.place_mm) != 3 or not all(abs(one) <= LARGEST_MM for one in self.place_mm):
            raise ValueError(f"place_mm is {self.place_mm}, expected three numbers up to {LARGEST_MM:g}")
        if len(self.quaternion) != 4 or not abs(math.hypot(*self.quaternion) - 1) <= _OFF:
            raise ValueError(f"quaternion is {self.quaternion}, expected x, y, z, w of norm 1")
