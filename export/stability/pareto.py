"""Error against run time: of the simulation, by grid, tolerance and precision; of the networks, by arithmetic."""

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from edge.evaluation.classical_methods import CONTACT_LEVEL, fitted_methods
from edge.evaluation.evaluate import judge, judge_model
from edge.evaluation.test_set import load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, bundled_models
from edge.inference.onnx_session import ModelSession
from export.stability.case import timed
from firmware_bridge.pad_geometry import USPA44
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.resample import resample
from train.physics.taxel_response import Skin
from train.physics.tpsf import tpsf_pattern
from train.report import Row
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, footprints
from train.surfaces.named_surfaces import SURFACES, surface_mesh

SHIPPED: Final = "ships"
_SHIPPED_GRID: Final = (42, 0.47)
"""Grid of train.physics.simulated_sensor: whole cells of a tenth of the pitch, .13 mm short of each rim."""
SIZES: Final = (24, 42, 50, 100, 200)
"""Cells along the pad's 20 mm."""
TOLERANCES: Final = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
SCALES: Final = (4, 6, 8, 10, 20)
_FINEST_TOLERANCE, _FINEST_SCALE = 1e-6, 40
_INDENTATION_MM: Final = 0.3
_LEVEL_MM: Final = 1e-3
_SEED: Final = 5
_RUNS: Final = 5
_TIMED_WINDOWS: Final = 500
_QUICK_ONE_IN: Final = 12
"""Frames of the test set for each one that a quick run takes; every surface stays in it."""
_T = TypeVar("_T")


def simulation(quick: bool = False) -> list[Row]:
    """Return errors of readings of the 18 surfaces by grid, tolerance and precision, against the finest of each."""
    sizes, runs = (SIZES[:3], 1) if quick else (SIZES, _RUNS)
    grids = [(size, USPA44.width_mm / size) for size in sizes]
    true, _ = _readings(*grids[-1], _FINEST_TOLERANCE, torch.float64, runs)
    rows = []
    for size, cell_mm in [*grids, _SHIPPED_GRID]:
        for dtype in (torch.float32, torch.float64):
            found = _readings(size, cell_mm, 1e-3, dtype, runs)
            rows.append(_row("grid", f"{size} x {cell_mm:.3g} mm", dtype, *found, true))
    for tolerance in TOLERANCES:
        for dtype in (torch.float32, torch.float64):
            found = _readings(*_SHIPPED_GRID, tolerance, dtype, runs)
            rows.append(_row("tolerance", f"{tolerance:g}", dtype, *found, true))
    return rows


def truth(quick: bool = False) -> list[Row]:
    """Return errors of the 18 surfaces' patterns made at a scale and resampled to x10, against those made at x40."""
    scales = SCALES[2:4] if quick else SCALES
    true, _ = _patterns(_FINEST_SCALE)
    rows: list[Row] = []
    for scale in scales:
        patterns, run_ms = _patterns(scale)
        at_10 = resample(patterns, scale, 10) if scale > 10 else patterns
        reference = resample(true, _FINEST_SCALE, min(scale, 10))
        rows.append(
            {
                "series": "truth's grid",
                "setting": f"x{scale}",
                "precision": "float32",
                "error %": _percent(at_10, reference),
                "ms a pose": run_ms,
                "note": SHIPPED if scale == 20 else "",
            }
        )
    return rows


def finite_elements(reports: Path) -> list[Row]:
    """Return fig7's results for the meshes, if its report exists."""
    page = reports / "fig7.csv"
    if not page.exists():
        return []
    with page.open(newline="") as file:
        found = [
            row for row in csv.DictReader(file) if row["method"].startswith("FEM") and row["PSNR dB"] not in ("", "-")
        ]
    return [
        {
            "series": "finite elements",
            "setting": row["method"].removeprefix("FEM "),
            "precision": "float64",
            "error %": float(row["error %"].split()[0]),
            "ms a pose": float(row["ms a pattern"]),
            "note": "referee only",
        }
        for row in found
    ]


def networks(quick: bool = False) -> list[Row]:
    """Return PSNR on the frozen test set and run time back to back, of bundled models and classical methods."""
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    frozen = frozen.thinned(_QUICK_ONE_IN) if quick else frozen
    windows = 20 if quick else _TIMED_WINDOWS
    newest = frozen.newest.astype(np.float32)
    rows: list[Row] = []
    for name, method in fitted_methods(BUNDLE_DIR / "classical.npz", frozen.scale).items():
        errors = judge(method(newest), frozen, CONTACT_LEVEL)
        p50_us = _p50_us(lambda i, method=method: method(newest[[i % len(newest)]]), windows)
        rows.append(
            {"method": name, "arithmetic": "float32", "PSNR dB": float(errors["psnr_db"].mean()), "p50 us": p50_us}
        )
    for path in bundled_models():
        session = ModelSession(path)
        scaled = [session.contract.scale_window(window) for window in frozen.windows(session.contract.taps)[:64]]
        psnr_db = float(judge_model(session, frozen)["psnr_db"].mean())
        p50_us = _p50_us(lambda i, session=session, scaled=scaled: session.run(scaled[i % len(scaled)]), windows)
        arithmetic = session.contract.arithmetic
        rows.append({"method": session.name, "arithmetic": arithmetic, "PSNR dB": psnr_db, "p50 us": p50_us})
    return rows


def _row(
    series: str, setting: str, dtype: torch.dtype, counts: NDArray[np.float64], run_ms: float, true: NDArray[np.float64]
) -> Row:
    ships = dtype is torch.float32 and setting in ("42 x 0.47 mm", "0.001")
    return {
        "series": series,
        "setting": setting,
        "precision": str(dtype).removeprefix("torch."),
        "error %": _percent(counts, true),
        "ms a pose": run_ms,
        "note": SHIPPED if ships else "",
    }


def _poses() -> list[Pose]:
    rng = np.random.default_rng(_SEED)
    return [Pose(*rng.uniform(-2, 2, 2), angle_deg=float(rng.uniform(0, 90))) for _ in SURFACES]


def _readings(
    size: int, cell_mm: float, tolerance: float, dtype: torch.dtype, runs: int
) -> tuple[NDArray[np.float64], float]:
    """Return counts of one press of every surface, and the contact's shortest run time for each in [ms]."""
    layer = Layer()
    seen = footprints([Relief(name, surface_mesh(name)) for name in SURFACES], _poses(), size, cell_mm)
    cover = seen.cover_on(size, cell_mm, np.arange(len(SURFACES)), _LEVEL_MM)
    depth_mm = np.where(cover > 0, 0, NOTHING_MM)
    solver = ContactSolver(layer, size, cell_mm, dtype)
    skin = Skin(USPA44, layer, size, cell_mm)
    found, best_ms = _fastest(lambda: solver.solve(depth_mm, _INDENTATION_MM, tolerance, cover=cover), runs)
    return skin.frames(found.pressure_mpa[:, None])[:, 0].astype(np.float64), best_ms


def _patterns(scale: int) -> tuple[NDArray[np.float32], float]:
    """Return the truth of every surface at a scale, and its shortest run time for each in [ms]."""
    size, pixel_mm = USPA44.rows * scale, USPA44.pixel_pitch_mm(scale)
    coarse_mm = USPA44.pixel_pitch_mm(10)
    seen = footprints([Relief(name, surface_mesh(name)) for name in SURFACES], _poses(), 42, coarse_mm)
    touching = seen.depth_on(size, pixel_mm, np.arange(len(SURFACES))) <= _LEVEL_MM
    depth_mm = np.full(len(SURFACES), _INDENTATION_MM, dtype=np.float32)
    return _fastest(lambda: tpsf_pattern(touching, depth_mm, pixel_mm), _RUNS)


def _fastest(work: Callable[[], _T], runs: int) -> tuple[_T, float]:
    """Return the result of some work on all surfaces, and its shortest run time for each of them, in [ms]."""
    given, run_ms = zip(*(timed(work) for _ in range(runs)), strict=True)
    return given[-1], min(run_ms) / len(SURFACES)


def _percent(found: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    """Return the RMS error in [%] of the truth's RMS."""
    return 100 * float(np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)))


def _p50_us(run: Callable[[int], object], windows: int) -> float:
    took_ns = np.empty(windows)
    for number in range(windows):
        start_ns = time.perf_counter_ns()
        run(number)
        took_ns[number] = time.perf_counter_ns() - start_ns
    return float(np.median(took_ns) / 1e3)
