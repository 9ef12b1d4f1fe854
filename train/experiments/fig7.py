"""Fig. 7: HR patterns by tPSF, PSF and Depth against finite elements, error and run time.

The nine letters, tapped at their middle, at ten indentations. Every method is given the contact area and the
indentation; the report states the conversion of each to millimetres.
"""

from collections.abc import Callable
from functools import partial
from timeit import repeat
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edge.evaluation.metrics import rmse_percent
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.experiments.workbench import Workbench
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.fem_reference import CENTRE, FINEST, LAYER, SCALE, Mesh, press_surface
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.tpsf import BETA_MM, spread, tpsf_pattern
from train.report import Report, Row
from train.surfaces.depth_image import depth_image
from train.surfaces.named_surfaces import LETTERS, relief

PSF_BETAS_MM: Final = (0.4, 0.5, 0.6, 0.7, 0.8, 1.0, BETA_MM, 1.6, 2.0)
MESHES: Final = (FINEST, Mesh(10, 4))
"""Meshes, the finest as the truth."""
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(SCALE)
_PAD_PX: Final = 42

Maps = NDArray[np.float32]  # maps (surfaces, steps, 40, 40) in [mm]


class FemMethod(NamedTuple):
    """Maps of all surfaces and steps by a method, and its time for one surface's steps, of the fastest run.

    Where `scaled`, maps are in its own unit: one factor brings all to [mm], by least squares against the truth.
    """

    maps: Maps
    time_s: float
    scaled: bool = False

    def against(self, truth: Maps) -> Maps:
        """Return the maps in [mm], scaled to a truth where they have no scale of their own."""
        return self.maps * np.float32((self.maps * truth).sum() / (self.maps**2).sum()) if self.scaled else self.maps

    def rms_mm(self, truth: Maps) -> NDArray[np.float64]:
        """Return the error of each map, (surfaces, steps) in [mm], but for heights around the contact."""
        pressed = np.maximum(truth, 0)
        return rmse_percent(np.maximum(self.against(pressed), 0), pressed, 100.0)


def fig7(bench: Workbench, report: Report) -> None:
    """Compare the methods with finite elements, which take half an hour on one core."""
    surfaces, meshes, steps = (LETTERS[:2], (Mesh(4, 2), Mesh(3, 2)), 2) if bench.quick else (LETTERS, MESHES, 10)
    indentation_mm = np.linspace(MAX_INDENTATION_MM / steps, MAX_INDENTATION_MM, steps)
    by_fem: dict[str, FemMethod] = {}
    forces_n = np.empty(0)
    for mesh in reversed(meshes):
        names = tracked(surfaces, f"FEM {mesh}", "surface")
        presses = [press_surface(name, mesh, indentation_mm) for name in names]
        maps, forces_n, run_s = (np.stack(parts) for parts in zip(*presses, strict=True))
        by_fem[f"FEM {mesh}"] = FemMethod(maps, float(run_s.mean()))
    truth = by_fem[f"FEM {meshes[0]}"].maps
    methods, beta_mm = _methods(surfaces, indentation_mm, forces_n, truth)
    methods |= by_fem

    report.say(_how(len(surfaces), steps, beta_mm))
    report.table(
        [{"method": name} | _cells(method, truth, indentation_mm) for name, method in methods.items()],
        f"RMS error over the 40 x 40 window, in % of the indentation; truth is FEM at {meshes[0]}. Mean over "
        "surfaces and steps, in brackets the best and the worst surface. What heaps up around the contact counts as 0, "
        "as no PSF pulls.",
    )


def _methods(
    surfaces: tuple[str, ...], indentation_mm: NDArray[np.floating], force_n: NDArray[np.floating], truth: Maps
) -> tuple[dict[str, FemMethod], float]:
    """Return the methods that are faster than finite elements, by name, and the beta of the best PSF in [mm]."""
    margin = (_PAD_PX - 4 * SCALE) // 2
    depth_mm = np.stack([depth_image(relief(name), CENTRE, _PAD_PX, _PIXEL_MM) for name in surfaces])
    window = slice(margin, _PAD_PX - margin)
    touching = np.repeat(depth_mm[:, None, window, window] < 1e-3, len(indentation_mm), axis=1)
    step_mm = indentation_mm.astype(np.float32)
    solver = ContactSolver(Layer(), _PAD_PX, _PIXEL_MM)

    def by_psf(beta_mm: float, i: int) -> Maps:
        area = torch.from_numpy(touching[i]).float()
        return spread(area, torch.tensor([beta_mm]), _PIXEL_MM).numpy() * step_mm[:, None, None]

    def by_layer(i: int) -> Maps:
        unit = solver.displacement_mm(solver.solve(depth_mm[i : i + 1])[0])[:, window, window]
        return unit * step_mm[:, None, None]

    def made(make: Callable[[int], Maps], *, scaled: bool = False) -> FemMethod:
        maps = np.stack([make(i) for i in range(len(surfaces))])
        return FemMethod(maps, min(repeat(partial(make, 0), number=1)), scaled)

    psfs = {beta_mm: made(partial(by_psf, beta_mm), scaled=True) for beta_mm in PSF_BETAS_MM}
    best_mm = min(psfs, key=lambda beta_mm: float(psfs[beta_mm].rms_mm(truth).mean()))
    methods = {
        "tPSF": made(lambda i: tpsf_pattern(touching[i], step_mm, _PIXEL_MM)),
        "PSF": psfs[best_mm],
        "Depth x force": made(lambda i: touching[i] * force_n[i].astype(np.float32)[:, None, None], scaled=True),
        "layer": made(by_layer),
    }
    return methods, best_mm


def _cells(method: FemMethod, truth: Maps, indentation_mm: NDArray[np.floating]) -> Row:
    percent = 100 * method.rms_mm(truth) / indentation_mm
    by_surface = percent.mean(axis=1)
    return {
        "error %": f"{percent.mean():.2f} ({by_surface.min():.2f}..{by_surface.max():.2f})",
        "ms a pattern": 1e3 * method.time_s / len(indentation_mm),
    }


def _how(surfaces: int, steps: int, beta_mm: float) -> str:
    return (
        f"{surfaces} letters at p5 r0, {steps} indentations up to {MAX_INDENTATION_MM} mm, all methods on the same "
        f"touching pixels, gaussian kernel. tPSF: its plateau is the indentation, its beta of {BETA_MM} mm was "
        "fitted to the layer's surface, not to these maps. PSF (no plateau): times the indentation and one alpha for "
        f"all maps, by least squares against the truth it is compared with, and the best of {len(PSF_BETAS_MM)} betas "
        f"against FEM (beta {beta_mm:g} mm). Depth x force, as the paper has it: the touching pixels, sharp, with one "
        "factor fitted in the same way. layer: bonded layer without sides, Polonsky-Keer, Poisson's ratio "
        f"{Layer().poisson:g}. FEM: neo-Hookean, large strain, free sides, Poisson's ratio {LAYER.poisson:g}; nodes "
        "are the pixels. Run times are one process's."
    )
