"""Pads: every constant of a simulated sensor, drawn for each; and what a network may know of them."""

from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import USPA44, SensorGeometry
from train.physics.elastic_layer import Layer
from train.physics.magnets import Magnet
from train.physics.side_correction import FreeSides
from train.physics.taxel_response import IN_PLANE_SHARE, NEWTONS_PER_COUNT_Z

_UNEVEN_MM: Final = 0.015
"""Largest RMS of a pad's own unevenness: a moulded silicone face."""
_UNEVEN_WAVES: Final = 8
_TILT_RAD: Final = 0.05
"""Standard deviation of a magnet's lean: three degrees of a part of a millimetre set by a machine."""
_SEAT_MM: Final = 0.02
"""Standard deviation of one magnet's height about the pad's: with its moment it makes a gain of .04, and with the
chips' of .075 the 15 % either way that is seen on devices; .05 mm would make a tenth by itself."""
_MOMENT: Final = 0.015
"""Standard deviation of one magnet's moment, of one batch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pad:
    """The constants of one simulated sensor.

    Attributes:
        thickness_mm: of the soft layer.
        shear_modulus_mpa: of its material.
        poisson: effective Poisson ratio.
        in_plane_share: factor on the in-plane movement that pressure alone gives the magnets.
        magnet_height_mm: of the magnets' centres above the board.
        counts_per_newton: summed z under an even load.
        pitch_mm: distance of neighbouring taxels.
        free_sides: how far the pad's free sides give way, 0 for an infinite layer, 1 for finite elements' pad.
        uneven_mm: RMS of the pad's own unevenness.
        seed: of the unevenness and of what differs from magnet to magnet; None for a perfect pad.
    """

    thickness_mm: float = 4.5
    shear_modulus_mpa: float = 0.12
    poisson: float = 0.45
    in_plane_share: float = IN_PLANE_SHARE
    magnet_height_mm: float = 2.5
    counts_per_newton: float = 1 / NEWTONS_PER_COUNT_Z
    pitch_mm: float = USPA44.pitch_mm
    free_sides: float = 0.0
    uneven_mm: float = 0.0
    seed: int | None = None

    @property
    def layer(self) -> Layer:
        """The soft layer."""
        return Layer(self.thickness_mm, self.shear_modulus_mpa, self.poisson)

    @property
    def sides(self) -> FreeSides | None:
        """The pad's free sides, None where they do not give way."""
        return FreeSides(self.free_sides) if self.free_sides else None

    @property
    def magnet(self) -> Magnet:
        """The magnet of every taxel, before what differs from one to the next."""
        return Magnet(height_mm=self.magnet_height_mm)

    def geometry(self, nominal: SensorGeometry = USPA44) -> SensorGeometry:
        """The taxels, as they really sit."""
        return replace(nominal, pitch_mm=self.pitch_mm)

    def rest(self, taxels: int) -> NDArray[np.float64]:
        """Movement of each magnet that stands for where it sits and how it leans at rest, (taxels, 5)."""
        away = np.zeros((taxels, 5))
        if self.seed is not None:
            draws = np.random.default_rng([self.seed, 1]).standard_normal((taxels, 3)).clip(-2, 2)
            away[:, 2:] = draws * (_SEAT_MM, _TILT_RAD, _TILT_RAD)
        return away

    def moments(self, taxels: int) -> NDArray[np.float64]:
        """Each magnet's moment as a share of the nominal one, (taxels,)."""
        if self.seed is None:
            return np.ones(taxels)
        return 1 + _MOMENT * np.random.default_rng([self.seed, 2]).standard_normal(taxels).clip(-2, 2)

    def uneven(self, x_mm: NDArray[np.floating], y_mm: NDArray[np.floating]) -> NDArray[np.float32]:
        """How far the pad's own face lies below its mean at places on it, in [mm]."""
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

    def facts(self) -> dict[str, Any]:
        """The constants, as JSON holds them."""
        return asdict(self)


NOMINAL: Final = Pad()
"""The pad of the first frozen set."""

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
"""Bounds of what is drawn uniformly; each with its reason in docs/train.md."""

INPUTS: Final = (
    "thickness_mm",
    "shear_modulus_mpa",
    "poisson",
    "in_plane_share",
    "magnet_height_mm",
    "counts_per_newton",
)
"""The constants that a network takes, where they are known."""

KNOWN: Final = 2 * len(INPUTS) + 1
"""Numbers that say what is known of a pad: values, whether each is known, and whether the gains are."""


def draw_pad(rng: np.random.Generator, spread: float = 1.0) -> Pad:
    """A pad of its own: each constant within its range, drawn together towards the nominal pad by `spread` below 1."""
    drawn = {}
    for name, (low, high) in RANGES.items():
        nominal = getattr(NOMINAL, name)
        drawn[name] = nominal + spread * (rng.uniform(low, high) - nominal)
    return Pad(**drawn, uneven_mm=spread * rng.uniform(0, _UNEVEN_MM), seed=int(rng.integers(2**31)))


def input_scale() -> list[tuple[str, float, float]]:
    """Name, centre and spread of each constant that a network takes; a value v enters as (v - centre) / spread."""
    return [(name, getattr(NOMINAL, name), (RANGES[name][1] - RANGES[name][0]) / 2) for name in INPUTS]


def constants(pad: Pad) -> NDArray[np.float32]:
    """The constants that a network takes, each over its spread, (len(INPUTS),)."""
    return np.array(
        [(getattr(pad, name) - centre) / spread for name, centre, spread in input_scale()], dtype=np.float32
    )


def known_numbers(
    scaled: NDArray[np.float32], known: NDArray[np.bool_], gains_known: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """The input (n, KNOWN) that says what is known of n pads; all zeros where nothing is.

    Args:
        scaled: constants over their spread, (n, len(INPUTS)).
        known: which of them are known, same shape.
        gains_known: (n,), whether readings were divided by the sensor's gains.
    """
    flags = known.astype(np.float32)
    return np.concatenate([scaled * flags, flags, gains_known.astype(np.float32)[:, None]], axis=1)
