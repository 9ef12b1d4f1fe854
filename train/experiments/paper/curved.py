"""Curved surfaces: several PSFs by height compared with one PSF, finite elements and the layer.

Source: Wu and Liu 2024, Section VII, as future work.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db, rmse_percent
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.experiments.support.workbench import Workbench
from train.physics.contact import ContactSolver
from train.physics.curved_patterns import PLANES, heights_pattern
from train.physics.elastic_layer import Layer
from train.physics.fem_cache import CENTRE, FINEST, SCALE, Mesh, press_or_recall, relief
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.physics.tpsf import tpsf_pattern
from train.report import Report, Row
from train.surfaces.depth_image import depth_image

SURFACES: Final = ("sphere:10", "cylinder:10")
STEPS: Final = 5
MESHES: Final = (FINEST, Mesh(7, 6))
_QUICK_MESHES: Final = (Mesh(4, 2), Mesh(3, 2))
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(SCALE)
_PAD_PX: Final = 42
_TIMED_RUNS: Final = 5

Maps = NDArray[np.float32]
"""Maps (steps, 40, 40) in [mm]."""


@dataclass(frozen=True, slots=True)
class _Press:
    """One surface pressed in step by step, as computed by the layer."""

    indentation_mm: NDArray[np.float32]
    depth_mm: Maps
    touching: NDArray[np.bool_]
    surface_mm: Maps
    contact_s: float


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `curved`; finite elements are kept in the data folder.

    The full run takes about ten minutes, nearly all of it for the finite elements.
    """
    meshes = _QUICK_MESHES if bench.quick else MESHES
    steps = 2 if bench.quick else STEPS
    indentation_mm = np.linspace(MAX_INDENTATION_MM / steps, MAX_INDENTATION_MM, steps)
    report = Report("curved", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Surfaces at p5 r0; which pixels touch is the layer's answer, the same for all methods. One PSF: tPSF, its "
        f"plateau at the indentation. One PSF, heights: the surface's own height where it touches, and one PSF around "
        f"it. Several: so, with up to {PLANES} planes by height, each with a PSF of its own. Errors are "
        "RMS over the 40 x 40 window in % of the indentation, mean over the steps; what heaps up around the contact "
        "counts as 0 in the first column, as no PSF pulls, and as it is in the second. "
        f"Truth is FEM at {meshes[0]}."
    )
    rows: list[Row] = []
    with report.figure(size=(11, 4.5)) as figure:
        for axes, surface in zip(figure.subplots(1, len(SURFACES)), tracked(SURFACES, "FEM", "surface"), strict=True):
            truth, *coarser = [press_or_recall(surface, mesh, indentation_mm, bench.data_folder) for mesh in meshes]
            press = _press(surface, indentation_mm.astype(np.float32))
            found = _patterns(press)
            found["layer"] = (press.surface_mm, press.contact_s)
            for mesh, verdict in zip(meshes[1:], coarser, strict=True):
                found[f"FEM {mesh}"] = (verdict.patterns_mm, float(verdict.run_s.sum()))
            rows += [_row(surface, name, *made, truth.patterns_mm, press) for name, made in found.items()]
            rows.append(
                {"surface": surface, "method": f"FEM {meshes[0]}", "ms a pattern": 1e3 * float(truth.run_s.mean())}
            )
            place_mm = (np.arange(4 * SCALE) - (4 * SCALE - 1) / 2) * _PIXEL_MM
            axes.plot(place_mm, truth.patterns_mm[-1, 2 * SCALE], "k", label=f"FEM {meshes[0]}")
            for name in ("one PSF", "several PSFs", "layer"):
                axes.plot(place_mm, found[name][0][-1, 2 * SCALE], label=name)
            axes.set(title=surface, xlabel="x [mm]", ylabel=f"pressed in [mm], at {indentation_mm[-1]} mm")
            axes.invert_yaxis()
            axes.legend(fontsize=8)
    report.say("\n".join(_verdict(surface, rows) for surface in SURFACES))
    report.table(rows, "Error and run time.")
    return report.write()


def _verdict(surface: str, rows: list[Row]) -> str:
    error, time_ms = (
        {str(row["method"]): float(str(row[column])) for row in rows if row["surface"] == surface and column in row}
        for column in ("error %", "ms a pattern")
    )
    one, follows, several = "one PSF", "one PSF, heights", "several PSFs"
    return (
        f"- {surface}: one PSF {error[one]:.2f} %, one that follows the heights {error[follows]:.2f} %, several "
        f"{error[several]:.2f} %; several take {time_ms[several] / time_ms[one]:.1f} times as long as one."
    )


def _press(surface: str, indentation_mm: NDArray[np.float32]) -> _Press:
    margin = (_PAD_PX - 4 * SCALE) // 2
    window = slice(margin, _PAD_PX - margin)
    depth_mm = np.repeat(depth_image(relief(surface), CENTRE, _PAD_PX, _PIXEL_MM)[None], len(indentation_mm), axis=0)
    solver = ContactSolver(Layer(), _PAD_PX, _PIXEL_MM)
    start = perf_counter()
    contact = solver.solve(depth_mm, indentation_mm)
    surface_mm = contact.displacement_mm
    contact_s = perf_counter() - start
    touching = contact.pressure_mpa > 0
    return _Press(
        indentation_mm,
        depth_mm[:, window, window],
        touching[:, window, window],
        surface_mm[:, window, window],
        contact_s,
    )


def _patterns(press: _Press) -> dict[str, tuple[Maps, float]]:
    """Return patterns by one PSF and by several, each with the time of all steps together in [s]."""

    def by_one() -> Maps:
        return tpsf_pattern(press.touching, press.indentation_mm, _PIXEL_MM)

    def by_several() -> Maps:
        return heights_pattern(press.depth_mm, press.touching, press.indentation_mm, _PIXEL_MM)

    def by_one_that_follows() -> Maps:
        return heights_pattern(press.depth_mm, press.touching, press.indentation_mm, _PIXEL_MM, planes=1)

    made = {"one PSF": by_one, "one PSF, heights": by_one_that_follows, "several PSFs": by_several}
    return {name: (make(), _time_s(make)) for name, make in made.items()}


def _time_s(make: Callable[[], Maps]) -> float:
    times = []
    for _ in range(_TIMED_RUNS):
        start = perf_counter()
        make()
        times.append(perf_counter() - start)
    return min(times)


def _row(surface: str, name: str, maps: Maps, time_s: float, truth: Maps, press: _Press) -> Row:
    share = press.indentation_mm / 100
    pressed, heaped = np.maximum(maps, 0), np.maximum(truth, 0)
    return {
        "surface": surface,
        "method": name,
        "error %": float((rmse_percent(pressed, heaped, 100.0) / share).mean()),
        "error %, heaps too": float((rmse_percent(maps, truth, 100.0) / share).mean()),
        "error % to the layer": float((rmse_percent(pressed, np.maximum(press.surface_mm, 0), 100.0) / share).mean()),
        "PSNR dB": float(psnr_db(pressed, heaped, MAX_INDENTATION_MM).mean()),
        "ms a pattern": 1e3 * time_s / len(maps),
    }
