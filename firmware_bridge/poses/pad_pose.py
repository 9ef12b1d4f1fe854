"""Pose of a pad in the object's plane, and of an earlier tap in the newest one's axes.

The axes are those of a pattern: x to the right, y down the rows; a turn goes from x to y, by the right-hand rule about
the axis that points into the page. With turn t, the pad's x axis lies along (cos t, sin t) in the object's plane. A
point p of the newest tap's pattern lies at R(t)^T (p - c) in that of an earlier tap whose relative pose has place c.
"""

from dataclasses import dataclass, fields
from math import cos, hypot, radians, sin
from typing import Final

PLACE_ERROR_MM: Final = 0.2
TURN_ERROR_DEG: Final = 1.0
"""Standard deviations of a pose on a gripper mounted by hand, where nothing else is stated."""
MOST: Final = 1e6
"""Largest coordinate in [mm] and turn in [deg], so that every difference of two is a number with a meaning."""


@dataclass(frozen=True, slots=True)
class PadPose:
    """Pose of a pad's centre in the object's plane.

    Attributes:
        x_mm: place along x.
        y_mm: place along y.
        turn_deg: turn from x to y.
        error_mm: standard deviation of the place, along x and along y.
        error_deg: standard deviation of the turn.

    Raises:
        ValueError: a number is not finite or out of range, or an error is negative.
    """

    x_mm: float
    y_mm: float
    turn_deg: float = 0.0
    error_mm: float = PLACE_ERROR_MM
    error_deg: float = TURN_ERROR_DEG

    def __post_init__(self) -> None:
        for name, low in (("x_mm", -MOST), ("y_mm", -MOST), ("turn_deg", -MOST), ("error_mm", 0), ("error_deg", 0)):
            value = getattr(self, name)
            if not low <= value <= MOST:  # False of NaN
                raise ValueError(f"{name} is {value}, expected a number from {low:g} to {MOST:g}")

    def seen_from(self, newest: "PadPose") -> "PadPose":
        """Return this pose in the axes of a newer tap's pad, with the errors of both; the turn lies within 180 deg."""
        turn = radians(newest.turn_deg)
        x_mm, y_mm = self.x_mm - newest.x_mm, self.y_mm - newest.y_mm
        return PadPose(
            cos(turn) * x_mm + sin(turn) * y_mm,
            cos(turn) * y_mm - sin(turn) * x_mm,
            (self.turn_deg - newest.turn_deg + 180) % 360 - 180,
            hypot(self.error_mm, newest.error_mm),
            hypot(self.error_deg, newest.error_deg),
        )


POSE_FIELDS: Final = tuple(one.name for one in fields(PadPose))
