"""Fig. 7: HR patterns by tPSF, PSF and Depth against finite elements and against the layer, error and run time.

The nine letters, tapped at their middle, at ten indentations. Every method is given the contact area and the
indentation; the report states the conversion of each to millimetres.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from timeit import repeat
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db, rmse_percent
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.experiments.support.workbench import Workbench
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.fem_reference import CENTRE, FINEST, LAYER, SCALE, Mesh, Verdict, press_or_recall
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.tpsf import BETA_MM, spread, tpsf_pattern
from train.report import Report, Row
from train.surfaces.depth_image import depth_image
from train.surfaces.named_surfaces import LETTERS, relief

STEPS: Final = 10
PSF_BETAS_MM: Final = (0.4, 0.5, 0.6, 0.7, 0.8, 1.0, BETA_MM, 1.6, 2.0)
MESHES: Final = (FINEST, Mesh(10, 4), Mesh(7, 6), Mesh(5, 4))
"""Meshes, the finest as the truth. The second has nodes on the same pixels; the others' lie between pixels."""
_QUICK_MESHES: Final = (Mesh(4, 2), Mesh(3, 2))
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(SCALE)
_PAD_PX: Final = 42
_ON_TOP_MM: Final = 1e-3

Maps = NDArray[np.float32]
"""Maps (surfaces, steps, 40, 40) in [mm]."""


@dataclass(frozen=True, slots=True)
class Method:
    """Method that computes maps of all surfaces and steps, and the time for one surface's steps, of the fastest run.

    Where `scaled`, maps are in its own unit: one factor brings all to [mm], by least squares against the truth.
    """

    name: str
    maps: Maps
    time_s: float
    scaled: bool = False

    def against(self, truth: Maps) -> Maps:
        """Return the maps in [mm], scaled to a truth where they have no scale of their own."""
        return self.maps * np.float32((self.maps * truth).sum() / (self.maps**2).sum()) if self.scaled else self.maps

    def rms_mm(self, truth: Maps, *, heaps: bool = False) -> NDArray[np.float64]:
        """Return the error of each map, (surfaces, steps) in [mm]; `heaps` includes heights around the contact."""
        if heaps:
            return rmse_percent(self.against(truth), truth, 100.0)
        pressed = np.maximum(truth, 0)
        return rmse_percent(np.maximum(self.against(pressed), 0), pressed, 100.0)


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `fig7`; finite elements are kept in the data folder.

    The full run takes about half an hour on one core, nearly all of it for the finite elements.
    """
    surfaces = LETTERS[:2] if bench.quick else LETTERS
    meshes = _QUICK_MESHES if bench.quick else MESHES
    steps = 2 if bench.quick else STEPS
    indentation_mm = np.linspace(MAX_INDENTATION_MM / steps, MAX_INDENTATION_MM, steps)
    verdicts = {
        mesh: [
            press_or_recall(name, mesh, indentation_mm, bench.data_folder)
            for name in tracked(surfaces, f"FEM {mesh}", "surface")
        ]
        for mesh in meshes
    }
    finest = verdicts[meshes[0]]
    truth = np.stack([verdict.patterns_mm for verdict in finest])
    force_n = np.stack([verdict.force_n for verdict in finest])
    methods = _methods(surfaces, indentation_mm, force_n)
    psfs = [method for method in methods if method.name.startswith("PSF")]
    best = min(psfs, key=lambda method: float(method.rms_mm(truth).mean()))
    methods = [method for method in methods if method is best or method not in psfs]
    methods[methods.index(best)] = replace(best, name="PSF")
    layer = next(method for method in methods if method.name == "layer")
    methods += [
        Method(f"FEM {mesh}", np.stack([verdict.patterns_mm for verdict in found]), _time_s(found))
        for mesh, found in verdicts.items()
    ]

    report = Report("fig7", folder, __file__, bench.used, quick=bench.quick)
    report.say(_how(len(surfaces), steps, best.name.removeprefix("PSF, ")))
    report.table(
        [_row(method, truth, layer.maps, indentation_mm) for method in methods],
        f"RMS error over the 40 x 40 window, in % of the indentation; truth is FEM at {meshes[0]}. Mean over "
        "surfaces and steps, in brackets the best and the worst surface. What heaps up around the contact counts as 0, "
        "as no PSF pulls, except in the column that is named so.",
    )
    report.table(_by_step(methods, truth, indentation_mm, force_n), "RMS error by step, in [um].", "steps")
    fem: list[Row] = [
        {
            "mesh": str(mesh),
            "force, % of the finest's": float(100 * (np.stack([one.force_n for one in found]) / force_n).mean()),
            "s a surface": _time_s(found),
        }
        for mesh, found in verdicts.items()
    ]
    report.table(fem, "The finite elements.", "fem")
    with report.figure(size=(11, 4.5)) as figure:
        left, right = figure.subplots(1, 2)
        for method in methods:
            errors = method.rms_mm(truth)
            if errors.any():
                left.plot(indentation_mm, 1e3 * errors.mean(axis=0), ".-", label=method.name)
                percent = float((100 * errors / indentation_mm).mean())
                right.semilogx(1e3 * method.time_s / steps, percent, "o", label=method.name)
        left.set(xlabel="indentation [mm]", ylabel="RMS error [µm]")
        right.set(xlabel="run time [ms a pattern]", ylabel="RMS error [% of the indentation]")
        right.set_ylim(bottom=0)
        left.legend(fontsize=8)
    return report.write()


def _methods(
    surfaces: tuple[str, ...], indentation_mm: NDArray[np.floating], force_n: NDArray[np.floating]
) -> list[Method]:
    """Return the methods that are faster than finite elements, applied to all surfaces."""
    margin = (_PAD_PX - 4 * SCALE) // 2
    depth_mm = np.stack([depth_image(relief(name), CENTRE, _PAD_PX, _PIXEL_MM) for name in surfaces])
    window = slice(margin, _PAD_PX - margin)
    touching = np.repeat(depth_mm[:, None, window, window] < _ON_TOP_MM, len(indentation_mm), axis=1)
    step_mm = indentation_mm.astype(np.float32)
    solver = ContactSolver(Layer(), _PAD_PX, _PIXEL_MM)

    def by_tpsf(i: int) -> Maps:
        return tpsf_pattern(touching[i], step_mm, _PIXEL_MM)

    def by_psf(i: int, beta_mm: float) -> Maps:
        area = torch.from_numpy(touching[i]).float()
        return spread(area, torch.tensor([beta_mm]), _PIXEL_MM).numpy() * step_mm[:, None, None]

    def by_depth(i: int) -> Maps:
        return touching[i] * step_mm[:, None, None]

    def by_force(i: int) -> Maps:
        return touching[i] * force_n[i].astype(np.float32)[:, None, None]

    def by_layer(i: int) -> Maps:
        unit = solver.solve(depth_mm[i : i + 1]).displacement_mm[:, window, window]
        return unit * step_mm[:, None, None]

    return [
        _made("tPSF", by_tpsf, len(surfaces)),
        *(
            _made(f"PSF, beta {beta_mm:g} mm", partial(by_psf, beta_mm=beta_mm), len(surfaces), scaled=True)
            for beta_mm in PSF_BETAS_MM
        ),
        _made("Depth x indentation", by_depth, len(surfaces)),
        _made("Depth x force", by_force, len(surfaces), scaled=True),
        _made("layer", by_layer, len(surfaces)),
    ]


def _made(name: str, make: Callable[[int], Maps], surfaces: int, scaled: bool = False) -> Method:
    maps = np.stack([make(i) for i in range(surfaces)])
    return Method(name, maps, min(repeat(partial(make, 0), number=1)), scaled)


def _time_s(found: list[Verdict]) -> float:
    return float(np.mean([verdict.run_s.sum() for verdict in found]))


def _row(method: Method, truth: Maps, layer: Maps, indentation_mm: NDArray[np.floating]) -> Row:
    percent = 100 * method.rms_mm(truth) / indentation_mm
    by_surface = percent.mean(axis=1)
    pressed = np.maximum(truth, 0)
    psnr = psnr_db(np.maximum(method.against(pressed), 0), pressed, MAX_INDENTATION_MM)
    return {
        "method": method.name,
        "error %": f"{percent.mean():.2f} ({by_surface.min():.2f}..{by_surface.max():.2f})",
        "PSNR dB": float(psnr.mean()) if percent.any() else None,
        "error %, heaps too": float((100 * method.rms_mm(truth, heaps=True) / indentation_mm).mean()),
        "error % to the layer": float((100 * method.rms_mm(layer) / indentation_mm).mean()),
        "ms a pattern": 1e3 * method.time_s / len(indentation_mm),
    }


def _by_step(
    methods: list[Method], truth: Maps, indentation_mm: NDArray[np.floating], force_n: NDArray[np.floating]
) -> list[Row]:
    errors = {method.name: 1e3 * method.rms_mm(truth).mean(axis=0) for method in methods}
    return [
        {
            "indentation mm": float(depth_mm),
            "force N": float(force_n[:, step].mean()),
            **{name: float(error[step]) for name, error in errors.items() if error.any()},
        }
        for step, depth_mm in enumerate(indentation_mm)
    ]


def _how(surfaces: int, steps: int, psf: str) -> str:
    return (
        f"{surfaces} letters at p5 r0, {steps} indentations up to {MAX_INDENTATION_MM} mm, all methods on the same "
        f"touching pixels, gaussian kernel. tPSF: its plateau is the indentation, its beta of {BETA_MM} mm was "
        "fitted to the layer's surface, not to these maps. PSF (no plateau): times the indentation and one alpha for "
        f"all maps, by least squares against the truth it is compared with, and the best of {len(PSF_BETAS_MM)} betas "
        f"against FEM ({psf}). Depth x indentation: the touching pixels at the indentation, sharp. Depth x force, as "
        "the paper has it: one factor fitted in the same way. layer: bonded layer without sides, Polonsky-Keer, "
        f"Poisson's ratio {Layer().poisson:g}. FEM: Mooney-Rivlin, large strain, free sides, Poisson's ratio "
        f"{LAYER.poisson:g}; the nodes of the two finer meshes are the pixels, those of the coarser two lie next "
        "to them, so that a sharp edge is theirs to half a node only. Run times are one process's; FEM's from when it "
        "was worked out."
    )
