"""Fig. 7: HR patterns by tPSF, PSF and Depth against finite elements, error and run time."""

from collections.abc import Callable
from functools import partial
from timeit import repeat
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_gain
from edge.evaluation.metrics import rmse_percent
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.experiments.workbench import Workbench
from train.physics.fem_reference import CENTRE, FINEST, LAYER, SCALE, Mesh, press_surface
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.tpsf import BETA_MM, spread, tpsf_pattern
from train.report import Report, Row
from train.surfaces.depth_image import depth_image
from train.surfaces.named_surfaces import LETTERS, relief

PSF_BETAS_MM: Final = (0.4, 0.5, 0.6, 0.7, 0.8, 1.0, BETA_MM, 1.6, 2.0)
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(SCALE)

Maps = NDArray[np.float32]  # maps (surfaces, steps, 40, 40) in [mm]


class FemMethod(NamedTuple):
    """Maps of all surfaces and steps by a method, and its time for one surface's steps."""

    maps: Maps
    time_s: float  # of the fastest run

    def rms_mm(self, truth: Maps) -> NDArray[np.float64]:
        """Return the error of each map, (surfaces, steps) in [mm], but for heights around the contact."""
        return rmse_percent(np.maximum(self.maps, 0), np.maximum(truth, 0), 100.0)


def fig7(bench: Workbench, report: Report) -> None:
    """Compare the methods with finite elements, which take half an hour on one core."""
    surfaces, mesh, steps = (LETTERS[:2], Mesh(4, 2), 2) if bench.quick else (LETTERS, FINEST, 10)
    indentation_mm = np.linspace(MAX_INDENTATION_MM / steps, MAX_INDENTATION_MM, steps)
    names = tracked(surfaces, f"FEM {mesh}", "surface")
    presses = [press_surface(name, mesh, indentation_mm) for name in names]
    truth, forces_n, run_s = (np.stack(parts) for parts in zip(*presses, strict=True))
    methods, beta_mm = _methods(surfaces, indentation_mm, forces_n, truth)
    methods[f"FEM {mesh}"] = FemMethod(truth, float(run_s.mean()))

    report.say(
        f"{len(surfaces)} letters at p5 r0, {steps} indentations up to {MAX_INDENTATION_MM} mm, all methods on the "
        f"same touching pixels, gaussian kernel. tPSF: its plateau is the indentation, its beta of {BETA_MM} mm was "
        "fitted to the layer's surface, not to these maps. PSF (no plateau): times the indentation and one alpha for "
        f"all maps, by least squares against the truth it is compared with, and the best of {len(PSF_BETAS_MM)} betas "
        f"against FEM (beta {beta_mm:g} mm). Depth x force, as the paper has it: the touching pixels, sharp, with one "
        "factor fitted in the same way. FEM: neo-Hookean, large strain, free sides, Poisson's ratio "
        f"{LAYER.poisson:g}; nodes are the pixels. Run times are one process's."
    )
    rows: list[Row] = []
    for name, method in methods.items():
        percent = 100 * method.rms_mm(truth) / indentation_mm
        best, *_, worst = sorted(percent.mean(axis=1))
        error = f"{percent.mean():.2f} ({best:.2f}..{worst:.2f})"
        rows.append({"method": name, "error %": error, "ms a pattern": 1e3 * method.time_s / steps})
    report.table(
        rows,
        f"RMS error over the 40 x 40 window, in % of the indentation; truth is FEM at {mesh}. Mean over "
        "surfaces and steps, in brackets the best and the worst surface. What heaps up around the contact counts as 0, "
        "as no PSF pulls.",
    )


def _methods(
    surfaces: tuple[str, ...], indentation_mm: NDArray[np.floating], force_n: NDArray[np.floating], truth: Maps
) -> tuple[dict[str, FemMethod], float]:
    """Return the methods that are faster than finite elements, by name, and the beta of the best PSF in [mm]."""
    depth_mm = np.stack([depth_image(relief(name), CENTRE, 4 * SCALE, _PIXEL_MM) for name in surfaces])
    touching = np.repeat(depth_mm[:, None] < 1e-3, len(indentation_mm), axis=1)
    step_mm = indentation_mm.astype(np.float32)

    def by_psf(beta_mm: float, i: int) -> Maps:
        area = torch.from_numpy(touching[i]).float()
        return spread(area, torch.tensor([beta_mm]), _PIXEL_MM).numpy() * step_mm[:, None, None]

    def made(make: Callable[[int], Maps], *, scaled: bool = False) -> FemMethod:
        maps = np.stack([make(i) for i in range(len(surfaces))])
        if scaled:  # one factor brings all to [mm], by least squares
            maps *= np.float32(fit_gain(maps, np.maximum(truth, 0)))
        return FemMethod(maps, min(repeat(partial(make, 0), number=1)))

    psfs = {beta_mm: made(partial(by_psf, beta_mm), scaled=True) for beta_mm in PSF_BETAS_MM}
    best_mm = min(psfs, key=lambda beta_mm: float(psfs[beta_mm].rms_mm(truth).mean()))
    methods = {
        "tPSF": made(lambda i: tpsf_pattern(touching[i], step_mm, _PIXEL_MM)),
        "PSF": psfs[best_mm],
        "Depth x force": made(lambda i: touching[i] * force_n[i].astype(np.float32)[:, None, None], scaled=True),
    }
    return methods, best_mm
