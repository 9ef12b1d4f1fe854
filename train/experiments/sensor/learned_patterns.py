"""Patterns with self-calibration: a network's error with what was learned of a sensor, and with the truth.

Sensors have pads, gains and all other nuisances of their own, and learn from their first 200 contacts, of every family;
the contacts after these are evaluated.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor.flat_grip_gains import load_table
from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import DEFAULT_MODEL, FLAT_GRIPS, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.gain_learning import ContactModel, GainLearner, load_contact_model
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad as KnownPad
from train.data.grip_ramps import read_grips
from train.data.make_presses import make_presses
from train.data.presses import PressSet
from train.data.simulated_sensors import contacts_of, sensor_of, true_log_gains
from train.data.world import World
from train.experiments.support.workbench import Workbench
from train.learning.flat_grips import grips_of_pad
from train.physics.pad_draws import INPUTS, Pad
from train.physics.sensor_noise import Nuisances, read_windows
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval

SENSORS: Final = World(count=6000, per_pad=250, seed=9021)
LEARNED: Final = 200
_FIGURES: Final = ("glyph", "polygon")
_SCALE: Final = ("shear_modulus_mpa", "counts_per_newton")
"""Constants that set the scale of forces and depths alone."""
_EXACT: Final = (1e-4,) * (3 * USPA44.taxel_count)


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `learned-patterns`."""
    world = replace(SENSORS, count=36, per_pad=12) if bench.quick else SENSORS
    presses = make_presses(world, bench.data_folder / ("quick-learned.npz" if bench.quick else "learned.npz"))
    path, contacts = find_model(DEFAULT_MODEL), load_contact_model()
    model = ModelSession(path)
    bench.use(path)
    count = min(LEARNED, world.per_pad * 4 // 5)
    rows = [
        *_evaluated(model, contacts, presses, world, count),
        *_right_from_the_start(model, contacts, presses, count),
    ]
    report = Report("learned-patterns", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{model.name} on {world.chunks} sensors, each with a pad and gains of its own, N(1, .075); PSNR in dB with "
        f"a full scale of {MAX_INDENTATION_MM} mm, mean and 95 % interval by sensor, of contacts after the first "
        f"{count}. What is known: nothing; gains from the doctor's three flat grips; gains and constants learned from "
        f"{count} contacts of every family; the same beginning from the flat grips; the true gains and constants. "
        "Contacts cannot show the scale of forces and depths, so it is also given: the true modulus and counts per "
        "newton. Gained and short: paired differences to nothing known, and to the truth. Wanted: at most .7 dB short; "
        "1 dB gained on unseen figures; no more than .1 dB lost where gains were right from the start."
    )
    report.show(rows, "Patterns by what is known of the sensor.")
    return report.write()


def _evaluated(model: ModelSession, contacts: ContactModel, presses: PressSet, world: World, count: int) -> list[Row]:
    table = load_table(FLAT_GRIPS)
    psnr: dict[str, dict[str, list[float]]] = {}
    pads = np.unique(presses.pad)
    for number in tracked(range(len(pads)), "sensors", "sensor"):
        pad, chips = sensor_of(world, number)
        mine = presses.pick(presses.pad == pads[number])
        readings = contacts_of(presses, world, number)
        clean, _ = grips_of_pad(world.seed, number)
        by_hand = table.gains(list(read_grips(clean, chips, [world.seed, number])))
        learned = _learned(contacts, readings[:count], None)
        scale = {name: getattr(pad, name) for name in _SCALE}
        known = {
            "nothing": None,
            "flat grips": by_hand,
            "contacts": learned,
            "flat grips, then contacts": _learned(contacts, readings[:count], by_hand),
            "scale": KnownPad(**scale),
            "scale and contacts": replace(learned, **scale),
            "the truth": _truth(pad, np.exp(true_log_gains(pad, chips))),
        }
        _add(psnr, model, readings[count:], mine.pick(np.arange(count, len(mine))), known)
    return _rows(psnr, "gains N(1, .075)")


def _right_from_the_start(model: ModelSession, contacts: ContactModel, presses: PressSet, count: int) -> list[Row]:
    """Evaluate sensors whose gains are those of their pad alone, with gains that were learned all the same."""
    psnr: dict[str, dict[str, list[float]]] = {}
    for number in np.unique(presses.pad):
        mine = presses.pick(presses.pad == number)
        nuisances = Nuisances().without("gain_spread")
        readings = read_windows(mine.counts[None, :, 0, None], 1.0, nuisances, [int(number), 1])[0]
        known = {"nothing": None, "contacts": _learned(contacts, readings[:count], None)}
        _add(psnr, model, readings[count:], mine.pick(np.arange(count, len(mine))), known)
    return _rows(psnr, "chips even")


def _learned(contacts: ContactModel, readings: NDArray[np.float32], start: KnownPad | None) -> KnownPad:
    learner = GainLearner(contacts, start)
    for one in readings:
        learner.learn(one)
    learner.solve()
    return learner.pad()


def _truth(pad: Pad, gains: NDArray[np.floating]) -> KnownPad:
    constants = {name: getattr(pad, name) for name in INPUTS}
    return KnownPad(**constants, gains=tuple(gains.tolist()), gain_half_widths=_EXACT)


def _add(
    psnr: dict[str, dict[str, list[float]]],
    model: ModelSession,
    readings: NDArray[np.float32],
    truth: PressSet,
    known: dict[str, KnownPad | None],
) -> None:
    """Add a sensor's mean PSNR on all contacts and on figures, for each that is known of it."""
    figures = np.isin(truth.family, _FIGURES)
    for name, pad in known.items():
        each = psnr_db(_patterns(model, readings, pad), truth.patterns.astype(np.float32), MAX_INDENTATION_MM)
        mine = psnr.setdefault(name, {"all": [], "figures": []})
        mine["all"].append(float(each.mean()))
        mine["figures"].append(float(each[figures].mean()) if figures.any() else np.nan)


def _patterns(model: ModelSession, readings: NDArray[np.float32], pad: KnownPad | None) -> NDArray[np.float32]:
    contract = model.contract
    gains = None
    if pad is not None and pad.gains is not None:
        gains = np.asarray(pad.gains, dtype=np.float32).reshape(readings.shape[1:])
    row = contract.pad_row(pad)
    windows = np.zeros((contract.taps, *readings.shape[1:]), dtype=np.float32)
    patterns = []
    for one in readings:
        windows[0] = one
        patterns.append(model.run(contract.scale_window(windows, gains), row).copy())
    return np.array(patterns)


def _rows(psnr: dict[str, dict[str, list[float]]], sensors: str) -> list[Row]:
    rows: list[Row] = []
    for name, mine in psnr.items():
        cells: Row = {"sensors": sensors, "known": name}
        for part, values in mine.items():
            by_sensor = np.array(values)
            cells |= {f"{part} dB": _mean(by_sensor)}
            for caption, other, sign in (("gained", "nothing", 1), ("short", "the truth", -1)):
                if other in psnr:
                    cells[f"{part} {caption}"] = _mean(sign * (by_sensor - np.array(psnr[other][part])))
        rows.append(cells)
    return rows


def _mean(values: NDArray[np.floating]) -> str:
    there: Sequence[float] = values[np.isfinite(values)].tolist()
    return with_interval(np.array(there), np.arange(len(there)), 2) if there else "-"
