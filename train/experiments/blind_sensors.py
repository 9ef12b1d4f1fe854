"""What a model for one sensor gains on an ordinary sensor, whose gains and constants were found from its contacts.

Sensors are drawn from the whole range of pads. What their sensor files hold is what 200 contacts of mixed families and
one weight tell of them; then train.own makes a model for each, and it is judged on presses of that very sensor, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.perception.gain_learning import load_contact_model
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, GAINS, LEVEL_90, PAD_RANGES, Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from train.data.presses import PressSet
from train.data.world import World
from train.experiments.workbench import Workbench, infer, name_of
from train.families.family_shares import FIGURES, SHARES
from train.learning.contact_mixture import learned, place_effects
from train.own import COMPARED, Knowledge, Plan, compared, knowledge_of, trained
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.pad_draws import draw_pad
from train.physics.sensor_noise import NAMES, Nuisances, apply_nuisances
from train.report import Report, Row, with_interval

_SENSORS: Final = 10
_CONTACTS: Final = 200
_JUDGED: Final = 240  # presses of a sensor, of each kind, on which models are judged
_PLAN: Final = Plan(presses=4000, steps=2500)
_WEIGHT_ERROR: Final = 0.08  # half of the 90 % interval of counts per newton by a weight that covers the pad
_SEED: Final = 8_300_001
_OF_ONE: Final = ("hysteresis", "cross_talk")  # nuisances that are the same in all presses of one sensor


@dataclass(frozen=True)
class BlindSensor:
    """A simulated sensor, and what was found of it."""

    number: int
    gains: NDArray[np.float32]  # (3, rows, cols), those of its chips
    truth: Pad  # its constants and gains
    found: Knowledge
    contacts: int  # distinct ones that it was found from

    def read(self, presses: PressSet, seed: int) -> NDArray[np.float32]:
        """Return what it reads in presses on its pad, (n, 3, rows, cols): each with drift and noise of its own."""
        return _read(presses, self.gains, self.number, seed)


def blind_sensors(bench: Workbench, report: Report) -> None:
    """Train a model for each of ten sensors that were found from contacts and a weight, and judge it on that sensor."""
    plan, compared_on = (Plan(48, 1), 24) if bench.quick else (_PLAN, COMPARED)
    kinds = {"all": dict.fromkeys(SHARES, 1.0), "figures": dict.fromkeys(FIGURES, 1.0)}
    world = World(seed=_SEED, count=_SENSORS * _JUDGED, per_pad=_JUDGED)
    sets = {kind: bench.presses(f"blind-{kind}", replace(world, families=of)) for kind, of in kinds.items()}
    bundled, rows, gained = bench.model(), list[Row](), dict[str, list[NDArray[np.float64]]]()
    for sensor in tracked(list(_sensors(bench)), "sensors", "sensor"):
        ranges = sensor.found.ranges
        path = bench.checkpoints / f"blind-{sensor.number}" / "own.pt"
        model, judges = trained(sensor.found, World(ranges=ranges, seed=1), plan, compared_on, path)
        own, pad = ModelSession(model), sensor.found.pad
        verdict = compared(own, sensor.found, judges, [])
        row: Row = {"sensor": sensor.number, "contacts": sensor.contacts, "known": ", ".join(pad.constants)}
        for kind, of in sets.items():
            presses = of.pick(of.pad == np.unique(of.pad)[sensor.number])
            windows = sensor.read(presses, _SEED + 1)[:, None]
            truth = presses.patterns.astype(np.float32)
            runs = {"told nothing": (bundled, Pad()), "told": (bundled, pad), "told truth": (bundled, sensor.truth)}
            for name, (run, known) in (runs | {"own": (own, pad)}).items():
                maps = infer(run, windows, [known] * len(windows)).patterns
                gained.setdefault(f"{kind}, {name}", []).append(psnr_db(maps, truth, MAX_INDENTATION_MM))
            over = gained[f"{kind}, own"][-1] - gained[f"{kind}, told"][-1]
            row[f"{kind}, own over told"] = with_interval(over, np.arange(len(over)), sign="+")
        likes = verdict.table.splitlines()[-1].split(" | ")[1:4]
        row |= dict(zip(("all, alike", "figures, alike", "unlike"), likes, strict=True))
        rows.append(row | {"handed over": "no" if verdict.objection else "yes"})
    report.say(f"{name_of(bundled)}")
    report.table(_means(gained), "Mean.")
    report.table(rows, "By sensor.")


def _means(gained: dict[str, list[NDArray[np.float64]]]) -> list[Row]:
    """Return PSNR by what a model is, with intervals by sensor."""
    rows: dict[str, Row] = {}
    for name, values in gained.items():
        kind, what = name.split(", ")
        of = np.repeat(np.arange(len(values)), [len(one) for one in values])
        row = rows.setdefault(what, {"model": what})
        row[f"{kind}, PSNR dB"] = with_interval(np.concatenate(values), of)
        over = np.concatenate(values) - np.concatenate(gained[f"{kind}, told"])
        row[f"{kind}, over told"] = with_interval(over, of, sign="+")
    return list(rows.values())


def _sensors(bench: Workbench) -> Iterator[BlindSensor]:
    """Yield the sensors, found from contacts and a weight."""
    world = World(seed=_SEED, count=_SENSORS * _CONTACTS, per_pad=_CONTACTS)
    presses, model = bench.presses("blind-contacts", world), load_contact_model()
    for number, drawn in enumerate(np.unique(presses.pad)):
        pad, rng = draw_pad(np.random.default_rng([_SEED, number])), np.random.default_rng([_SEED, 1, number])
        chips = 1 + GAIN_SPREAD * rng.standard_normal(USPA44.scan_shape, dtype=np.float32).clip(-2, 2)
        contacts = _read(presses.pick(presses.pad == drawn), chips, number, _SEED)
        learner = learned(contacts, model)
        # Seats and moments of the magnets are gains, too; those of z together are part of the counts per newton.
        gains = chips.reshape(len(AXES), -1) * place_effects(pad)[0]
        scale = float(gains[-1].mean())
        gains = gains.ravel() / scale
        per_newton = pad.counts_per_newton * scale
        truth = {name: getattr(pad, name) for name in PAD_RANGES} | {"counts_per_newton": per_newton}
        weighed = per_newton * (1 + _WEIGHT_ERROR / LEVEL_90 * float(rng.standard_normal()))
        interval = (weighed * (1 - _WEIGHT_ERROR), weighed * (1 + _WEIGHT_ERROR))
        entry = SensorEntry(pad=learner.pad(), counts_per_newton=weighed, counts_per_newton_interval=interval)
        exact = Pad(**truth, gains=tuple(gains.tolist()), gain_half_widths=(0.0,) * GAINS)
        found = knowledge_of(SensorFile(sensors={str(number): entry}), None)
        yield BlindSensor(number, chips, exact, found, learner.contacts)


def _read(presses: PressSet, gains: NDArray[np.float32], number: int, seed: int) -> NDArray[np.float32]:
    lags = Nuisances().without(*(name for name in NAMES if name not in _OF_ONE))
    felt = apply_nuisances(presses.counts[:, 0][None, :, None], lags, [_SEED, number])[0, :, 0] * gains
    return apply_nuisances(felt[:, None, None], Nuisances().without(*_OF_ONE, "gain_spread"), [seed, number])[:, 0, 0]
