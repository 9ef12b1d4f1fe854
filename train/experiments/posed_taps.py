"""Taps from known poses: one to seven, by schedule, with wrong poses, and by the paper's schedule without any.

No choice depended on these presses: network and limits were settled on other pads and figures.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.inference.onnx_session import ModelSession
from edge.perception.trust_check import NOT_OF_IT, PatternCheck
from edge.terminal.progress_bar import tracked
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.press_batches import stated_poses
from train.data.presses import SEED, PressSet
from train.data.world import World
from train.experiments.workbench import Workbench, infer, known_pads, name_of
from train.families.catalogue import FIGURES, SHARES
from train.physics.gripped import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval
from train.surfaces.poses import MAX_TAPS

SCHEDULES: Final = ("half-pitch", "near", "turns", "slide")
# The paper's own comparison: its figures, the nominal pad, turned by 5 degrees (Wu and Liu 2024, Fig. 13).
PAPER: Final = World(
    count=720, taps=MAX_TAPS, schedule="turns", begun=0.0, families={"paper": 1.0}, spread=0.0, seed=2_000_029
)
USUAL: Final = (PLACE_ERROR_MM, TURN_ERROR_DEG)  # errors of poses, in [mm] and [deg], where a robot states none
_WINDOW: Final = 4


def posed_taps(bench: Workbench, report: Report) -> None:
    """Evaluate the model that takes poses, by schedule and number of taps."""
    model = bench.model(POSED_MODEL)
    sets = {name: freeze_presses(presses_of(bench, name, figures=True), SEED) for name in SCHEDULES}
    report.say(
        f"{name_of(model)} through the runtime's session. Figures that "
        "nothing was trained on, on pads of their own, presses of 0.03 to 0.5 mm, seven taps each: "
        + "; ".join(f"{name} {len(one)} (sha256 {one.presses.sha256()[:12]})" for name, one in sets.items())
        + f". All nuisances, gains N(1, 0.075); stated and true errors of the poses {PLACE_ERROR_MM} mm and "
        f"{TURN_ERROR_DEG:g} degree. PSNR in dB, full scale {MAX_INDENTATION_MM} mm; gains are over the same model "
        "with the newest tap alone, paired, 95 % intervals by figure. Run time of the model: median of a scan, one "
        "thread."
    )
    rows = [row for name, one in tracked(sets.items(), "taps", "set") for row in _posed(model, name, one)]
    report.table(rows, "By schedule and number of taps, nothing known of pad and gains.")
    rows = [row for name in SCHEDULES[:3] for row in _posed(model, name, sets[name], (1, 4, 7), known=True)]
    report.table(rows, "The same with the pad's constants and the gains known.")
    wide = freeze_presses(presses_of(bench, "mixed", figures=False), SEED)
    report.table(
        _posed(model, "mixed", wide, (1, 2, 4, 7)),
        f"Every family, as many presses of each ({len(wide)}, sha256 {wide.presses.sha256()[:12]}), in schedules of "
        "all kinds.",
    )
    report.table(
        _wrong(model, sets["near"]),
        f"{_WINDOW} taps near the newest one, whose poses are all off by so much in a random direction; stated: the "
        "model gets the size of the error. As in the runtime, taps are left out that do not belong by the readings and "
        "the stated poses.",
    )
    paper = freeze_presses(bench.presses("paper", PAPER, quick_taps=MAX_TAPS), SEED)
    text = f"Several taps over one in the paper's own comparison ({len(paper)} sequences), no poses stated."
    ways = [(bench.model(DEFAULT_MODEL), 1), *((model, taps) for taps in (2, 4, MAX_TAPS))]
    report.table(_rows({}, ways, paper), text)


def presses_of(bench: Workbench, schedule: str, *, figures: bool) -> PressSet:
    """Return the presses of a schedule, of unseen figures or of every family, that these reports evaluate on."""
    families = dict.fromkeys(FIGURES[1:] if figures else SHARES, 1.0)
    seed = 2_000_003 if figures else 2_000_004
    world = replace(PAPER, count=420, schedule=schedule, per_pad=10, families=families, spread=1.0, seed=seed)
    return bench.presses(f"test-{schedule}", world, quick_taps=MAX_TAPS)


def _posed(
    model: ModelSession,
    schedule: str,
    frozen: FrozenPresses,
    numbers: Sequence[int] = (1, 2, 3, 4, 7),
    *,
    known: bool = False,
) -> list[Row]:
    poses = stated_poses(np.random.default_rng(SEED), frozen.presses.poses, USUAL)
    return _rows({"schedule": schedule}, [(model, taps) for taps in numbers], frozen, known, poses)


def _rows(
    head: Row,
    ways: Sequence[tuple[ModelSession, int]],
    frozen: FrozenPresses,
    known: bool = False,
    poses: NDArray[np.float32] | None = None,
) -> list[Row]:
    """Return a row for each model and number of taps, with its gain over the first one, which has one tap."""
    each, rows = np.arange(len(frozen)), list[Row]()
    alone = np.empty(0)
    for model, taps in ways:
        found, run_time_us = _psnr(model, frozen, taps, known, poses)
        alone = alone if rows else found
        row: Row = head | {"model": model.name, "taps": taps, "PSNR dB": with_interval(found, each)}
        row["over one tap"] = with_interval(found - alone, each) if rows else None
        for text, least_db in (("worse than one tap %", 0), ("by over 1 dB %", 1)):
            worse = 100 * float((found < alone - least_db).mean())
            row[text] = round(worse) if rows else None
        rows.append(row | {"run time us": run_time_us})
    return rows


def _wrong(model: ModelSession, frozen: FrozenPresses) -> list[Row]:
    true, each = frozen.presses.poses[:, :_WINDOW], np.arange(len(frozen))
    alone, _ = _psnr(model, frozen, 1, False, stated_poses(np.random.default_rng(SEED), true[:, :1], (0, 0)))
    rows: list[Row] = []
    for error_mm, error_deg in ((0.2, 0.0), (0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 3.0), (0.0, 5.0)):
        row: Row = {"off mm": error_mm, "off deg": error_deg}
        for name, stated in (("stated", (error_mm, error_deg)), ("not stated", USUAL)):
            poses = _off(true, (error_mm, error_deg), stated)
            windows, left_out = _guarded(model, frozen.windows(_WINDOW), poses)
            done = infer(model, windows, known_pads(frozen, False), np.where(left_out[..., None], 0, poses))
            found = psnr_db(done.patterns, frozen.patterns(), MAX_INDENTATION_MM)
            row[f"over one tap, {name}"] = with_interval(found - alone, each)
            row[f"left out %, {name}"] = round(100 * float(left_out[:, 1:].mean()), 1)
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
    model: ModelSession, frozen: FrozenPresses, taps: int, known: bool, poses: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float64], int]:
    """Return the PSNR (n,) with so many taps, at these poses or by the paper's schedule, and the run time in [us]."""
    given = None if poses is None else poses[:, :taps]
    done = infer(model, frozen.windows(taps), known_pads(frozen, known), given)
    return psnr_db(done.patterns, frozen.patterns(), MAX_INDENTATION_MM), round(done.run_time_us)
