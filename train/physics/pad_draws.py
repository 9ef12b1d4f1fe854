"""Pads: constants of a simulated sensor, drawn for each, and their form as inputs of a network."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import PADS, USPA44, SensorGeometry
from train.physics.elastic_layer import Layer
from train.physics.magnets import Magnet

NEWTONS_PER_COUNT_Z: Final = 0.00085  # by the data sheet, for the sum of z

_UNEVEN_WAVES: Final = 8
# Standard deviations of one magnet's lean, of its height about the pad's, and of its moment as a share of the nominal
# one. The latter two make a gain of 0.04, and with the chips' 0.075 the 15 % either way that is seen on devices.
_TILT_RAD: Final = 0.05
_SEAT_MM: Final = 0.02
_MOMENT: Final = 0.015


@dataclass(frozen=True, slots=True, kw_only=True)
class Pad:
    """The constants of one simulated sensor; those of its soft layer and magnets come first."""

    thickness_mm: float = 4.5
    shear_modulus_mpa: float = 0.12
    poisson: float = 0.45
    # Factor on the in-plane movement that pressure alone gives the magnets, which in reality friction holds: grips have
    # an in-plane to normal ratio of 0.18 to 0.26, without the factor it would be 0.57.
    in_plane_share: float = 0.4
    magnet_height_mm: float = 2.5
    counts_per_newton: float = 1 / NEWTONS_PER_COUNT_Z  # summed z under an even load
    pitch_mm: float = USPA44.pitch_mm  # of another model in proportion to its own
    free_sides: float = 0.0  # compliance, 0 for an infinite layer, 1 for the finite elements' pad
    uneven_mm: float = 0.0  # RMS of its face
    seed: int | None = None  # of the unevenness and of the differences between magnets; None for a perfect pad
    model: str = USPA44.name  # of firmware_bridge.pad_geometry.PADS

    @property
    def grid(self) -> SensorGeometry:
        """Nominal geometry of its model."""
        return next(pad for pad in PADS if pad.name == self.model)

    @property
    def layer(self) -> Layer:
        """Soft layer of the pad."""
        return Layer(self.thickness_mm, self.shear_modulus_mpa, self.poisson)

    @property
    def magnet(self) -> Magnet:
        """Nominal magnet of every taxel."""
        return Magnet(height_mm=self.magnet_height_mm)

    def geometry(self) -> SensorGeometry:
        """Return the geometry with the pad's true pitch."""
        if self.grid == USPA44:
            return replace(USPA44, pitch_mm=self.pitch_mm)
        return replace(self.grid, pitch_mm=self.grid.pitch_mm * self.pitch_mm / USPA44.pitch_mm)

    def rest(self, taxels: int) -> NDArray[np.float64]:
        """Return the place and lean of each magnet at rest, as a movement, (taxels, 5)."""
        away = np.zeros((taxels, 5))
        if self.seed is not None:
            draws = np.random.default_rng([self.seed, 1]).standard_normal((taxels, 3)).clip(-2, 2)
            away[:, 2:] = draws * (_SEAT_MM, _TILT_RAD, _TILT_RAD)
        return away

    def moments(self, taxels: int) -> NDArray[np.float64]:
        """Return each magnet's moment as a share of the nominal one, (taxels,)."""
        if self.seed is None:
            return np.ones(taxels)
        return 1 + _MOMENT * np.random.default_rng([self.seed, 2]).standard_normal(taxels).clip(-2, 2)

    def uneven(self, x_mm: NDArray[np.floating], y_mm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the depth of the pad's face below its mean at places on it, in [mm]."""
        down = np.zeros(np.broadcast_shapes(x_mm.shape, y_mm.shape), dtype=np.float32)
        if self.seed is None or not self.uneven_mm:
            return down
        rng = np.random.default_rng([self.seed, 3])
        q = 2 * np.pi / rng.uniform(6, 30, _UNEVEN_WAVES)
        turn, phase = rng.uniform(0, 2 * np.pi, (2, _UNEVEN_WAVES))
        size = self.uneven_mm * np.sqrt(2 / _UNEVEN_WAVES)
        for wave, angle, shift in zip(q, turn, phase, strict=True):
            down += (size * np.sin(wave * (np.cos(angle) * x_mm + np.sin(angle) * y_mm) + shift)).astype(np.float32)
        return down


NOMINAL: Final = Pad()  # pad of the first frozen set

# Bounds of the constants that are drawn uniformly; docs/train.md has the reason for each.
RANGES: Final[dict[str, tuple[float, float]]] = {
    "thickness_mm": (3.6, 5.4),
    "shear_modulus_mpa": (0.09, 0.15),
    "poisson": (0.40, 0.49),
    "in_plane_share": (0.2, 0.7),
    "magnet_height_mm": (2.2, 2.8),
    "counts_per_newton": (0.75 / NEWTONS_PER_COUNT_Z, 1.25 / NEWTONS_PER_COUNT_Z),
    "pitch_mm": (4.6, 5.0),
    "free_sides": (0.0, 0.6),
}

# Bounds of constants of pads that can be simulated: magnets stay within the layer, and above their chips.
SIMULATED: Final = {name: (max(2 * least - most, 0.0), 2 * most - least) for name, (least, most) in RANGES.items()} | {
    "thickness_mm": (3.1, 7.2),
    "poisson": (0.31, 0.4999),
    "magnet_height_mm": (2.0, 3.0),
}

INPUTS: Final = tuple(RANGES)[:6]  # that a network takes if they are known: all but the pitch and the free sides
KNOWN: Final = 2 * len(INPUTS) + 1  # inputs of a network: values, a flag for each, and the certainty of the gains


def draw_pad(rng: np.random.Generator, spread: float = 1.0, ranges: Mapping[str, tuple[float, float]] = RANGES) -> Pad:
    """Draw a pad with each constant within its range; a `spread` below 1 moves all towards the nominal pad."""
    drawn = {}
    for name, bounds in ranges.items():
        nominal = getattr(NOMINAL, name)
        drawn[name] = nominal + spread * (rng.uniform(*bounds) - nominal)
    # A moulded silicone face is uneven by 0.015 mm at most.
    return Pad(**drawn, uneven_mm=spread * rng.uniform(0, 0.015), seed=int(rng.integers(2**31)))


def input_scale() -> list[tuple[str, float, float]]:
    """Return name, centre and spread of each input constant; a value v enters as (v - centre) / spread."""
    return [(name, getattr(NOMINAL, name), (RANGES[name][1] - RANGES[name][0]) / 2) for name in INPUTS]


def constants(pad: Pad) -> NDArray[np.float32]:
    """Return the constants that a network takes, each over its spread, (len(INPUTS),)."""
    scaled = [(getattr(pad, name) - centre) / spread for name, centre, spread in input_scale()]
    return np.array(scaled, dtype=np.float32)


def known_numbers(
    scaled: NDArray[np.float32], known: NDArray[np.bool_], certainty: NDArray[np.floating] | NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the pad inputs (n, KNOWN) of a network, of constants over their spread and flags of those to pass on.

    The certainty (n,) of the gains that readings were divided by is 1 less their deviation over the spread of a new
    sensor's: 1 for the true gains, 0 for none.
    """
    flags = known.astype(np.float32)
    return np.concatenate([scaled * flags, flags, certainty.astype(np.float32)[:, None]], axis=1)
