"""Finite-element reference: the pad as a neo-Hookean solid under a rigid surface, at large strain.

The paper has a Mooney-Rivlin solid, of which this one is the case C2 = 0: with C2 a fifth of C1 + C2 a pattern differs
by 0.26 % of an indentation of 0.5 mm, and takes twice as long.

Hexahedra in the mixed formulation (displacement, pressure and volume ratio, the latter two constant in each cell
and condensed) avoid locking as the rubber becomes incompressible. Contact is frictionless and of small slope: a
touching node stays at the surface's height above the node's initial place, and is free in the plane. An active set
determines the touching nodes: no node may be pulled, and none may overlap the surface.

Each surface takes minutes. FElupe is required, which is GPL and so a separate extra; only this module imports it.

Source: Wu and Liu 2024, section IV-D (the model); Holzapfel 2000, section 6.5 (the split of shape and volume).
"""

from dataclasses import replace
from time import perf_counter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from firmware_bridge.errors import how_to_install
from firmware_bridge.pad_geometry import USPA44
from train.errors import TrainError
from train.physics.elastic_layer import Layer
from train.physics.gripped import SCALE
from train.surfaces.depth_image import Pose, depth_image
from train.surfaces.named_surfaces import relief

try:
    import felupe
except ModuleNotFoundError as error:
    message = f"the FEM reference needs felupe (GPL): {how_to_install('fem')}"
    raise ModuleNotFoundError(message, name="felupe") from error

CENTRE: Final = Pose(0.0, 0.0, 0.0)  # position 5, rotation 0 of the paper
# The solver's own Poisson's ratio is lower to account for free sides, which the elements have.
LAYER: Final = replace(Layer(), poisson=0.495)
_SLACK: Final = 1e-4  # tolerance of pull and overlap: shares of a touching node's mean push, and of the indentation


class NoEquilibriumError(TrainError, ArithmeticError):
    """Failure of the elements to converge; the message names the indentation."""


class Mesh(NamedTuple):
    """Fineness of the elements: nodes per taxel pitch, and elements over the thickness."""

    scale: int
    cells_high: int

    def __str__(self) -> str:
        return f"{self.scale} nodes a pitch, {self.cells_high} high"


FINEST: Final = Mesh(10, 8)  # mesh whose nodes are the pixels of the 40 x 40 pattern


def press_surface(
    surface: str, mesh: Mesh, indentation_mm: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float64], float]:
    """Press a named surface into the middle of the pad at rising indentations (s,).

    Returned are patterns (s, 40, 40) in [mm], forces (s,) in [N], and the run time in [s].
    """
    pad = FemPad(*mesh)
    depth_mm = depth_image(relief(surface), CENTRE, pad.size, pad.cell_mm)
    start = perf_counter()
    push_n, down_mm = pad.press(depth_mm, indentation_mm)
    return pad.pattern(down_mm), push_n.sum(axis=(1, 2)), perf_counter() - start


class FemPad:
    """Pad bonded to its board, with free sides, its material that of the layer at small strain.

    Nodes lie on the pixels of the pattern at a scale, and on the pad's rim.
    """

    def __init__(self, scale: int, cells_high: int, layer: Layer = LAYER) -> None:
        self.cell_mm = USPA44.pixel_pitch_mm(scale)
        pixels = USPA44.cols * scale
        inner = pixels + 2 * int((USPA44.width_mm / self.cell_mm - pixels) // 2)
        places_mm = (np.arange(inner) - (inner - 1) / 2) * self.cell_mm
        self.nodes_mm = np.concatenate([[-USPA44.width_mm / 2], places_mm, [USPA44.width_mm / 2]])
        self.size = len(self.nodes_mm)
        mesh = felupe.Grid(self.nodes_mm, self.nodes_mm, np.linspace(0, layer.thickness_mm, cells_high + 1))
        self._top = np.arange(mesh.npoints - self.size**2, mesh.npoints)
        self._field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        self.bulk_mpa = layer.shear_modulus_mpa * 2 * (1 + layer.poisson) / (3 * (1 - 2 * layer.poisson))
        # The mixed elements add the volumetric part.
        material = felupe.NeoHooke(mu=layer.shear_modulus_mpa)
        self._body = felupe.SolidBodyNearlyIncompressible(material, self._field, bulk=self.bulk_mpa)

    def press(
        self, depth_mm: NDArray[np.floating], indentation_mm: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Press a surface into a pad as it was made at rising indentations (s,), each from the last one's equilibrium.

        Depths (size, size) are below its highest point over each node; the image of size x size cells of cell_mm fits,
        because its rim is the pad's up to a fraction of a cell. Returned are each node's force and displacement
        downwards, (s, size, size). NoEquilibriumError if the elements do not converge.
        """
        touching, before_mm, steps = np.zeros((self.size, self.size), dtype=bool), 0.0, []
        for step_mm in map(float, indentation_mm):
            if before_mm:
                # Nearly linear: the last step's field, scaled up, is close to the next one's.
                self._field[0].values *= step_mm / before_mm
            touching, *found = self._advance(touching, step_mm, step_mm - depth_mm)
            steps.append(found)
            before_mm = step_mm
        push_n, down_mm = map(np.array, zip(*steps, strict=True))
        return push_n, down_mm

    def _advance(
        self, touching: NDArray[np.bool_], indentation_mm: float, wanted_mm: NDArray[np.floating]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Return touching nodes, forces and displacement once the surface is `wanted_mm` below the pad's face."""
        touching = touching | (wanted_mm > self._down_mm())
        for _ in range(20):
            upwards_n = self._balance(touching, wanted_mm, indentation_mm).reshape(-1, 3)[self._top, 2]
            push_n = np.where(touching, -upwards_n.reshape(touching.shape), 0.0)
            down_mm = self._down_mm()
            pulled = push_n < -_SLACK * push_n.sum() / touching.sum()
            sunk = ~touching & (wanted_mm - down_mm > _SLACK * indentation_mm)
            if not (pulled | sunk).any():
                return touching, push_n, down_mm
            touching = touching & ~pulled | sunk
        raise _none_at(indentation_mm)

    def _down_mm(self) -> NDArray[np.float64]:
        return -self._field[0].values[self._top, 2].reshape(self.size, self.size)

    def _balance(
        self, touching: NDArray[np.bool_], wanted_mm: NDArray[np.floating], indentation_mm: float
    ) -> NDArray[np.float64]:
        """Run Newton's iterations with the touching nodes held at their height; return the nodes' forces."""
        held = np.full(self._field[0].values.shape, np.nan)
        held[: self.size**2] = 0.0  # on the board
        held[self._top[touching.ravel()], 2] = -wanted_mm[touching]
        fixed = ~np.isnan(held.ravel())
        try:
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                balance = felupe.newtonraphson(
                    items=[self._body],
                    dof0=np.flatnonzero(fixed),
                    dof1=np.flatnonzero(~fixed),
                    ext0=held.ravel()[fixed],
                    solver=_solve,
                    tol=1e-6,  # out-of-balance forces at which a step is done, as a share of the reactions
                    maxiter=12,
                    verbose=False,
                )
        except felupe.NewtonConvergenceError as error:
            raise _none_at(indentation_mm) from error
        return np.asarray(balance.fun)

    def pattern(self, displacement_mm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Interpolate node displacements (s, size, size) linearly to the pixels of the pattern at SCALE."""
        pixel_mm, count = USPA44.pixel_pitch_mm(SCALE), USPA44.cols * SCALE
        along_mm = (np.arange(count) - (count - 1) / 2) * pixel_mm
        surface = RegularGridInterpolator((self.nodes_mm, self.nodes_mm), np.moveaxis(displacement_mm, 0, -1))
        return np.moveaxis(surface(tuple(np.meshgrid(along_mm, along_mm, indexing="ij"))), -1, 0).astype(np.float32)


def _solve(tangent: csr_matrix, load: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        # Ordered for a symmetric matrix and without pivoting: half the fill and the time of the default.
        options = {"SymmetricMode": True}
        return splu(tangent.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve(load)
    except RuntimeError as error:
        raise felupe.NewtonConvergenceError("the tangent is singular") from error


def _none_at(indentation_mm: float) -> NoEquilibriumError:
    # A step starts from the last field scaled up, a poor start near incompressibility.
    return NoEquilibriumError(
        f"no equilibrium at an indentation of {indentation_mm:.3g} mm; press in other steps: smaller ones or, near a "
        "Poisson's ratio of .5, larger"
    )
