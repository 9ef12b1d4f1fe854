"""Properties of the pad on a sensor: its material, its thickness, the gains of its taxels.

A network may take them as input, since the same reading means another press on a thicker or harder pad.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from firmware_bridge.pad_geometry import AXES, CHANNELS, MOST_TAXELS, USPA44
from firmware_bridge.scans.mounting import Mounting

PAD_RANGES: Final = MappingProxyType(
    {
        "thickness_mm": (0.1, 100.0),
        "shear_modulus_mpa": (1e-4, 1e3),
        "poisson": (0.0, 0.4999),
        "in_plane_share": (0.0, 10.0),
        "magnet_height_mm": (0.01, 100.0),
        "counts_per_newton": (1e-3, 1e6),
        "pitch_mm": (0.1, 100.0),
        "free_sides": (0.0, 1.0),
    }
)
"""Constants of a pad, in this order, and their ranges: wider than for any pad, so that only slips are refused."""
GAIN_RANGE: Final = (0.01, 100.0)
GAIN_SPREAD: Final = 0.075  # standard deviation of a chip's gain on one axis over new sensors: +-15 % are seen
LEVEL_90: Final = 1.645  # half width of a normal 90 % interval, in standard deviations
UNMEASURED_CERTAINTY: Final = 0.9  # of gains without intervals: a person has measured them somehow


@dataclass(frozen=True)
class Pad:
    """Constants of one sensor's pad, each None where it is not available; invalid ones raise a ValueError."""

    thickness_mm: float | None = None  # thickness of the soft layer, in [mm]
    shear_modulus_mpa: float | None = None  # shear modulus of its material, in [MPa]
    poisson: float | None = None
    in_plane_share: float | None = None  # factor on the in-plane movement of the magnets
    magnet_height_mm: float | None = None  # height of the magnets' centres over the chips, in [mm]
    counts_per_newton: float | None = None  # summed z per [N]
    pitch_mm: float | None = None  # true distance of the taxels of a uSPa44, in [mm]
    free_sides: float | None = None  # compliance of the pad's sides, 0 where they are held, 1 where nothing holds them
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # of constants, by their measurement
    # Relative gain of each place on each axis, 1 where it reads as the others: x of all places row by row, then y, then
    # z, along the pad's axes. Networks that use gains get readings divided by them.
    gains: tuple[float, ...] | None = None
    gain_half_widths: tuple[float, ...] | None = None  # half of the gains' 90 % intervals, each over its gain

    def __post_init__(self) -> None:
        for name, value in self.constants.items():
            low, high = PAD_RANGES[name]
            if not low <= value <= high:
                raise ValueError(f"{name} is {value!r}, expected {low:g} to {high:g}")
        for name, ends in self.intervals.items():
            if name not in PAD_RANGES:
                raise ValueError(f"interval of {name!r}, expected one of {', '.join(PAD_RANGES)}")
            low, high = PAD_RANGES[name]
            if not low <= ends[0] <= ends[1] <= high:
                raise ValueError(f"{name} lies in {list(ends)}, expected two of {low:g} to {high:g}, the lower first")
        low, high = GAIN_RANGE
        if self.gains is not None and (
            len(self.gains) not in range(len(AXES), len(AXES) * MOST_TAXELS + 1, len(AXES))
            or not all(low <= gain <= high for gain in self.gains)
        ):
            expected = f"{len(AXES)} numbers a taxel, {CHANNELS} of a {USPA44.name}, from {low:g} to {high:g}"
            raise ValueError(f"gains are {list(self.gains)}, expected {expected}")
        widths = self.gain_half_widths
        if widths is not None and (
            self.gains is None or len(widths) != len(self.gains) or not all(0 <= width <= 1 for width in widths)
        ):
            count = "no gains" if self.gains is None else f"{len(self.gains)} gains"
            raise ValueError(
                f"gain_half_widths are {list(widths)} of {count}, expected one of 0 to 1 for each, as a share of it"
            )

    @property
    def constants(self) -> dict[str, float]:
        """Available constants by name."""
        values = {name: getattr(self, name) for name in PAD_RANGES}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def gains_certainty(self) -> float:
        """Certainty of the gains: 1 less their deviation over GAIN_SPREAD, 0 without gains or with useless ones."""
        if self.gains is None:
            return 0.0
        if self.gain_half_widths is None:
            return UNMEASURED_CERTAINTY
        deviation = math.sqrt(sum(width**2 for width in self.gain_half_widths) / len(self.gains)) / LEVEL_90
        return min(max(1 - deviation / GAIN_SPREAD, 0.0), 1.0)

    def behind(self, other: "Pad") -> "Pad":
        """Return another pad, with the constants and gains of this one where the other has none."""
        constants = self.constants | other.constants
        intervals = {name: ends for name, ends in self.intervals.items() if name not in other.constants}
        own = self if other.gains is None else other
        return Pad(
            **constants,
            intervals=intervals | dict(other.intervals),
            gains=own.gains,
            gain_half_widths=own.gain_half_widths,
        )

    def turned(self, correction: Mounting) -> "Pad":
        """Return the same pad under a mounting with this correction: its gains follow the places and axes."""
        if self.gains is None:
            return self
        widths = self.gain_half_widths
        return replace(
            self,
            gains=_turned(self.gains, correction),
            gain_half_widths=None if widths is None else _turned(widths, correction),
        )


def _turned(values: tuple[float, ...], correction: Mounting) -> tuple[float, ...]:
    planes = np.asarray(values).reshape(len(AXES), -1)[[1, 0, 2] if correction.swap_xy else [0, 1, 2]]
    return tuple(planes[:, list(correction.order)].ravel().tolist())
