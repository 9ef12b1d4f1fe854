"""The flat contact on a bonded layer: nearly incompressible, thin, thick, one cell, all cells, none."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from export.stability.case import Case, refused, timed
from train.physics.contact import ContactResult, ContactSolver
from train.physics.elastic_layer import Layer, inner_displacement, surface_compliance

PART: Final = "layer contact"
SIZE: Final = 42
CELL_MM: Final = 0.47
INDENTATION_MM: Final = 0.3
RADIUS_MM: Final = 4.0
POISSONS: Final = (0.0, 0.3, 0.45, 0.48, 0.49, 0.499, 0.4999)
THICKNESSES_MM: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 4.5, 10.0, 20.0, 50.0)
_OFF: Final = 1e3
"""Depth outside the shape, in [mm]."""
_DOUBLE: Final = 1e-4
"""Largest difference between float32 and float64; a residual of 1e-3 allows more."""
_BALANCE: Final = 1e-3
"""Tolerance of the balance, equal to the requested residual."""


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    whole = Layer()
    for poisson in POISSONS[::3] if quick else POISSONS:
        yield from _press("Poisson's ratio", f"{poisson:g}", replace(whole, poisson=poisson), punch())
    for thickness_mm in THICKNESSES_MM[::4] if quick else THICKNESSES_MM:
        layer = replace(whole, thickness_mm=thickness_mm)
        yield from _press("thickness", f"{thickness_mm:g} mm", layer, punch())
        yield against_a_wide_grid(layer, f"{thickness_mm:g} mm")
    yield from _press("contact", "one cell", whole, punch(radius_mm=0.4 * CELL_MM, x_mm=CELL_MM / 2, y_mm=CELL_MM / 2))
    yield from _press("contact", "the whole face", whole, np.zeros((SIZE, SIZE)))
    yield from _press("contact", "punch half off the pad", whole, punch(x_mm=SIZE * CELL_MM / 2))
    solver = ContactSolver(whole, SIZE, CELL_MM)
    nothing = np.full((1, SIZE, SIZE), _OFF)
    yield refused(PART, "contact", "none", lambda: solver.solve(nothing, INDENTATION_MM), ValueError)
    yield refused(PART, "indentation", "0 mm", lambda: solver.solve(punch()[None], 0.0), ValueError)
    yield refused(PART, "Poisson's ratio", "0.5", lambda: replace(whole, poisson=0.5), ValueError)
    yield from _waves()


def punch(radius_mm: float = RADIUS_MM, x_mm: float = 0.0, y_mm: float = 0.0, size: int = SIZE) -> NDArray[np.float64]:
    """Return the depth image of a flat round punch, (size, size) in [mm]."""
    along_mm = (np.arange(size) - (size - 1) / 2) * CELL_MM
    return np.where(np.hypot(along_mm - x_mm, along_mm[:, None] - y_mm) <= radius_mm, 0.0, _OFF)


def _press(case: str, severity: str, layer: Layer, depth_mm: NDArray[np.float64]) -> Iterator[Case]:
    solver = ContactSolver(layer, SIZE, CELL_MM)
    found, run_ms = timed(lambda: solver.solve(depth_mm[None], INDENTATION_MM))
    double = ContactSolver(layer, SIZE, CELL_MM, torch.float64).solve(depth_mm[None], INDENTATION_MM)
    note = f"{found.steps} steps"
    yield Case(
        PART, case, severity, "residual, share of the indentation", float(found.residual[0]), 1e-3, run_ms, note=note
    )
    yield Case(PART, case, severity, "force balance", _balance(found), _BALANCE, run_ms)
    apart = abs(float(found.force_n[0] / double.force_n[0]) - 1)
    yield Case(PART, case, severity, "force, float32 to float64", apart, _DOUBLE, run_ms)


def _balance(found: ContactResult) -> float:
    """Return the difference of the pressure's work from force times indentation, which are equal for a flat face."""
    work = float((found.pressure_mpa.astype(np.float64) * found.displacement_mm).sum() * found.solver.cell_mm**2)
    return abs(work / (float(found.force_n[0]) * INDENTATION_MM) - 1)


def against_a_wide_grid(layer: Layer, severity: str) -> Case:
    """Return the case of the periodic grid of the pad's response, whose copies must have no effect."""
    solver = ContactSolver(layer, SIZE, CELL_MM, torch.float64)
    found, run_ms = timed(lambda: solver.solve(punch()[None], INDENTATION_MM))
    wide = 24 * SIZE  # its copies are further away than any thickness requires
    true = ContactSolver(layer, wide, CELL_MM, torch.float64).solve(punch(size=wide)[None], INDENTATION_MM)
    apart = abs(float(found.force_n[0] / true.force_n[0]) - 1)
    return Case(PART, "thickness", severity, "force, to a grid 24 times as wide", apart, 1e-3, run_ms)


def _waves() -> Iterator[Case]:
    """Yield the cases of q h far above sinh's range and far below that of differences: finite, and at their limits."""
    layer = Layer()
    modulus = layer.shear_modulus_mpa / (1 - layer.poisson)
    for a in (1e-12, 1e-5, 1e-3, 1.0, 30.0, 710.0, 1e4, 1e8):
        q = np.array([a / layer.thickness_mm])
        surface, run_ms = timed(lambda q=q: surface_compliance(layer, q)[0])
        inside = inner_displacement(layer, q, layer.thickness_mm)[0][0]
        apart = abs(inside / surface - 1)
        yield Case(PART, "q h", f"{a:g}", "compliance by two ways", float(apart), 1e-5, run_ms)
        if a >= 30:
            half_space = 1 / (modulus * q[0])
            yield Case(
                PART, "q h", f"{a:g}", "compliance, to the half-space", abs(surface / half_space - 1), 1e-9, run_ms
            )
