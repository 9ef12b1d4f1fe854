"""Patterns by a non-negative pressure that explains the readings, through a pad's operators: a peer without training.

The pressure p >= 0 is in the newest tap's axes, and earlier taps see it at their poses. Traction is slip, in proportion
to pressure by one vector for each tap, and a free part that is marginalised: it widens the covariance of the readings.
The pressure, by accelerated projected gradients (Beck and Teboulle 2009), and the slips, by least squares, take turns.
"""

from dataclasses import replace
from functools import partial
from time import process_time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_gain
from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import POSED_MODEL
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import GAIN_SPREAD
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.press_batches import stated_poses
from train.data.presses import SEED
from train.experiments.posed_taps import PAPER, USUAL, presses_of
from train.experiments.second_world import SEEDS, draw_presses
from train.experiments.workbench import Workbench, infer, known_pads, name_of
from train.families.catalogue import FIGURES
from train.physics.contact import BARE, ContactSolver
from train.physics.gripped import MAX_INDENTATION_MM, SCALE, GrippedPad
from train.physics.pad_draws import Pad
from train.report import Report, Row, with_interval

_Array = NDArray[np.floating]
_SIDE: Final = 21  # cells along a side of the pad
_WIDE: Final = 27  # with those beside it, which earlier taps may see
_ROUNDS, _STEPS = 4, 150
_SMALL_MPA: Final = 1e-3  # load in proportion to which a pad reads
_NOISE_COUNTS: Final = 6.0
_SPREAD, _FREE = 3.0, 0.3  # deviations of a cell's pressure and free traction over the mean pressure
_MOST_SLIP: Final = 1.2
_KNOWN_GAIN_ERROR: Final = 0.02  # that of the operators, where gains are known
_SEED: Final = 8_200_201


def nonnegative(bench: Workbench, report: Report) -> None:
    """Compare a non-negative pressure by a pad's operators with the model that takes poses, for one tap and four."""
    model = bench.model(POSED_MODEL)
    figures = dict.fromkeys(FIGURES[1:], 1.0)
    half_pitch = replace(PAPER, schedule="half-pitch", families=figures, spread=1.0)
    world = replace(half_pitch, count=60, taps=4, per_pad=10, seed=_SEED)
    fitted = freeze_presses(bench.presses("nonnegative", world, quick_taps=4), _SEED)
    test = freeze_presses(presses_of(bench, "half-pitch", figures=True), SEED)
    sensors, presses = (2, 6) if bench.quick else (24, 12)
    other, second = (draw_presses(seed, sensors, presses, taps=4).frozen for seed in SEEDS)
    other = other.pick(np.arange(len(other)) % 3 == 0)
    report.say(
        f"{name_of(model)} through the runtime's session, and the inverse of `train/experiments/nonnegative.py`, by "
        f"one tap and by four half a pitch apart: {len(test)} figures, those of [posed-taps](posed-taps.md), and "
        f"{len(second)} presses of the [second world](second-world.md), half of that page's. All nuisances. Nothing "
        "known: operators of the nominal pad; else those of the constants of a sensor file, and gains. Each row has a "
        f"factor, fitted on presses of other pads of its world ({len(fitted)} and {len(other)}). PSNR in dB, full "
        f"scale {MAX_INDENTATION_MM} mm, 95 % intervals by pad; gains are over one tap, press by press. Run time: "
        "mean processor time of a scan, one thread."
    )
    rows: list[Row] = []
    cases = [("training's", False, fitted, test), ("training's", True, fitted, test), ("second", False, other, second)]
    for name, known, some, every in tracked(cases, "comparing", "case"):
        ways = {model.name: partial(_by_model, model, known), "non-negative pressure": partial(_by_pressure, known)}
        for method, run in ways.items():
            found: dict[int, NDArray[np.float64]] = {}
            for taps in (1, 4):
                started_s = process_time()
                maps = run(every, taps)
                run_time_us = round(1e6 * (process_time() - started_s) / len(every))
                maps = fit_gain(run(some, taps), some.patterns()) * maps
                found[taps] = psnr_db(maps, every.patterns(), MAX_INDENTATION_MM)
                row: Row = {"world": name, "known": "pad and gains" if known else "nothing", "method": method}
                row |= {"taps": taps, "PSNR dB": with_interval(found[taps], every.presses.pad)}
                row["over one tap"] = with_interval(found[taps] - found[1], every.presses.pad) if taps > 1 else None
                rows.append(row | {"run time us": run_time_us})
    report.table(rows, "By world, what is known, method and number of taps.")


def _poses(one: FrozenPresses, taps: int) -> NDArray[np.float32]:
    return stated_poses(np.random.default_rng(SEED), one.presses.poses[:, :taps], USUAL)


def _by_model(model: ModelSession, known: bool, one: FrozenPresses, taps: int) -> _Array:
    return infer(model, one.windows(taps), known_pads(one, known), _poses(one, taps)).patterns


def _by_pressure(known: bool, one: FrozenPresses, taps: int) -> _Array:
    """Return patterns (n, H, W) by operators of the nominal pad, or of each sensor's."""
    windows, poses = one.windows(taps, gains_known=known), _poses(one, taps)[..., :3]
    maps = np.empty((len(one), *one.presses.patterns.shape[1:]))
    for pad in np.unique(one.presses.pad):
        mine = np.flatnonzero(one.presses.pad == pad)
        pad = Pad(**dict[str, Any](one.pad(int(mine[0])).constants)) if known else Pad()
        inverse = NonnegativeInverse(pad, _KNOWN_GAIN_ERROR if known else GAIN_SPREAD)
        maps[mine] = [inverse(*press) for press in zip(windows[mine], poses[mine], strict=True)]
    return maps


class NonnegativeInverse:
    """Inverse through the operators of one pad, for a sensor whose gains have an error."""

    def __init__(self, pad: Pad, gain_error: float) -> None:
        gripped = GrippedPad(pad)
        size, pixels, self._gain_error = gripped.size, SCALE * pad.grid.rows, gain_error
        cells, rim = np.eye(_SIDE**2).reshape(-1, _SIDE, _SIDE), (size - pixels) // 2
        across = size // _SIDE
        loads = _SMALL_MPA * np.kron(cells, np.ones((across, across)))[:, None].astype(np.float32)
        none = np.zeros_like(loads)
        read = [gripped.skin.frames(loads)]
        read += [gripped.skin.frames(none, np.stack(one, axis=2)) for one in ((loads, none), (none, loads))]
        self._read = [one.reshape(_SIDE**2, -1).T / _SMALL_MPA for one in read]
        solver = ContactSolver(pad.layer, size, gripped.cell_mm, cover=BARE, sides=pad.free_sides)
        sunk_mm = solver.displacement_mm(loads[:, 0])[:, rim : rim + pixels, rim : rim + pixels] / _SMALL_MPA
        self._sunk = sunk_mm.transpose(1, 2, 0)
        self._cell_mm = across * gripped.cell_mm
        self._mpa_per_count = 1 / (pad.counts_per_newton * (size * gripped.cell_mm) ** 2)

    def __call__(self, taps: _Array, poses: _Array) -> _Array:
        """Return the pattern (H, W) in [mm] of taps (K, 3, rows, cols) in counts at poses (K, 3), newest first."""
        mean_mpa = max(float(taps[0, 2].sum()), 1.0) * self._mpa_per_count
        drag = _FREE * mean_mpa * np.hstack(self._read[1:])
        seen, reads, parts = [self._seen(*pose) for pose in poses], [], []
        for counts, see in zip(taps, seen, strict=True):
            read = counts.ravel().astype(np.float64)
            errors = self._gain_error * np.hypot(read, 0.3 * np.abs(read).max())
            covariance = np.diag(_NOISE_COUNTS**2 + errors**2) + drag @ drag.T
            white = np.linalg.inv(np.linalg.cholesky(covariance))
            reads.append((white @ read).astype(np.float32))
            parts.append(np.stack([white @ one @ see for one in self._read]).astype(np.float32))
        # Pressure and slip of each tap, over the newest's pressure.
        shares = np.tile([1.0, 0.0, 0.0], (len(taps), 1))
        pressure = np.full(_WIDE**2, mean_mpa, dtype=np.float32)
        for _ in range(_ROUNDS):
            matrix = np.concatenate([np.tensordot(share, part, 1) for share, part in zip(shares, parts, strict=True)])
            pressure = _nonnegative(matrix, np.concatenate(reads), pressure, (_SPREAD * mean_mpa) ** -2)
            for share, read, part in zip(shares, reads, parts, strict=True):
                alone = (part @ pressure).T
                square = alone.T @ alone
                share[:] = np.linalg.solve(square + 1e-3 * np.trace(square) * np.eye(3), alone.T @ read)
            shares /= shares[0, 0].clip(0.2)
            shares[:, 0] = shares[:, 0].clip(0.2, 5)
            shares[:, 1:] = shares[:, 1:].clip(-_MOST_SLIP, _MOST_SLIP)
        return (self._sunk @ (seen[0] @ pressure)).clip(0)

    def _seen(self, x_mm: float, y_mm: float, turn_deg: float) -> _Array:
        """Return the matrix (cells, wide cells) of what a pad at a pose sees of a map in the newest tap's axes."""
        x, y = np.meshgrid(*[(np.arange(_SIDE) - (_SIDE - 1) / 2) * self._cell_mm] * 2)
        cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        columns_mm, rows_mm = x_mm + cosine * x - sine * y, y_mm + sine * x + cosine * y
        away = [
            one.reshape(-1, 1) / self._cell_mm + (_WIDE - 1) / 2 - np.arange(_WIDE) for one in (rows_mm, columns_mm)
        ]
        down, right = ((1 - np.abs(one)).clip(0) for one in away)  # of the nearest cells, bilinear
        return (down[:, :, None] * right[:, None, :]).reshape(_SIDE**2, -1)


def _nonnegative(matrix: _Array, read: _Array, start: _Array, weight: float) -> _Array:
    """Return p >= 0 that minimises |matrix p - read|^2 + weight |p|^2."""
    steepest = float(np.linalg.norm(matrix, 2)) ** 2 + weight
    best, ahead, speed = start, start, 1.0
    for _ in range(_STEPS):
        slope = matrix.T @ (matrix @ ahead - read) + weight * ahead
        found, faster = (ahead - slope / steepest).clip(0), (1 + (1 + 4 * speed**2) ** 0.5) / 2
        ahead, best, speed = found + (speed - 1) / faster * (found - best), found, faster
    return best
