"""Taps that the runtime proposes, next to taps of a fixed schedule on the same figures.

The patterns are those of the first tap, which all schedules share; the other taps are given in its axes. The poses that
may be proposed were chosen on other figures, by a fusion without a network (docs/decisions.md).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.perception.next_tap import NextTapFinder
from edge.terminal.progress_bar import tracked
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED, one_thread
from train.data.posed_batches import stated_poses
from train.data.presses import join_presses
from train.data.world import LEAST_FORCE_N, press_shapes
from train.errors import DatasetError
from train.experiments.sensor.posed_taps import MODEL
from train.experiments.support.shipped import NOTHING, infer, known_pads
from train.experiments.support.workbench import Workbench
from train.families.catalogue import FIGURES, draw_shape
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import draw_pad
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval
from train.surfaces.tap_schedules import SCHEDULES

_SEED: Final = 2_000_005
_PADS: Final = 30
_PER_PAD: Final = 10
_TAPS: Final = 4
_USUAL: Final = (PLACE_ERROR_MM, TURN_ERROR_DEG)
_FIXED: Final = ("turns", "half-pitch")
"""Schedules for comparison: the paper's, and shifts by half a pitch in random order."""


def run(bench: Workbench, folder: Path) -> Path:
    """Propose taps by the model that takes poses, and write the report `proposed-taps`."""
    model = ModelSession(bench.use(bench.models / f"{MODEL}.onnx"))
    if (trust := model.contract.read_trust()) is None:
        raise DatasetError(f"model '{model.name}' has no forward model, by which taps are proposed")
    finder = NextTapFinder(trust.forward, model.contract.reach_mm)
    pads = _Pads(2 if bench.quick else _PADS, 3 if bench.quick else _PER_PAD)
    sets = {name: pads.press(_drawn(name, len(pads))) for name in tracked(_FIXED, "pressing", "schedule")}
    sets = {"proposed": pads.press(_proposed(model, finder, pads))} | sets
    first = sets["turns"].presses
    kept = (first.force_n[:, 2] > LEAST_FORCE_N) & first.touching.any(axis=(1, 2))
    sets = {name: one.pick(kept) for name, one in sets.items()}
    report = Report("proposed-taps", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"`{model.name}` (training {model.contract.training_sha256[:12]}), {int(kept.sum())} figures that nothing was "
        f"trained on, {len(pads) // pads.per_pad} pads of their own (seed {_SEED}); all nuisances, gains N(1, .075), "
        f"poses off by {PLACE_ERROR_MM} mm and {TURN_ERROR_DEG:g} degree. PSNR in dB of the first tap's pattern, which "
        "all schedules share, with further taps; paired, 95 % intervals by figure. Each proposal is the runtime's, "
        "from the readings of the taps before. Run time: median of a pattern, one thread."
    )
    report.table(_rows(model, sets), "Taps by schedule.", "schedules")
    return report.write()


class _Pads:
    """Figures, each on one of several pads; `press` taps them from other poses, all else equal."""

    def __init__(self, count: int, per_pad: int) -> None:
        self.per_pad = per_pad
        drawn = [draw_pad(np.random.default_rng([_SEED, number]), 1.0) for number in range(count)]
        self._pads = [GrippedPad(pad) for pad in drawn]

    def __len__(self) -> int:
        return len(self._pads) * self.per_pad

    @one_thread()
    def press(self, poses: NDArray[np.float64]) -> FrozenPresses:
        """Return the readings of taps from poses (n, K, 3) in the first one's axes; sensors are the same each time."""
        made = []
        for number, pad in enumerate(self._pads):
            rows = range(number * self.per_pad, (number + 1) * self.per_pad)
            families = np.array([FIGURES[1 + row % (len(FIGURES) - 1)] for row in rows])
            tapped = [
                draw_shape(np.random.default_rng([_SEED, 1, row]), str(family), pad, poses[row])
                for row, family in zip(rows, families, strict=True)
            ]
            made.append(press_shapes(np.random.default_rng([_SEED, 2, number]), pad, families, tapped, number))
        return freeze_presses(join_presses(made), SEED)


def _drawn(schedule: str, count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng([_SEED, 3])
    return np.stack([SCHEDULES[schedule](rng, _TAPS) for _ in range(count)])


def _proposed(model: ModelSession, finder: NextTapFinder, pads: _Pads) -> NDArray[np.float64]:
    """Return poses (n, K, 3) in the first tap's axes, each proposed after the readings of those before."""
    poses = np.zeros((len(pads), _TAPS, 3))
    for taps in tracked(range(1, _TAPS), "proposing", "tap"):
        readings = pads.press(poses).presses.counts[:, :taps][:, ::-1]
        seen = (poses[:, :taps] - poses[:, taps - 1 : taps])[:, ::-1]  # no proposal is turned
        stated = stated_poses(np.random.default_rng([SEED, taps]), seen.astype(np.float32), _USUAL)
        for row, (window, rows) in enumerate(zip(readings, stated, strict=True)):
            model.run(model.contract.scale_window(np.ascontiguousarray(window)), poses=rows)
            found = None if model.deviation is None else finder(rows, model.deviation)
            if found is None:
                raise DatasetError(f"nothing proposed after {taps} taps, expected a pose within the model's reach")
            poses[row, taps] = poses[row, taps - 1] + (found.dx_mm, found.dy_mm, found.turn_deg)
    return poses


def _rows(model: ModelSession, sets: Mapping[str, FrozenPresses]) -> list[Row]:
    each, rows = np.arange(len(sets["proposed"])), list[Row]()
    for taps in range(1, _TAPS + 1):
        found: dict[str, NDArray[np.float64]] = {}
        times_us: dict[str, float] = {}
        for name, one in sets.items():
            poses = stated_poses(np.random.default_rng(SEED), one.presses.poses[:, :taps], _USUAL)
            done = infer(model, one.windows(taps), known_pads(one, NOTHING), poses)
            found[name] = psnr_db(done.patterns, one.patterns(), MAX_INDENTATION_MM)
            times_us[name] = done.run_time_us
        row: Row = {"taps": taps}
        row |= {f"{name} dB": with_interval(psnr, each) for name, psnr in found.items()}
        for name in _FIXED:
            row[f"proposed over {name}"] = None if taps == 1 else with_interval(found["proposed"] - found[name], each)
        rows.append(row | {"run time us": round(times_us["proposed"])})
    return rows
