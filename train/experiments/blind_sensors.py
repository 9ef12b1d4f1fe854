"""Gain of a model for one sensor on an ordinary one, whose constants were found with a weight, contacts and a ball.

Sensors are drawn from the whole range of pads. Their sensor files hold what contacts of mixed families, one weight and
presses of a ball determine; then train.own makes a model for each, which is evaluated on that very sensor, too.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.doctor.guided_press import COVERED_ERROR, Weighed
from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.perception.gain_learning import load_contact_model
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, LEVEL_90
from firmware_bridge.scans.pad_constants import Pad as SensorPad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, with_scale
from train.data.presses import PressSet
from train.data.world import World
from train.experiments.workbench import Workbench, infer, name_of
from train.families.catalogue import BARE, FIGURES, SHARES
from train.learning.ball_fit import fit_ball
from train.learning.contact_mixture import learned, place_effects
from train.learning.sensor_knowledge import Knowledge, knowledge_of
from train.own import COMPARED, Plan, compared, trained
from train.physics.gripped import MAX_INDENTATION_MM, GrippedPad
from train.physics.pad_draws import Pad, draw_pad
from train.physics.sensor_noise import NAMES, Nuisances, apply_nuisances, log_uniform
from train.report import Report, Row, with_interval

_SENSORS: Final = 10
_CONTACTS: Final = 200
_BALL_MM: Final = 40.0
_BALL_PRESSES: Final = 16
_RISING: Final = 6  # scans of a press
_LEFT_COUNTS: Final = 5.0  # of drift, where the pad was free just before a press
_JUDGED: Final = 240  # presses of a sensor, of each kind, on which models are evaluated
_SEED: Final = 8_300_001
_OF_ONE: Final = ("hysteresis", "cross_talk")  # nuisances that are the same in all presses of one sensor
_FOUND, _OWN = "bundled, sensor file as found", "own model, sensor file as found"
Figures = dict[str, NDArray[np.float64]]  # PSNR of presses, (n,) in dB, by what makes the patterns


class BlindSensor(NamedTuple):
    """A simulated sensor, and what was found of it."""

    number: int
    chips: NDArray[np.float32]  # their gains, (3, rows, cols)
    found: Knowledge
    without_ball: SensorPad

    def figures(self, own: ModelSession, bundled: ModelSession, presses: PressSet) -> Figures:
        """Return how well models do on presses on its pad, told what was found or less."""
        pad, truth = self.found.pad, presses.patterns.astype(np.float32)
        windows = _felt(presses.counts[:, 0], self.chips, self.number, Nuisances(), _SEED + 1)[:, None]
        runs = {
            "bundled, nothing known": (bundled, SensorPad()),
            "bundled, without the ball": (bundled, self.without_ball),
            _FOUND: (bundled, pad),
            _OWN: (own, pad),
        }
        return {
            name: psnr_db(infer(model, windows, [known] * len(windows)).patterns, truth, MAX_INDENTATION_MM)
            for name, (model, known) in runs.items()
        }


def blind_sensors(bench: Workbench, report: Report) -> None:
    """Train a model for each of ten sensors that were found with a weight, contacts and a ball, and judge it there."""
    plan, compared_on = (Plan(48, 1), 24) if bench.quick else (Plan(12_000, 4000), COMPARED)
    world = World(seed=_SEED, count=_SENSORS * _JUDGED, per_pad=_JUDGED, families=dict.fromkeys(SHARES, 1.0))
    figures = replace(world, families=dict.fromkeys(FIGURES, 1.0))
    sets = {"all": bench.presses("blind-all", world), "figures": bench.presses("blind-figures", figures)}
    bundled, rows, found = bench.model(), list[Row](), {kind: list[Figures]() for kind in sets}
    for sensor in tracked(list(_sensors(bench))[: 2 if bench.quick else None], "sensors", "sensor"):
        like, work = World(ranges=sensor.found.ranges), bench.checkpoints / f"blind-{sensor.number}"
        path, alike = trained(sensor.found, like, plan, compared_on, work / "own.pt")
        own = ModelSession(path)
        row: Row = {"sensor": sensor.number}
        for kind, of in sets.items():
            found[kind].append(sensor.figures(own, bundled, of.pick(of.pad == np.unique(of.pad)[sensor.number])))
            over = found[kind][-1][_OWN] - found[kind][-1][_FOUND]
            row[f"its own, {kind}"] = with_interval(over, np.arange(len(over)), sign="+")
        verdict = compared(own, sensor.found, alike, [])
        rows.append({**row, **verdict.gains, "handed over": "no" if verdict.objection else "yes"})
    report.say(
        f"{name_of(bundled)} and a model of `train.own` for each of {len(rows)} sensors ({plan.presses} presses, "
        f"{plan.steps} steps), in 8-bit integers. Sensors are of the whole range of pads (seed {_SEED}), with gains, "
        "cross-talk and lag of their own. Both models get the sensor file: counts per newton by a weight, within "
        f"{COVERED_ERROR:.0%}, what {_CONTACTS} contacts determine, and what {_BALL_PRESSES} presses of a ball of "
        f"{_BALL_MM:g} mm do. {_JUDGED} presses of each kind and sensor; PSNR "
        "in dB; 95 % intervals by sensor, then by press and pad."
    )
    report.table(_means(found), "By what makes the patterns; over the bundled model with the same sensor file.")
    report.table(rows, "Own model over the bundled one, on the sensor's presses, and on pads as `train.own` compares.")


def _means(found: Mapping[str, list[Figures]]) -> list[Row]:
    rows = [Row(patterns=name) for name in found["all"][0]]
    for kind, figures in found.items():
        of = np.repeat(np.arange(len(figures)), [len(one[_FOUND]) for one in figures])
        for row in rows:
            values, base = (np.concatenate([one[name] for one in figures]) for name in (str(row["patterns"]), _FOUND))
            row |= {f"{kind}, PSNR dB": with_interval(values, of), f"{kind}, over": with_interval(values - base, of)}
    return rows


def _sensors(bench: Workbench) -> Iterator[BlindSensor]:
    """Yield sensors whose gains and constants were found from contacts, and their counts per newton by a weight."""
    world = World(seed=_SEED, count=_SENSORS * _CONTACTS, per_pad=_CONTACTS)
    presses, model = bench.presses("blind-contacts", world), load_contact_model()
    for number, drawn in enumerate(np.unique(presses.pad)):
        pad, rng = draw_pad(np.random.default_rng([_SEED, number])), np.random.default_rng([_SEED, 1, number])
        chips = 1 + np.float32(GAIN_SPREAD) * rng.standard_normal(USPA44.scan_shape, dtype=np.float32).clip(-2, 2)
        contacts = _felt(presses.counts[presses.pad == drawn, 0], chips, number, Nuisances())
        # The mean of the gains of z, which are also seats and moments of the magnets, is part of the counts per newton.
        gains = chips.reshape(len(AXES), -1) * place_effects(pad)[0]
        counts_per_newton = pad.counts_per_newton * float(gains[AXES.index("z")].mean())
        weighed = Weighed(counts_per_newton * rng.normal(1, COVERED_ERROR / LEVEL_90), COVERED_ERROR)
        scale = with_scale(None, weighed.counts_per_newton, weighed.interval) or SensorPad()
        found = learned(contacts, model).pad().behind(scale)
        by_ball = found.behind(fit_ball(_ball_presses(pad, chips, rng, number), _BALL_MM, scale).behind(scale))
        known = knowledge_of(SensorFile(sensors={str(number): SensorEntry(pad=by_ball)}), None)
        yield BlindSensor(number, chips, known, found)


def _ball_presses(
    pad: Pad, chips: NDArray[np.float32], rng: np.random.Generator, number: int
) -> list[NDArray[np.float32]]:
    """Return the scans of a sensor, (_RISING, 3, rows, cols), in each press of a ball by hand."""
    gripped, n, way = GrippedPad(pad), _BALL_PRESSES, rng.uniform(0, 2 * np.pi, _BALL_PRESSES)
    x, y = gripped.places_mm
    at = rng.uniform(-4, 4, (2, n, 1, 1))
    heights = np.sqrt((_BALL_MM / 2) ** 2 - np.square(x - at[0]) - np.square(y - at[1])) - _BALL_MM / 2
    slide = log_uniform(rng, 0.02, 0.3, (n, 1)) * np.stack([np.cos(way), np.sin(way)], axis=1)
    depths, twists, friction = rng.uniform(0.1, MAX_INDENTATION_MM, n), rng.normal(0, 0.02, n), rng.uniform(0.2, 1.2, n)
    every, share = np.repeat(np.arange(n), _RISING), np.tile(np.arange(1, _RISING + 1) / _RISING, n)
    done = gripped.press(
        heights.astype(np.float32)[every],
        depths[every] * share,
        slide[every] * share[:, None],
        twists[every] * share,
        friction[every],
        [BARE] * len(every),
    )
    read = _felt(done.counts, chips, number, Nuisances(thermal_drift_counts=_LEFT_COUNTS, earth_field_counts=0.0))
    return np.split(read, n)


def _felt(
    counts: NDArray[np.float32], chips: NDArray[np.float32], number: int, nuisances: Nuisances, seed: int = _SEED
) -> NDArray[np.float32]:
    """Return what a sensor reads in presses, (n, 3, rows, cols): each with drift and noise of its own."""
    lags = nuisances.without(*(name for name in NAMES if name not in _OF_ONE))
    felt = apply_nuisances(counts[None, :, None], lags, [_SEED, number])[0, :, 0] * chips
    return apply_nuisances(felt[:, None, None], nuisances.without(*_OF_ONE, "gain_spread"), [seed, number])[:, 0, 0]
