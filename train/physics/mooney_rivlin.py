"""Mooney-Rivlin solid: energy, stress and stiffness of its distortional and volumetric parts, in closed form.

psi(F) = C1 (I1 J^(-2/3) - 3) + C2 (I2 J^(-4/3) - 3), with I1, I2 the invariants of C = F^T F and J = det F, depends on
the shape alone. The energy of volume changes, K (J - 1)^2 / 2, is a separate part, which the mixed elements supply
themselves, cell by cell. Arrays are (3, 3, ...) as in finite-element codes: the tensor's axes first, the points last.

Source: Wu and Liu 2024, section IV-D (the model); Holzapfel 2000, section 6.5 (the split).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer

C2_SHARE: Final = 0.2
"""Share of C2 in C1 + C2. At small strain only the sum counts; silicones are fitted with shares of 0 to about 0.3."""

Tensors = NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class MooneyRivlin:
    """One material.

    Attributes:
        c1_mpa: C1, in [MPa].
        c2_mpa: C2, in [MPa].
        bulk_mpa: K, in [MPa].
    """

    c1_mpa: float
    c2_mpa: float
    bulk_mpa: float

    @classmethod
    def of_layer(cls, layer: Layer, c2_share: float = C2_SHARE) -> "MooneyRivlin":
        """Return the solid that equals the layer at small strain: G = 2 (C1 + C2), K/G = 2 (1+nu) / (3 (1-2nu)).

        Raises:
            ValueError: c2_share is not within 0..1.
        """
        if not 0 <= c2_share <= 1:
            raise ValueError(f"C2's share is {c2_share}, expected 0 to 1")
        shear, nu = layer.shear_modulus_mpa, layer.poisson
        bulk = shear * 2 * (1 + nu) / (3 * (1 - 2 * nu))
        return cls((1 - c2_share) * shear / 2, c2_share * shear / 2, bulk)

    def energy(self, gradient: Tensors) -> Tensors:
        """Return the distortional energy per undeformed volume, (...) in [MPa], of gradients F (3, 3, ...)."""
        _, volume, i1, i2 = _invariants(gradient)
        return self.c1_mpa * (i1 * volume ** (-2 / 3) - 3) + self.c2_mpa * (i2 * volume ** (-4 / 3) - 3)

    def stress(self, gradient: Tensors) -> Tensors:
        """Return the first Piola-Kirchhoff stress d psi / dF, (3, 3, ...) in [MPa]."""
        _, volume, i1, i2 = _invariants(gradient)
        inverse = _inverse_transposed(gradient)
        slope1, slope2 = _slopes(gradient)
        first = volume ** (-2 / 3) * (slope1 - 2 / 3 * i1 * inverse)
        second = volume ** (-4 / 3) * (slope2 - 4 / 3 * i2 * inverse)
        return self.c1_mpa * first + self.c2_mpa * second

    def stiffness(self, gradient: Tensors) -> Tensors:
        """Return the stiffness d^2 psi / dF dF, (3, 3, 3, 3, ...) in [MPa]."""
        cauchy, volume, i1, i2 = _invariants(gradient)
        inverse = _inverse_transposed(gradient)
        slope1, slope2 = _slopes(gradient)
        one = np.eye(3).reshape(3, 3, *(1,) * (gradient.ndim - 2))
        same = np.einsum("ik...,jl...->ijkl...", one, one)
        left = np.einsum("im...,km...->ik...", gradient, gradient)
        curve2 = 4 * _outer(gradient, gradient) + 2 * i1 * same
        curve2 -= 2 * np.einsum("ik...,lj...->ijkl...", one, cauchy)
        curve2 -= 2 * np.einsum("ik...,lj...->ijkl...", left, one)
        curve2 -= 2 * np.einsum("il...,kj...->ijkl...", gradient, gradient)
        first = _curvature(inverse, volume, 2 / 3, i1, slope1, 2 * same)
        second = _curvature(inverse, volume, 4 / 3, i2, slope2, curve2)
        return self.c1_mpa * first + self.c2_mpa * second


def _volume(gradient: Tensors) -> Tensors:
    """Return J."""
    return np.linalg.det(np.moveaxis(gradient, (0, 1), (-2, -1)))


def _invariants(gradient: Tensors) -> tuple[Tensors, Tensors, Tensors, Tensors]:
    """Return C, J, I1 and I2."""
    cauchy = np.einsum("ki...,kj...->ij...", gradient, gradient)
    volume = _volume(gradient)
    i1 = np.einsum("ii...->...", cauchy)
    return cauchy, volume, i1, (i1**2 - np.einsum("ij...,ij...->...", cauchy, cauchy)) / 2


def _slopes(gradient: Tensors) -> tuple[Tensors, Tensors]:
    """Return the derivatives of I1 and I2 by F."""
    cauchy, _, i1, _ = _invariants(gradient)
    return 2 * gradient, 2 * (i1 * gradient - np.einsum("ik...,kj...->ij...", gradient, cauchy))


def _inverse_transposed(gradient: Tensors) -> Tensors:
    return np.moveaxis(np.linalg.inv(np.moveaxis(gradient, (0, 1), (-1, -2))), (-2, -1), (0, 1))


def _curvature(
    inverse: Tensors, volume: Tensors, power: float, invariant: Tensors, slope: Tensors, curve: Tensors
) -> Tensors:
    """Return the second derivative of J^-power I by F, from I's own slope and curve and from dJ/dF = J F^-T."""
    mixed = _outer(slope, inverse)
    pair = _outer(inverse, inverse)
    by_volume = power * invariant * (power * pair + np.swapaxes(pair, 1, 3))
    return volume**-power * (curve - power * (mixed + np.moveaxis(mixed, (0, 1), (2, 3))) + by_volume)


def _outer(a: Tensors, b: Tensors) -> Tensors:
    return np.einsum("ij...,kl...->ijkl...", a, b)
