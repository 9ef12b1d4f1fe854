"""Bonded elastic layer under tangential traction: displacement at the surface and inside, in Fourier space.

Traction along a wave (t parallel to q) moves the pad along the wave and up and down, and traction across it moves it
only across: two independent problems. Traction acts on the pad, positive to the right and back; z is the height above
the board, and displacements in z are positive downwards, as in train.physics.elastic_layer. Lengths in [mm], stresses
in [MPa].

For a traction t exp(i q x) in the direction (c, s) = q / |q| the displacements are
    u_i = [across delta_ij + (along - across) q_i q_j / q^2] t_j,   u_down = i sunk (q_j / q) t_j.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer, inner_waves


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
