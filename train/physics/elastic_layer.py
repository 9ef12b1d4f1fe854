"""Bonded elastic layer in Fourier space: displacement at the surface and inside under pressure on the surface.

The pad is a soft layer of thickness h on a rigid board. A pressure wave p exp(i q x) on its free surface moves the
material by u_z = W(q, z) p and u_x = i U(q, z) p along the wave. All formulas use decaying exponentials only, so that
no q h overflows. Lengths in [mm], stresses in [MPa].
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Layer:
    """Material and thickness of the pad.

    Attributes:
        thickness_mm: h.
        shear_modulus_mpa: G.
        poisson: nu, below 0.5.
    """

    thickness_mm: float = 4.5
    shear_modulus_mpa: float = 0.12
    poisson: float = 0.45
    """Effective value, because a 20 mm pad is free at its sides.

    Nearer to 0.5 the sum of z is not proportional to the force (28 to 990 counts per newton over the 18 surfaces at
    0.49, 670 to 1310 here), while on real skins it is, to R^2 = .9997.
    """

    def __post_init__(self) -> None:
        if not 0 <= self.poisson < 0.5:
            raise ValueError(f"poisson is {self.poisson}, expected 0 up to below 0.5: take the limit at 0.4999")
        if not (self.thickness_mm > 0 and self.shear_modulus_mpa > 0):
            raise ValueError(f"thickness and shear modulus must be positive, got {self}")


def surface_compliance(layer: Layer, q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the surface displacement per pressure, u_z(q) = (1-nu)/(G q) S(qh), in [mm/MPa], positive downwards.

    S = [(3-4nu) sinh 2a - 2a] / [(3-4nu) cosh 2a + 2a^2 + 5 - 12nu + 8nu^2], a = qh; here both halves are
    multiplied by 2 exp(-2a). At q = 0 the limit u = p h (1-2nu) / (2 G (1-nu)).

    Args:
        layer: the pad.
        q_per_mm: wave numbers, any shape, >= 0, in [1/mm].
    """
    nu, shear, thickness = layer.poisson, layer.shear_modulus_mpa, layer.thickness_mm
    a = q_per_mm * thickness
    decay = np.exp(-2 * a)
    kappa = 3 - 4 * nu
    numerator = kappa * -np.expm1(-4 * a) - 4 * a * decay
    denominator = kappa * (1 + decay**2) + 2 * decay * (2 * a**2 + 5 - 12 * nu + 8 * nu**2)
    flat = thickness * (1 - 2 * nu) / (2 * shear * (1 - nu))
    with np.errstate(divide="ignore", invalid="ignore"):
        wave = (1 - nu) / (shear * q_per_mm) * numerator / denominator
    # Below a = 1e-4 the numerator is a difference of equal numbers; the limit is exact to a^2.
    return np.where(a < 1e-4, flat, wave)


def inner_displacement(
    layer: Layer, q_per_mm: NDArray[np.float64], height_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the displacement inside the layer per surface pressure: (W, U), in [mm/MPa].

    W is positive downwards; the in-plane part is u_x = i U exp(i q x), along the wave. Each wave solves four boundary
    conditions: u = 0 on the board, sigma_zz = -p and sigma_xz = 0 on top.

    Args:
        layer: the pad.
        q_per_mm: wave numbers, any shape, >= 0, in [1/mm].
        height_mm: height above the board, 0 to thickness, in [mm].
    """
    up, along = inner_waves(layer, q_per_mm, height_mm, normal_mpa=-1.0, shear_mpa=0.0)
    return -up, along


def inner_waves(
    layer: Layer, q_per_mm: NDArray[np.float64], height_mm: float, normal_mpa: float, shear_mpa: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the displacement (w, u) inside the layer of a wave u_z = w exp(i q x), u_x = i u exp(i q x), in [mm].

    w is positive upwards.

    Args:
        layer: the pad.
        q_per_mm: wave numbers, any shape, >= 0, in [1/mm].
        height_mm: height above the board, 0 to thickness, in [mm].
        normal_mpa: sigma_zz on top, times exp(i q x).
        shear_mpa: sigma_xz on top, times i exp(i q x).
    """
    shape = q_per_mm.shape
    q = np.maximum(q_per_mm.ravel(), 1e-6 / layer.thickness_mm)
    top = _waves(layer, q, layer.thickness_mm)
    bottom = _waves(layer, q, 0.0)
    lame = 2 * layer.shear_modulus_mpa * layer.poisson / (1 - 2 * layer.poisson)
    normal = lame * (top.slope_w - q[:, None] * top.u) + 2 * layer.shear_modulus_mpa * top.slope_w
    shear = top.slope_u + q[:, None] * top.w
    conditions = np.stack([bottom.u, bottom.w, normal, shear], axis=1)
    load = np.zeros((q.size, 4, 1))
    load[:, 2] = normal_mpa
    load[:, 3] = shear_mpa / layer.shear_modulus_mpa
    amplitudes = np.linalg.solve(conditions, load)[:, :, 0]
    inside = _waves(layer, q, height_mm)
    up = np.sum(inside.w * amplitudes, axis=1)
    along = np.sum(inside.u * amplitudes, axis=1)
    return up.reshape(shape), along.reshape(shape)


@dataclass(frozen=True, slots=True)
class _Waves:
    """Four elementary waves at one height, each (n, 4): in-plane u, normal w, and their slopes in z."""

    u: NDArray[np.float64]
    w: NDArray[np.float64]
    slope_u: NDArray[np.float64]
    slope_w: NDArray[np.float64]


def _waves(layer: Layer, q: NDArray[np.float64], z_mm: float) -> _Waves:
    """Return the solutions (a + b q z) exp(+-q z) of Navier's equations, scaled to similar amplitudes.

    For u = (a + b q z) exp(q z) equilibrium requires w = (a - b (3-4nu) + b q z) exp(q z); for u = (a + b q z) exp(-q
    z), it requires w = (-a - b (3-4nu) - b q z) exp(-q z).
    """
    kappa = 3 - 4 * layer.poisson
    rising = np.exp(q * (z_mm - layer.thickness_mm))
    falling = np.exp(-q * z_mm)
    above, one = q * (z_mm - layer.thickness_mm), np.ones_like(q)
    below = q * z_mm
    u = np.stack([rising, above * rising, falling, below * falling], axis=1)
    w = np.stack([rising, (above - kappa) * rising, -falling, -(below + kappa) * falling], axis=1)
    slope_u = np.stack([rising, (above + one) * rising, -falling, (one - below) * falling], axis=1)
    slope_w = np.stack([rising, (above + 1 - kappa) * rising, falling, (below + kappa - 1) * falling], axis=1)
    return _Waves(u, w, q[:, None] * slope_u, q[:, None] * slope_w)


@dataclass(frozen=True, slots=True)
class TangentialResponse:
    """Displacement per tangential traction at one height, of waves of any shape, in [mm/MPa].

    Attributes:
        along: in the plane, along the wave, under traction along it.
        across: in the plane, across the wave, under traction across it.
        sunk: i times this is the displacement downwards under traction along the wave. On top it is, by reciprocity,
            -U of train.physics.elastic_layer.inner_displacement. The contact leaves it out, for the reason in
            train.physics.friction.
    """

    along: NDArray[np.float64]
    across: NDArray[np.float64]
    sunk: NDArray[np.float64]


def surface_tangential_compliance(
    layer: Layer, q_per_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the surface displacement per traction (along the wave, across it), in closed form, in [mm/MPa].

    along = (1-nu)/(G q) [(3-4nu) sinh 2a + 2a] / [(3-4nu) cosh 2a + 2a^2 + 5 - 12nu + 8nu^2], a = qh, which is
    train.physics.elastic_layer.surface_compliance except for one sign; across = tanh(a) / (G q). Both are h/G at q = 0.

    Args:
        layer: the pad.
        q_per_mm: wave numbers, any shape, >= 0, in [1/mm].
    """
    nu, shear, thickness = layer.poisson, layer.shear_modulus_mpa, layer.thickness_mm
    a = np.maximum(q_per_mm * thickness, 1e-8)  # both are constant here: the limit is exact to a^2
    decay = np.exp(-2 * a)
    kappa = 3 - 4 * nu
    numerator = kappa * -np.expm1(-4 * a) + 4 * a * decay
    denominator = kappa * (1 + decay**2) + 2 * decay * (2 * a**2 + 5 - 12 * nu + 8 * nu**2)
    along = (1 - nu) * thickness / (shear * a) * numerator / denominator
    return along, thickness / shear * np.tanh(a) / a


def inner_tangential(layer: Layer, q_per_mm: NDArray[np.float64], height_mm: float) -> TangentialResponse:
    """Return the displacement at a height inside the layer per tangential traction on its surface.

    Args:
        layer: the pad.
        q_per_mm: wave numbers, any shape, >= 0, in [1/mm].
        height_mm: height above the board, 0 to thickness, in [mm].
    """
    shear, thickness = layer.shear_modulus_mpa, layer.thickness_mm
    up, along = inner_waves(layer, q_per_mm, height_mm, normal_mpa=0.0, shear_mpa=1.0)
    q = np.maximum(q_per_mm, 1e-8 / thickness)
    # sinh(qz) / (G q cosh(qh)), with decaying exponentials alone.
    rise = np.exp(-q * (thickness - height_mm)) * -np.expm1(-2 * q * height_mm)
    return TangentialResponse(along, rise / (shear * q * (1 + np.exp(-2 * q * thickness))), up)


def surface_tensor(
    layer: Layer, q_x: NDArray[np.floating], q_y: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the surface compliance (xx, yy, xy) per wave vector, in [mm/MPa].

    u_x = xx t_x + xy t_y and u_y = xy t_x + yy t_y.

    Args:
        layer: the pad.
        q_x: wave numbers to the right; with q_y of shapes that broadcast, in [1/mm].
        q_y: wave numbers back.
    """
    square = np.asarray(q_x**2 + q_y**2, dtype=np.float64)
    along, across = surface_tangential_compliance(layer, np.sqrt(square))
    extra = np.divide(along - across, square, out=np.zeros_like(square), where=square > 0)
    return across + extra * q_x**2, across + extra * q_y**2, extra * q_x * q_y
