"""Curved contact, depth by depth: spheres from half a millimetre to a metre, compared with Hertz in its range."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from export.stability.case import Case, timed
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer

PART: Final = "curved contact"
_POISSON: Final = 0.45
_HERTZ_HOLDS: Final = 1.06
"""Largest stiffening by the layer at which the contact area is compared; there is no formula for larger ones."""


@dataclass(frozen=True, slots=True)
class _Ball:
    """Sphere on a pad so thick and finely sampled that it is a half-space, or on the default pad."""

    radius_mm: float
    indentation_mm: float
    cell_mm: float
    thickness_mm: float
    size: int = 96

    @property
    def contact_mm(self) -> float:
        """Radius of the contact by Hertz, in [mm]."""
        return float(np.sqrt(self.radius_mm * self.indentation_mm))


_HERTZ: Final = tuple(
    # Sixteen cells from the middle to the edge, three contacts on the grid.
    _Ball(radius_mm, radius_mm / 400, radius_mm / 20 / 16, contacts_thick * radius_mm / 20)
    for radius_mm, contacts_thick in ((0.5, 5), (2.0, 10), (10.0, 20), (100.0, 40), (1000.0, 80))
)
_PAD: Final = tuple(_Ball(radius_mm, 0.3, 0.47, 4.5, size=42) for radius_mm in (0.5, 2.0, 10.0, 100.0, 1000.0))


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    for ball in _HERTZ[:3] if quick else _HERTZ:  # the thicker a layer, the wider the grid of its response
        solver, depth_mm = _solver(ball), _depth_mm(ball)
        found, run_ms = timed(
            lambda solver=solver, depth=depth_mm, ball=ball: solver.solve(depth[None], ball.indentation_mm)
        )
        modulus = 2 * Layer().shear_modulus_mpa / (1 - _POISSON)
        hertz_n = 4 / 3 * modulus * np.sqrt(ball.radius_mm) * ball.indentation_mm**1.5
        thick = ball.contact_mm / ball.thickness_mm
        severity = f"radius {ball.radius_mm:g} mm, {1 / thick:.0f} contacts thick"
        stiffer = _bonded(thick)
        apart = abs(float(found.force_n[0]) / (hertz_n * stiffer) - 1)
        note = f"{found.steps} steps; the layer makes it {stiffer - 1:.1%} stiffer"
        yield Case(PART, "thick layer", severity, "force, to Hertz on a bonded layer", apart, 0.01, run_ms, note=note)
        if stiffer < _HERTZ_HOLDS:
            area_mm2 = float((found.pressure_mpa[0] > 0).sum()) * ball.cell_mm**2
            apart = abs(area_mm2 / (np.pi * ball.contact_mm**2) - 1)
            yield Case(PART, "thick layer", severity, "area, to Hertz", apart, 0.1, run_ms)
    for ball in _PAD:
        solver, depth_mm = _solver(ball), _depth_mm(ball)
        found, run_ms = timed(
            lambda solver=solver, depth=depth_mm, ball=ball: solver.solve(depth[None], ball.indentation_mm)
        )
        severity, residual = f"radius {ball.radius_mm:g} mm", float(found.residual[0])
        what = "residual, share of the indentation"
        yield Case(PART, "the pad", severity, what, residual, 1e-3, run_ms, note=f"{found.steps} steps")


def _bonded(share: float) -> float:
    """Return the stiffness of a bonded layer over that of a half-space, by the contact's radius over its thickness.

    Source: Dimitriadis et al. 2002, Eq. 11 and 14.
    """
    nu = _POISSON
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    pi = np.pi
    cubic = a**3 + 4 * pi**2 / 15 * b
    quartic = a**3 + 3 * pi**2 / 5 * b
    terms = (1, -2 * a / pi, 4 * a**2 / pi**2, -8 / pi**3 * cubic, 16 * a / pi**4 * quartic)
    return float(sum(term * share**power for power, term in enumerate(terms)))


def _solver(ball: _Ball) -> ContactSolver:
    return ContactSolver(Layer(thickness_mm=ball.thickness_mm, poisson=_POISSON), ball.size, ball.cell_mm)


def _depth_mm(ball: _Ball) -> NDArray[np.float64]:
    along_mm = (np.arange(ball.size) - (ball.size - 1) / 2) * ball.cell_mm
    square = np.minimum(along_mm**2 + along_mm[:, None] ** 2, ball.radius_mm**2)
    return square / (ball.radius_mm + np.sqrt(ball.radius_mm**2 - square))  # without cancellation
