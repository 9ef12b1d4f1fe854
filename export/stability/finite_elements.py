"""Finite-element reference: near incompressibility, locking, strong compression, and mesh refinement."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from export.stability.case import Case, refused, timed
from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer
from train.physics.fem_cache import REFERENCE_POISSON, Mesh
from train.physics.fem_reference import FemPad, FemPresses, NoEquilibriumError

PART: Final = "FEM referee"
BULKS: Final = (10.0, 100.0, 1000.0, 10000.0)
"""Ratios K/G."""
INDENTATION_MM: Final = 0.3
RADIUS_MM: Final = 4.0
LEFT: Final = 0.4
"""Share of the thickness that remains after the strongest compression."""
_LEFT_BY_LEAP: Final = 0.8
"""Share of the thickness that remains where K/G is large.

One step reaches it, two steps do not: the second starts from the first one's field scaled up, which changes volumes,
and a large K amplifies that.
"""
_LEFT_AFTER: Final = {0.01: 0.56, 0.05: 0.8, 0.1: 0.91}
"""Upper bound of the remaining share of the thickness, by step, for presses that end in an error."""
_STEPS: Final = 5
_OFF: Final = 1e3
"""Depth outside the shape, in [mm]."""
_RESIDUAL: Final = 1e-6
"""Residual at which a step is done."""
_BALANCE: Final = 1e-5
"""Tolerance of the balance. The residual is a norm, this a sum: nodes out of balance in one direction add up."""
_LIMIT: Final = 0.01
"""Largest change of the force between G/K of 1e-3 and less, where incompressibility is reached."""
_ORDER: Final = 0.8
"""Least order of convergence: 2 for smooth fields, about 1 with infinite stress at the punch's and board's edges."""
_ERROR_PER_MM: Final = 0.06
"""Error of the force per [mm] of an element's width. The finest mesh of the reference has .47 mm."""


class _Fineness(NamedTuple):
    """Meshes and steps of the cases."""

    punch: Mesh
    compression: Mesh
    steps: tuple[float, ...]
    cells: tuple[int, ...]


_WHOLE: Final = _Fineness(Mesh(4, 3), Mesh(4, 3), (0.01, 0.05, 0.1), (4, 8, 16, 32))
_QUICK: Final = _Fineness(Mesh(3, 2), Mesh(2, 2), (0.05, 0.1), (4, 8, 16))


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases.

    Args:
        quick: on coarser meshes and in fewer steps, for seconds instead of a minute.
    """
    fineness = _QUICK if quick else _WHOLE
    yield from _incompressible(fineness.punch)
    for poisson in (_poisson(BULKS[0]), REFERENCE_POISSON):
        for step in fineness.steps:
            yield _compress(fineness.compression, poisson, step, LEFT)
    for step in (0.2, 0.1):
        yield _compress(fineness.compression, _poisson(BULKS[-1]), step, _LEFT_BY_LEAP)
    yield from _bulge(fineness.compression)
    yield from _converge(fineness.cells, "whole face", np.inf)
    yield from _converge(fineness.cells, "square punch", 5.0)
    yield _too_far(fineness.compression)


def _poisson(bulk: float) -> float:
    """Return Poisson's ratio at a ratio K/G."""
    return (3 * bulk - 2) / (2 * (3 * bulk + 1))


def _bulk(poisson: float) -> float:
    return 2 * (1 + poisson) / (3 * (1 - 2 * poisson))


def _incompressible(mesh: Mesh) -> Iterator[Case]:
    """Yield the cases of a flat punch, in the mixed formulation and with displacement alone."""
    forces_n: list[float] = []
    for bulk in BULKS:
        mixed, run_ms = timed(lambda bulk=bulk: _punch(mesh, bulk, mixed=True))
        severity, note = f"K/G {bulk:g}", _note(mixed)
        what = "residual, share of the reactions"
        yield Case(PART, "flat punch", severity, what, float(mixed.residual.max()), _RESIDUAL, run_ms, note=note)
        apart = float(np.abs(mixed.board_n / mixed.force_n - 1).max())
        yield Case(PART, "flat punch", severity, "push to the board's reaction", apart, _BALANCE, run_ms, note=note)
        forces_n.append(float(mixed.force_n[-1]))
        alone, run_ms = timed(lambda bulk=bulk: _punch(mesh, bulk, mixed=False))
        ratio = float(alone.force_n[-1]) / forces_n[-1]
        what = "force by displacement alone, to the mixed one"
        locks = f"{_note(alone)}; locks: not what the reference uses"
        yield Case(PART, "locking", severity, what, ratio, None, run_ms, note=locks, limit=True, least=1.05)
    change = abs(forces_n[-1] / forces_n[-2] - 1)
    severity = f"K/G {BULKS[-2]:g} to {BULKS[-1]:g}"
    yield Case(PART, "locking", severity, "change of the force, mixed", change, _LIMIT)


def _punch(mesh: Mesh, bulk: float, mixed: bool) -> FemPresses:
    pad = FemPad(*mesh, Layer(poisson=_poisson(bulk)), mixed=mixed)
    depth_mm = np.where(np.hypot(pad.nodes_mm[:, None], pad.nodes_mm) <= RADIUS_MM, 0.0, _OFF)
    return pad.press(depth_mm, np.linspace(0, INDENTATION_MM, _STEPS + 1)[1:])


def _compress(mesh: Mesh, poisson: float, step: float, wanted: float) -> Case:
    """Return the case of the whole face pressed down to the wanted thickness, or until an error."""
    layer = Layer(poisson=poisson)
    count = round((1 - wanted) / step)
    steps_mm = np.linspace(0, (1 - wanted) * layer.thickness_mm, count + 1)[1:]
    what = "thickness left, share"
    case, severity = f"compression to {wanted:.0%}", f"K/G {_bulk(poisson):.0f}, steps of {step:.0%}"
    (found, reached_mm), run_ms = timed(lambda: _face(mesh, layer, steps_mm))
    left = 1 - reached_mm / layer.thickness_mm
    if isinstance(found, NoEquilibriumError):
        guard = f"{type(found).__name__}: {found}"
        return Case(PART, case, severity, what, left, _LEFT_AFTER[step], run_ms, guard=guard)
    return Case(PART, case, severity, what, left, wanted + 1e-9, run_ms, note=_note(found))


def _face(mesh: Mesh, layer: Layer, steps_mm: NDArray[np.floating]) -> tuple[FemPresses | NoEquilibriumError, float]:
    """Return the result of a press with the whole face, and its depth."""
    pad = FemPad(*mesh, layer)
    try:
        return pad.press(np.zeros((pad.size, pad.size)), steps_mm), float(steps_mm[-1])
    except NoEquilibriumError as error:
        return error, error.reached_mm


def _bulge(mesh: Mesh) -> Iterator[Case]:
    """Yield the cases of sides that bulge over the board's rim, below which the elements do not support them."""
    layer = Layer(poisson=REFERENCE_POISSON)
    shares = np.array([0.05, 0.1, 0.15, 0.2, 0.25, 0.3])
    pad = FemPad(*mesh, layer)
    found, run_ms = timed(lambda: pad.press(np.zeros((pad.size, pad.size)), layer.thickness_mm * shares))
    case, severity = "compression", f"K/G {_bulk(REFERENCE_POISSON):.0f}, down by {{:.0%}}"
    last = severity.format(shares[-1])
    what = "residual, share of the reactions"
    yield Case(PART, case, last, what, float(found.residual.max()), _RESIDUAL, run_ms, note=_note(found))
    apart = float(np.abs(found.board_n / found.force_n - 1).max())
    yield Case(PART, case, last, "push to the board's reaction", apart, _BALANCE, run_ms)
    what, early = "sides below the board, mm", 3
    yield Case(PART, case, severity.format(shares[early]), what, float(found.below_board_mm[early]), 0.0)
    note = "nothing holds the sides up: too soft from here on"
    yield Case(PART, case, last, what, float(found.below_board_mm[-1]), 0.5, note=note, limit=True)


def _converge(cells: tuple[int, ...], case: str, half_width_mm: float) -> Iterator[Case]:
    """Yield the cases of refined meshes; each has the nodes of the one before, and the punch's edge lies on nodes."""
    runs = [timed(lambda count=count: _square(count, half_width_mm)) for count in cells]
    forces_n = [float(found.force_n[-1]) for found, _ in runs]
    for i in range(2, len(cells)):
        ratio = (forces_n[i - 1] - forces_n[i]) / (forces_n[i - 2] - forces_n[i - 1])
        severity = f"{cells[i - 2]}, {cells[i - 1]}, {cells[i]} elements a side"
        what, run_ms = "change of the force, to the change before", runs[i][1]
        note = f"order {-np.log2(abs(ratio)):.2f}; {_note(runs[i][0])}"
        yield Case(PART, case, severity, what, abs(ratio), 2**-_ORDER, run_ms, note=note)
        # Richardson extrapolation: the limit of a geometric series of such changes.
        limit_n = forces_n[i] + (forces_n[i] - forces_n[i - 1]) * ratio / (1 - ratio)
        width_mm, apart = USPA44.width_mm / cells[i], abs(forces_n[i] / limit_n - 1)
        severity, what = f"{cells[i]} elements a side", "force, to the limit of fine meshes"
        note = f"elements of {width_mm:.3g} mm; limit {limit_n:.4g} N"
        yield Case(PART, case, severity, what, apart, _ERROR_PER_MM * width_mm, run_ms, note=note)


def _square(count: int, half_width_mm: float) -> FemPresses:
    """Press a square punch on even elements, a quarter as many over the thickness as along a side."""
    # Pixels at x1 and the rim, all at the same distance.
    even = replace(USPA44, rows=count - 1, cols=count - 1, pitch_mm=USPA44.width_mm / count)
    pad = FemPad(1, count // 4, Layer(poisson=REFERENCE_POISSON), geometry=even)
    inside = np.abs(pad.nodes_mm) <= half_width_mm * (1 + 1e-9)
    return pad.press(np.where(inside[:, None] & inside, 0.0, _OFF), np.array([0.1]))


def _too_far(mesh: Mesh) -> Case:
    layer = Layer(poisson=REFERENCE_POISSON)
    pad = FemPad(*mesh, layer)
    down_mm = np.array([(1 - LEFT) * layer.thickness_mm])
    return refused(
        PART,
        f"compression to {LEFT:.0%}",
        f"K/G {_bulk(REFERENCE_POISSON):.0f}, one leap",
        lambda: pad.press(np.zeros((pad.size, pad.size)), down_mm),
        NoEquilibriumError,
    )


def _note(found: FemPresses) -> str:
    return f"{len(found.indentation_mm)} load steps, {found.newton_steps.sum()} Newton"
