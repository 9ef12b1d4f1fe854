"""Force, twist and centre of pressure from the shipped model, evaluated on unseen pads."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.wrench import LEAST_FORCE_N, Wrench, wrench_of
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.frozen_presses import FrozenPresses
from train.errors import TrainError
from train.experiments.sensor.families import TRAINING
from train.experiments.support.baselines import read_newest
from train.experiments.support.scores import share_beside
from train.experiments.support.shipped import FORCE, KNOWN, SHORT, infer_presses, load_shipped
from train.experiments.support.workbench import Workbench
from train.physics.gripped import TRACTION_SCALE
from train.physics.pad_draws import NOMINAL
from train.report import Report, Row

OFFSET_N: Final = 0.05
_RIDGE: Final = 1e-4

Loads = NDArray[np.float64]
"""Loads (n, 6): force x, y, z in [N], twist in [N mm], centre of pressure x, y in [mm], nan without a press."""


def run(bench: Workbench, folder: Path) -> Path:
    """Integrate tractions, compare the methods, and write the report `wrench`."""
    wide = bench.wide_test()
    model = load_shipped(bench.models)
    bench.use(bench.models / f"{model.name}.onnx")
    truth = true_loads(wide)
    found: dict[str, Loads] = {}
    for known in tracked(KNOWN, "inferring", "pass"):
        traction = infer_presses(model, wide, known).traction_kpa
        if traction is None:
            raise TrainError(f"model '{model.name}' gives no traction: give --models a folder of contract version 5")
        found[SHORT[known]] = loads(traction, model.contract.traction_scale or TRACTION_SCALE)
    found |= _linear(bench, wide)

    report = Report("wrench", folder, __file__, bench.used, quick=bench.quick)
    size = np.sqrt(np.mean(np.square(truth[:, :4]), axis=0))
    report.say(
        f"`{model.name}` of contract version {model.contract.version} (training "
        f"{model.contract.training_sha256[:12]}), wide test set, {len(wide)} presses, one tap. Root mean square of the "
        f"true z force {size[2]:.2f} N, of the tangential one {np.hypot(*size[:2]):.2f} N, of the twist "
        f"{size[3]:.1f} N mm. `%` is the p for which errors are p % of the z force + {OFFSET_N} N in the root mean "
        "square; the tangential error is a vector's, held against the z force, too, as many presses have no drag. "
        "Linear: least squares from the 48 readings of training presses; with counts per newton known, times nominal "
        "over known ones. Summed z: over the known counts per newton. Centres of pressure are compared where the truth "
        f"and the estimate press with {LEAST_FORCE_N} N."
    )
    report.table([{"method": name} | error_cells(one, truth) for name, one in found.items()], "All families.")
    shipped = found[SHORT[FORCE]]
    rows: list[Row] = []
    for family in dict.fromkeys(wide.presses.family.tolist()):
        which = wide.presses.family == family
        rows.append({"family": family} | error_cells(shipped[which], truth[which]))
    report.table(rows, "By family, with the counts per newton known.", "families")
    with report.figure(size=(10, 3.6)) as figure:
        names = ("x force [N]", "z force [N]", "twist [N mm]")
        for axes, name, column in zip(figure.subplots(1, 3), names, (0, 2, 3), strict=True):
            axes.plot(truth[:, column], shipped[:, column], ".", markersize=2)
            axes.axline((0, 0), slope=1, color="k", linewidth=0.5)
            axes.set(xlabel=f"true {name}", ylabel="from the reading")
    return report.write()


def loads(traction_kpa: NDArray[np.floating], scale: int) -> Loads:
    """Return the loads of tractions (n, 3, h, w) with `scale` pixels a taxel pitch."""
    return np.array([_row(wrench_of(one, USPA44.pixel_pitch_mm(scale))) for one in traction_kpa.astype(np.float64)])


def true_loads(frozen: FrozenPresses) -> Loads:
    """Return the true loads, with centres of pressure from the true tractions."""
    presses = frozen.presses
    truth = loads(presses.traction_kpa, TRACTION_SCALE)
    truth[:, :3], truth[:, 3] = presses.force_n, presses.twist_nmm
    return truth


def _row(wrench: Wrench) -> tuple[float, ...]:
    return (*wrench.force_n, wrench.torque_n_mm[2], *(wrench.centre_of_pressure_mm or (np.nan, np.nan)))


def error_cells(found: Loads, truth: Loads) -> Row:
    """Return errors as cells of a row; quantities that a method does not estimate are left out."""
    off = found - truth
    z, tangential = off[:, 2], np.hypot(off[:, 0], off[:, 1])
    cells: Row = {
        "z N": round(_rms(z), 3),
        "z %": round(share_beside(z, truth[:, 2], OFFSET_N), 1),
        "z bias %": round(100 * float(z.mean() / truth[:, 2].mean()), 1),
    }
    if np.isfinite(tangential).all():
        cells |= {
            "tangential N": round(_rms(tangential), 3),
            "tangential %": round(share_beside(tangential, truth[:, 2], OFFSET_N), 1),
            "twist N mm": round(_rms(off[:, 3]), 2),
        }
    away_mm = np.hypot(off[:, 4], off[:, 5])
    away_mm = away_mm[np.isfinite(away_mm)]
    if len(away_mm):
        cells |= {"centre mm": round(_rms(away_mm), 3), "centre mm, median": round(float(np.median(away_mm)), 3)}
    return cells


def _rms(error: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def _linear(bench: Workbench, wide: FrozenPresses) -> dict[str, Loads]:
    """Return force and twist by least squares from readings, and z force from summed z, without centres of pressure."""
    training = bench.presses("gripped", TRAINING)
    readings = read_newest(training).reshape(len(training), -1).astype(np.float64)
    target = np.column_stack([training.force_n, training.twist_nmm])
    gram = readings.T @ readings
    penalty = _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    matrix = np.linalg.solve(gram + penalty, readings.T @ target)
    newest = wide.windows(1)[:, 0]
    per_newton = np.array([wide.pad(index).counts_per_newton or np.nan for index in range(len(wide))])
    straight = np.full((len(wide), 6), np.nan)
    straight[:, :4] = newest.reshape(len(wide), -1) @ matrix
    scaled = straight * (NOMINAL.counts_per_newton / per_newton)[:, None]
    summed = np.full_like(straight, np.nan)
    summed[:, 2] = newest[:, 2].sum(axis=(1, 2)) / per_newton
    return {"linear": straight, "linear, counts/N known": scaled, "summed z": summed}
