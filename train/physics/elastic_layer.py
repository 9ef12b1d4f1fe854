"""Bonded elastic layer in Fourier space: displacement at the surface and inside under pressure on the surface.

The pad is a soft layer of thickness h on a rigid board. A pressure wave p exp(i q x) on its free surface moves the
material by u_z = W(q, z) p and u_x = i U(q, z) p along the wave. All formulas use decaying exponentials only, so that
no q h overflows. Lengths in [mm], stresses in [MPa].

On a grid over a pad, displacement is a convolution of the loads, done by FFT on a padded grid, on the bounding box of
the cells that a press can reach alone. Presses with boxes of one shape are solved in a batch.

The free sides of a pad are absent from the infinite layer: near them it is softer and bulges outwards. The effect of a
load on a side falls with the load's distance d' from the side, and spreads along it by a bell curve. The added
displacement falls with distance d alike, so that the addition is symmetric and never negative:

    u(d, y) += amplitude / (G h) sum_sides sum_k a_k exp(-(d + d') / (h b_k)) exp(-(y - y')^2 / (2 (h c_k)^2)) F(d', y')

The magnets' movement gains a term of the same kind, with its own lengths. All constants are fitted to finite elements
of a frictionless 20 mm pad at four Poisson ratios (docs/decisions.md), with the same values for all four.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Layer:
    """Material and thickness of the pad."""

    thickness_mm: float = 4.5  # h
    shear_modulus_mpa: float = 0.12  # G
    # nu, below 0.5; an effective value, as a 20 mm pad is free at its sides: at 0.49 z would not be as the force.
    poisson: float = 0.45

    def __post_init__(self) -> None:
        if not 0 <= self.poisson < 0.5:
            raise ValueError(f"poisson is {self.poisson}, expected 0 up to below 0.5: take the limit at 0.4999")
        if not (self.thickness_mm > 0 and self.shear_modulus_mpa > 0):
            raise ValueError(f"thickness and shear modulus must be positive, got {self}")


Array = NDArray[np.float64]

_LONGEST: Final = 1e-8  # q h below which a closed form is its limit: exact to a^2 / (1 - 2 nu)


def surface_compliance(layer: Layer, q_per_mm: Array) -> Array:
    """Return the surface displacement per pressure, u_z(q) = (1-nu)/(G q) S(qh), in [mm/MPa], positive downwards.

    S = [(3-4nu) sinh 2a - 2a] / [(3-4nu) cosh 2a + 2a^2 + 5 - 12nu + 8nu^2], a = qh. At q = 0 the limit
    u = p h (1-2nu) / (2 G (1-nu)).
    """
    nu, shear, thickness = layer.poisson, layer.shear_modulus_mpa, layer.thickness_mm
    a = np.maximum(q_per_mm * thickness, _LONGEST)
    numerator, denominator = _closed_form(nu, a, -1)
    return (1 - nu) * thickness / (shear * a) * numerator / denominator


def surface_tangential_compliance(layer: Layer, q_per_mm: Array) -> tuple[Array, Array]:
    """Return the surface displacement per traction (along the wave, across it), in closed form, in [mm/MPa].

    The first is `surface_compliance` but for the sign of 2a in the numerator, the second tanh(a) / (G q). Both are h/G
    at q = 0.
    """
    nu, shear, thickness = layer.poisson, layer.shear_modulus_mpa, layer.thickness_mm
    a = np.maximum(q_per_mm * thickness, _LONGEST)
    numerator, denominator = _closed_form(nu, a, 1)
    along = (1 - nu) * thickness / (shear * a) * numerator / denominator
    return along, thickness / shear * np.tanh(a) / a


def _closed_form(nu: float, a: Array, sign: int) -> tuple[Array, Array]:
    """Return numerator and denominator of the closed forms, both multiplied by 2 exp(-2a)."""
    kappa, decay = 3 - 4 * nu, np.exp(-2 * a)
    numerator = kappa * -np.expm1(-4 * a) + sign * 4 * a * decay
    return numerator, kappa * (1 + decay**2) + 2 * decay * (2 * a**2 + 5 - 12 * nu + 8 * nu**2)


def surface_tensor(layer: Layer, q_x: NDArray[np.floating], q_y: NDArray[np.floating]) -> tuple[Array, Array, Array]:
    """Return the surface compliance (xx, yy, xy) per wave vector: u_x = xx t_x + xy t_y, u_y = xy t_x + yy t_y.

    Wave numbers to the right and back are in [1/mm], of shapes that broadcast; the result is in [mm/MPa].
    """
    square = np.asarray(q_x**2 + q_y**2, dtype=np.float64)
    along, across = surface_tangential_compliance(layer, np.sqrt(square))
    extra = np.divide(along - across, square, out=np.zeros_like(square), where=square > 0)
    return across + extra * q_x**2, across + extra * q_y**2, extra * q_x * q_y


def inner_displacement(layer: Layer, q_per_mm: Array, height_mm: float) -> tuple[Array, Array]:
    """Return the displacement at a height above the board per surface pressure: (W, U), in [mm/MPa].

    W is positive downwards; the in-plane part is u_x = i U exp(i q x), along the wave.
    """
    up, along = _inside(layer, q_per_mm, height_mm, normal_mpa=-1.0, shear_mpa=0.0)
    return -up, along


class TangentialResponse(NamedTuple):
    """Displacement per tangential traction at one height, of waves of any shape, in [mm/MPa]."""

    along: Array  # the wave, as the traction
    across: Array  # the wave, as the traction
    sunk: Array  # i times this is downwards, under traction along the wave


def inner_tangential(layer: Layer, q_per_mm: Array, height_mm: float) -> TangentialResponse:
    """Return the displacement at a height inside the layer per tangential traction on its surface."""
    shear, thickness = layer.shear_modulus_mpa, layer.thickness_mm
    up, along = _inside(layer, q_per_mm, height_mm, normal_mpa=0.0, shear_mpa=1.0)
    q = np.maximum(q_per_mm, _LONGEST / thickness)
    # sinh(qz) / (G q cosh(qh)), with decaying exponentials alone.
    rise = np.exp(-q * (thickness - height_mm)) * -np.expm1(-2 * q * height_mm)
    return TangentialResponse(along, rise / (shear * q * (1 + np.exp(-2 * q * thickness))), up)


def _inside(
    layer: Layer, q_per_mm: Array, height_mm: float, normal_mpa: float, shear_mpa: float
) -> tuple[Array, Array]:
    """Return the displacement (w, u) in [mm] inside the layer: u_z = w exp(i q x), upwards, and u_x = i u exp(i q x).

    The board holds the layer; on top sigma_zz = normal exp(i q x) and sigma_xz = shear i exp(i q x).
    """
    # Longer waves differ from their limit by less than the equations of nearly equal exponentials leave.
    q = np.maximum(q_per_mm.ravel(), 1e-5 / layer.thickness_mm)
    top, bottom, inside = (_waves(layer, q, z_mm) for z_mm in (layer.thickness_mm, 0.0, height_mm))
    lame = 2 * layer.shear_modulus_mpa * layer.poisson / (1 - 2 * layer.poisson)
    normal = lame * (top.slope_w - q[:, None] * top.u) + 2 * layer.shear_modulus_mpa * top.slope_w
    shear = top.slope_u + q[:, None] * top.w
    load = np.zeros((q.size, 4, 1))
    load[:, 2] = normal_mpa
    load[:, 3] = shear_mpa / layer.shear_modulus_mpa
    amplitudes = np.linalg.solve(np.stack([bottom.u, bottom.w, normal, shear], axis=1), load)[:, :, 0]
    w, u = (np.sum(part * amplitudes, axis=1).reshape(q_per_mm.shape) for part in (inside.w, inside.u))
    return w, u


class _Waves(NamedTuple):
    """Four elementary waves at one height, each (n, 4): in-plane u, normal w, and their slopes in z."""

    u: Array
    w: Array
    slope_u: Array
    slope_w: Array


def _waves(layer: Layer, q: Array, z_mm: float) -> _Waves:
    """Return the solutions (a + b q z) exp(+-q z) of Navier's equations, scaled to similar amplitudes.

    For u = (a + b q z) exp(q z) equilibrium requires w = (a - b (3-4nu) + b q z) exp(q z); for u = (a + b q z) exp(-q
    z), it requires w = (-a - b (3-4nu) - b q z) exp(-q z).
    """
    kappa = 3 - 4 * layer.poisson
    above, below = q * (z_mm - layer.thickness_mm), q * z_mm
    rising, falling = np.exp(above), np.exp(-q * z_mm)
    u = np.stack([rising, above * rising, falling, below * falling], axis=1)
    w = np.stack([rising, (above - kappa) * rising, -falling, -(below + kappa) * falling], axis=1)
    slope_u = np.stack([rising, (above + 1) * rising, -falling, (1 - below) * falling], axis=1)
    slope_w = np.stack([rising, (above + 1 - kappa) * rising, falling, (below + kappa - 1) * falling], axis=1)
    return _Waves(u, w, q[:, None] * slope_u, q[:, None] * slope_w)


# Indices of boxes into maps (presses, size, size): presses (n, 1, 1), rows (n, height, 1), columns (n, 1, width).
Place = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


class PadGrid:
    """Grid of `size` cells a side of `cell_mm` over a pad, and what its kernels make of loads.

    `compliance` is the displacement per load in [mm/MPa], (m, k) or (kernels, m, k), at `waves` (1, k) and (m, 1).
    """

    def __init__(
        self,
        layer: Layer,
        size: int,
        cell_mm: float,
        dtype: torch.dtype,
        compliance: Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.float64]],
    ) -> None:
        # A period of eight thicknesses limits the error of a punch's force to 5e-4; with one of twice the pad it was
        # 0.8 % for a layer of 10 mm and 9 % for one of 50 mm.
        period = 2 * max(size, ceil(4 * layer.thickness_mm / cell_mm))
        self._kernels = np.fft.irfft2(compliance(*waves(period, cell_mm)), s=(period, period))
        self._size = size
        self._dtype = dtype
        # Powers of two suit the FFT, and are few, so that many presses share one.
        self._sides = [*(side for side in (8, 16, 32, 64, 128, 256) if side < size), size]
        self._spectra: dict[tuple[int, int], torch.Tensor] = {}

    @property
    def cell_mm_per_mpa(self) -> float:
        """Displacement of a cell under its own load alone, in [mm/MPa]."""
        return float(self._kernels[..., 0, 0].flat[0])

    def spectrum(self, height: int, width: int) -> torch.Tensor:
        """Return the kernels' spectra (..., 2 height, width + 1) on a box, which symmetry makes real."""
        if (height, width) not in self._spectra:
            rows, columns = (np.fft.ifftshift(np.arange(-side, side)) for side in (height, width))
            kernels = torch.as_tensor(self._kernels[..., rows[:, None], columns], dtype=self._dtype)
            self._spectra[height, width] = torch.fft.rfft2(kernels).real
        return self._spectra[height, width]

    def boxes(self, within: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], Place]]:
        """Yield presses whose boxes have one shape, and the boxes' place: those that hold `within`, (n, size, size)."""
        presses = np.flatnonzero(within.any(axis=(1, 2)))
        shapes, starts = [], []
        for axis in (1, 2):
            used = np.asarray(within[presses].any(axis=3 - axis))
            first, last = used.argmax(axis=1), self._size - 1 - used[:, ::-1].argmax(axis=1)
            side = np.array(self._sides)[np.searchsorted(self._sides, last - first + 1)]
            shapes.append(side)
            starts.append(np.minimum(first, self._size - side))
        for height, width in np.unique(np.stack(shapes, axis=1), axis=0):
            alike = (shapes[0] == height) & (shapes[1] == width)
            rows, columns = starts[0][alike, None] + np.arange(height), starts[1][alike, None] + np.arange(width)
            yield presses[alike], (presses[alike, None, None], rows[:, :, None], columns[:, None, :])


def waves(period: int, cell_mm: float) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return wave numbers to the right (1, period / 2 + 1) and back (period, 1), in [1/mm]."""
    right, back = np.fft.rfftfreq(period, cell_mm), np.fft.fftfreq(period, cell_mm)
    return 2 * np.pi * right[None], 2 * np.pi * back[:, None]


_WIDTH_MM: Final = 20.0
_GIVES: Final = ((0.959, 0.3415, 0.2247), (0.0255, 1.590, 0.6034))  # terms (a, b, c) of the surface's compliance


def side_movement(
    amplitude: float, layer: Layer, cells_mm: NDArray[np.floating], magnets_mm: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the MOVEMENT of the magnets that four free sides add, (taxels, 5, size, size) in [mm/N] and [1/N].

    Amplitude 1 is as in the finite elements, 0 an infinite layer. Loaded cells are at places (size,) from the centre
    along x as along y, magnets at x and y (taxels, 2).
    """
    scale, thickness_mm = amplitude / (layer.shear_modulus_mpa * layer.thickness_mm), layer.thickness_mm

    # Factor, decay lengths to magnet and load, width along the side; unit; signs at lower and upper side.
    parts = (
        ((0.1703, 1.117, 0.592, 0.593), scale, (-1.0, 1.0)),  # their way to the side
        ((0.0404, 0.690, 1.147, 0.420), scale, (1.0, 1.0)),  # down
        ((1.000, 0.431, 0.317, 0.463), scale / thickness_mm, (-1.0, 1.0)),  # their axes, tops towards the side
    )

    def by_sides(at_mm: NDArray[np.floating], beside_mm: NDArray[np.floating]) -> list[NDArray[np.float64]]:
        """Return the parts of the two sides at the ends of one axis; magnets are at `at_mm` along it."""
        added = []
        for (factor, *lengths), unit, signs in parts:
            inward_mm, reach_mm, spread_mm = (thicknesses * thickness_mm for thicknesses in lengths)
            falls = _fall(at_mm, inward_mm), _fall(cells_mm, reach_mm)
            bell = _bell(beside_mm[:, None] - cells_mm, spread_mm)
            added.append(unit * factor * np.einsum("s,st,sc,tr->trc", signs, *falls, bell))
        return added

    x_mm, y_mm = magnets_mm.T
    right, down_by_x, lean_x = by_sides(x_mm, y_mm)
    back, down_by_y, lean_y = (part.swapaxes(1, 2) for part in by_sides(y_mm, x_mm))
    return np.stack([right, back, down_by_x + down_by_y, lean_x, lean_y], axis=1)


class SideGive:
    """Compliance that free sides add on boxes of a grid.

    A force at (x', y') adds across(x) across(x') along(y, y') to the displacement at (x, y), for each side and term.
    Profiles across are (n, terms, 2, width) and (n, terms, 2, height) at the boxes' columns and rows, lower side first,
    those along (terms, height, height) and (terms, width, width) in [mm/MPa].
    """

    def __init__(self, across: tuple[torch.Tensor, torch.Tensor], along: tuple[torch.Tensor, torch.Tensor]) -> None:
        self._across = across
        self._along = along

    @classmethod
    def of(cls, amplitude: float, layer: Layer, size: int, cell_mm: float, dtype: torch.dtype) -> "SideGive":
        """Return the compliance of the whole grid."""
        cells_mm, thickness_mm = (np.arange(size) - (size - 1) / 2) * cell_mm, layer.thickness_mm
        scale, apart_mm = amplitude / (layer.shear_modulus_mpa * thickness_mm), cells_mm[:, None] - cells_mm
        across = np.stack([_fall(cells_mm, reach * thickness_mm) for _, reach, _ in _GIVES])
        along = np.stack([scale * factor * _bell(apart_mm, spread * thickness_mm) for factor, _, spread in _GIVES])
        falls, bells = torch.as_tensor(across[None], dtype=dtype), torch.as_tensor(along * cell_mm**2, dtype=dtype)
        return cls((falls, falls), (bells, bells))

    def boxes(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> "SideGive":
        """Return the part for boxes of one shape with these rows (n, height, 1) and columns (n, 1, width)."""
        across = (
            fall[0][:, :, torch.as_tensor(cells)].permute(2, 0, 1, 3)
            for fall, cells in zip(self._across, (columns[:, 0], rows[:, :, 0]), strict=True)
        )
        counts = (rows.shape[1], columns.shape[2])
        along = (bell[:, :count, :count] for bell, count in zip(self._along, counts, strict=True))
        return SideGive((next(across), next(across)), (next(along), next(along)))

    def __getitem__(self, which: torch.Tensor) -> "SideGive":
        """Return the part for some of the boxes."""
        return SideGive((self._across[0][which], self._across[1][which]), self._along)

    def displacement_mm(self, pressure_mpa: torch.Tensor) -> torch.Tensor:
        """Return the displacement that the sides add under pressures (n, height, width)."""
        by_x = self._pair(pressure_mpa, self._across[0], self._along[0])
        return by_x + self._pair(pressure_mpa.mT, self._across[1], self._along[1]).mT

    @staticmethod
    def _pair(pressure: torch.Tensor, across: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
        """Return the displacement from the two sides at the ends of the last axis."""
        terms, sides = across.shape[1:3]
        fall = across.expand(len(pressure), -1, -1, -1).flatten(1, 2)  # (n, terms sides, width)
        seen = (fall @ pressure.mT).unflatten(1, (terms, sides))  # (n, terms, sides, height)
        return (seen @ along).flatten(1, 2).mT @ fall


def _fall(places_mm: NDArray[np.floating], length_mm: float) -> NDArray[np.float64]:
    """Return exponentials (2, ...) that decay from either side inwards."""
    return np.exp(-(_WIDTH_MM / 2 + np.stack([places_mm, -places_mm])) / length_mm)


def _bell(apart_mm: NDArray[np.floating], spread_mm: float) -> NDArray[np.float64]:
    return np.exp(-(apart_mm**2) / (2 * spread_mm**2))
