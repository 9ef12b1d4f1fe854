"""Taps from known poses: one to seven, by schedule, next to a linear map of the same taps, and with wrong poses.

No choice depended on these presses: network and limits were settled on other pads and figures.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.perception.pattern_check import NOT_OF_IT, PatternCheck
from edge.terminal.progress_bar import tracked
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED
from train.data.make_presses import make_presses
from train.data.posed_batches import stated_poses
from train.data.presses import PressSet
from train.data.world import World
from train.experiments.support import linear_taps
from train.experiments.support.linear_taps import LinearTaps, fit_linear_taps
from train.experiments.support.shipped import ALL, NOTHING, infer, known_pads
from train.experiments.support.workbench import Workbench
from train.families.catalogue import FIGURES, SHARES
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval
from train.surfaces.poses import MAX_TAPS

MODEL: Final = "mtsr7-int8"
SCHEDULES: Final = ("half-pitch", "near", "turns", "slide")
LINEAR_ON: Final = World(count=40_000, taps=4, seed=3)
"""Settings of data/taps4.npz in the Makefile, on which the linear map is fitted."""
_COUNT: Final = 420
_SEED: Final = 2_000_003
USUAL: Final = (PLACE_ERROR_MM, TURN_ERROR_DEG)
"""Errors of poses, in [mm] and [deg], where a robot states none."""
_OFF: Final = ((0.2, 0.0), (0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 3.0), (0.0, 5.0))
"""Errors of every earlier tap's pose in the rows on robustness, in [mm] and [deg]."""
_SHOWN: Final = (1, 2, 3, 4, 7)
_WINDOW: Final = 4


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the model that takes poses and write the report `posed-taps`."""
    model = ModelSession(bench.use(bench.models / f"{MODEL}.onnx"))
    fitted_on = bench.presses("taps4", LINEAR_ON, quick_taps=4)
    linear = {name: fit_linear_taps(fitted_on, name) for name in linear_taps.SCHEDULES}
    sets = {name: freeze_presses(presses_of(bench, name, figures=True), SEED) for name in SCHEDULES}
    report = Report("posed-taps", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"`{model.name}` (training {model.contract.training_sha256[:12]}) through the runtime's session. Figures that "
        "nothing was trained on, on pads of their own, presses to .03 to .5 mm, seven taps each: "
        + "; ".join(f"{name} {len(one)} (sha256 {one.presses.sha256()[:12]})" for name, one in sets.items())
        + f". All nuisances, gains N(1, .075); stated and true errors of the poses {PLACE_ERROR_MM} mm and "
        f"{TURN_ERROR_DEG:g} degree. PSNR in dB, full scale {MAX_INDENTATION_MM} mm; gains are over the same model "
        "with the newest tap alone, paired, 95 % intervals by figure. The linear map knows the places of a schedule "
        "alone. Run time of the model: median of a scan, one thread."
    )
    rows = [
        row
        for name, one in tracked(sets.items(), "taps", "set")
        for row in _rows(model, name, one, NOTHING, linear=linear.get(name))
    ]
    report.table(rows, "By schedule and number of taps, nothing known of pad and gains.", "schedules")
    known = [row for name in SCHEDULES[:3] for row in _rows(model, name, sets[name], ALL, (1, 4, 7))]
    report.table(known, "The same with the pad's constants and the gains known.", "known")
    wide = freeze_presses(presses_of(bench, "mixed", figures=False), SEED)
    report.table(
        _rows(model, "mixed", wide, NOTHING, (1, 2, 4, 7)),
        f"Every family, as many presses of each ({len(wide)}, sha256 {wide.presses.sha256()[:12]}), in schedules of "
        "all kinds.",
        "families",
    )
    begun = {name: presses_of(bench, name, figures=True, begun=1.0) for name in SCHEDULES}
    light = {name: freeze_presses(presses, SEED) for name, presses in begun.items()}
    rows = [row for name, one in light.items() for row in _rows(model, name, one, NOTHING, (1, 4, 7))]
    report.table(rows, "The newest press has only begun, at a fifth of the earlier ones' depth and more.", "begun")
    report.table(
        _wrong(model, sets["near"]),
        f"{_WINDOW} taps near the newest one, whose poses are all off by so much in a random direction; stated: the "
        "model gets the size of the error; guarded: as in the runtime, taps are left out that do not belong by the "
        "readings and the stated poses.",
        "wrong-poses",
    )
    return report.write()


def presses_of(bench: Workbench, schedule: str, *, figures: bool, begun: float = 0.0) -> PressSet:
    """Return the presses of a schedule, of unseen figures or of every family, that these reports evaluate on."""
    families = dict.fromkeys(FIGURES[1:] if figures else SHARES, 1.0)
    world = World(
        count=_COUNT,
        taps=MAX_TAPS,
        schedule=schedule,
        begun=begun,
        per_pad=10,
        families=families,
        seed=_SEED + (not figures),
    )
    name = f"test-{schedule}" + ("-begun" if begun else "")
    if bench.quick:
        name, world = f"quick-{name}", replace(world, count=8, per_pad=4)
    bench.data_folder.mkdir(parents=True, exist_ok=True)
    return make_presses(world, bench.data_folder / f"{name}.npz")


def _rows(
    model: ModelSession,
    schedule: str,
    frozen: FrozenPresses,
    known: str,
    numbers: tuple[int, ...] = _SHOWN,
    linear: LinearTaps | None = None,
) -> list[Row]:
    """Return a row for each number of taps."""
    poses = stated_poses(np.random.default_rng(SEED), frozen.presses.poses, USUAL)
    each, alone = np.arange(len(frozen)), _psnr(model, frozen, poses[:, :1], known)[0]
    rows: list[Row] = []
    for taps in numbers:
        found, run_time_us = _psnr(model, frozen, poses[:, :taps], known)
        row: Row = {"schedule": schedule, "taps": taps, "model dB": with_interval(found, each)}
        row["over one tap"] = None if taps == 1 else with_interval(found - alone, each)
        if linear is not None and taps in linear.matrices:
            mapped = linear(frozen.windows(taps), poses[:, :taps])
            row["linear map dB"] = round(float(psnr_db(mapped, frozen.patterns(), MAX_INDENTATION_MM).mean()), 2)
        rows.append(row | {"run time us": round(run_time_us)})
    return rows


def _wrong(model: ModelSession, frozen: FrozenPresses) -> list[Row]:
    true, each = frozen.presses.poses[:, :_WINDOW], np.arange(len(frozen))
    alone = _psnr(model, frozen, stated_poses(np.random.default_rng(SEED), true[:, :1], (0, 0)), NOTHING)[0]
    rows: list[Row] = []
    for error_mm, error_deg in _OFF:
        row: Row = {"off mm": error_mm, "off deg": error_deg}
        for name, stated in (("stated", (error_mm, error_deg)), ("not stated", USUAL)):
            poses = _off(true, (error_mm, error_deg), stated)
            found, run_time_us = _psnr(model, frozen, poses, NOTHING)
            row |= {f"over one tap, {name}": with_interval(found - alone, each), "run time us": round(run_time_us)}
            if stated is USUAL:
                windows, left_out = _guarded(model, frozen.windows(_WINDOW), poses)
                done = infer(model, windows, known_pads(frozen, NOTHING), np.where(left_out[..., None], 0, poses))
                found = psnr_db(done.patterns, frozen.patterns(), MAX_INDENTATION_MM)
                row |= {
                    "over one tap, not stated, guarded": with_interval(found - alone, each),
                    "left out %": round(100 * float(left_out[:, 1:].mean()), 1),
                }
        rows.append(row)
    return rows


def _guarded(
    model: ModelSession, windows: NDArray[np.float32], poses: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return windows (n, K, 3, rows, cols) without the taps that do not belong, and which these are, (n, K)."""
    left_out = np.zeros(windows.shape[:2], dtype=bool)
    if (trust := model.contract.read_trust()) is not None:
        check = PatternCheck(trust, model.contract)
        for number, (window, rows) in enumerate(zip(windows, poses, strict=True)):
            belonging = check.belonging(model.contract.scale_window(window), len(window), rows)
            left_out[number, 1:] = np.array(belonging) >= NOT_OF_IT
    return np.where(left_out[..., None, None, None], np.float32(0), windows), left_out


def _off(true: NDArray[np.float32], error: tuple[float, float], stated: tuple[float, float]) -> NDArray[np.float32]:
    """Return poses (n, K, 5) of which every earlier one is off by an error in a random direction."""
    rng = np.random.default_rng(SEED)
    way, sign = rng.uniform(0, 2 * np.pi, true.shape[:2]), rng.choice([-1, 1], true.shape[:2])
    off = np.stack([error[0] * np.cos(way), error[0] * np.sin(way), error[1] * sign], axis=2)
    poses = np.concatenate([true + off, np.broadcast_to(stated, (*true.shape[:2], 2))], axis=2)
    poses[:, 0] = 0
    return poses.astype(np.float32)


def _psnr(
    model: ModelSession, frozen: FrozenPresses, poses: NDArray[np.float32], known: str
) -> tuple[NDArray[np.float64], float]:
    """Return the PSNR (n,) of the newest taps with these poses, and the run time of one."""
    done = infer(model, frozen.windows(poses.shape[1]), known_pads(frozen, known), poses)
    return psnr_db(done.patterns, frozen.patterns(), MAX_INDENTATION_MM), done.run_time_us
