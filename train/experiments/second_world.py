"""The shipped models and their checks in a second simulated world, of other physics, and what brings them nearer to it.

What is fitted is fitted on presses of other sensors, unless a row says that it is the sensor's own.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from timeit import timeit
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import bilinear, fit_gain, fit_linear_map
from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import POSED_MODEL
from edge.inference.onnx_session import ModelSession
from edge.perception.gain_learning import load_contact_model
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from train.data.press_batches import stated_poses
from train.data.presses import SEED
from train.experiments.half_space import Pressed, draw_presses
from train.experiments.posed_taps import USUAL
from train.experiments.trust_checks import WRONG, judged, verdicts_on
from train.experiments.workbench import Workbench, infer, name_of
from train.learning.contact_mixture import learned
from train.physics.gripped import MAX_INDENTATION_MM, SCALE
from train.physics.pad_draws import INPUTS, RANGES
from train.physics.tpsf import heights_pattern
from train.report import Report, Row, with_interval

SEEDS: Final = (8_200_101, 8_200_102)
"""Seeds of the sensors on which methods are fitted, and of those on which they are compared."""
_FACTORS: Final = (0.5, 0.7, 1.0, 1.4, 2.0)
_SHAPES: Final = 5  # known shapes by which the gain of each sensor is found

Maps = NDArray[np.floating]
Run = Callable[[Pressed], Maps]
"""Method from presses to their patterns, or a truth to compare these with, (n, H, W) in [mm]."""


def drawn(one: Pressed) -> NDArray[np.float32]:
    """Return what training would have drawn for contacts: their depth, and a Gaussian around it."""
    presses, pixel_mm = one.frozen.presses, USPA44.pixel_pitch_mm(SCALE)
    return heights_pattern(one.gaps_mm, presses.touching, presses.indentation_mm, pixel_mm)


TRUTHS: Final[Mapping[str, Run]] = {"sinking": lambda one: one.frozen.patterns(), "as drawn": drawn}


def second_world(bench: Workbench, report: Report) -> None:
    """Evaluate the shipped models and their checks in a world of other physics, an elastic half-space."""
    sensors, presses = (3, 8) if bench.quick else (24, 24)
    other = draw_presses(SEEDS[0], sensors, presses, taps=4)
    test = draw_presses(SEEDS[1], sensors, presses, taps=4)
    own = draw_presses(SEEDS[1], sensors, 6 * presses, series=1)
    model, posed, mine = bench.model(), bench.model(POSED_MODEL), test.frozen.presses.pad
    between = with_interval(psnr_db(drawn(test), test.frozen.patterns(), MAX_INDENTATION_MM), mine)
    report.say(
        f"{name_of(model)} and {name_of(posed)}, through the runtime's session. {len(test.frozen)} presses of "
        f"{sensors} sensors on an elastic half-space (`train/experiments/half_space.py`, seed {SEEDS[1]}); what is "
        f"fitted is fitted on as many presses of other sensors (seed {SEEDS[0]}), by each truth. PSNR in dB, full "
        f"scale {MAX_INDENTATION_MM} mm, by two truths: how far the surface sinks in this world, and what training "
        "would have drawn for the same contacts, around which the surface rises within 1.3 mm. They are "
        f"{between} dB from each other. Wrong: an RMS error over {WRONG:.0%} of the RMS of the truth. 95 % intervals "
        "are by sensor; run time: mean of a scan, one thread of a busy machine."
    )
    scans = [own.frozen.presses.counts[own.frozen.presses.pad == sensor, 0] for sensor in range(sensors)]
    pads = [learned(one, load_contact_model()).pad() for one in scans]
    rows: dict[str, Row] = {}
    for name, truth in tracked(TRUTHS.items(), "judging", "truth"):
        for way, run, whose in _ways(model, posed, truth, other, pads):
            maps = run(test)
            maps = maps * _gains(maps, truth, run, whose, other, own, test)
            off = np.sqrt(((maps - truth(test)) ** 2).mean(axis=(1, 2)) / (truth(test) ** 2).mean(axis=(1, 2)))
            row = rows.setdefault(f"{way}, {whose}", {"method": way, "gain of": whose})
            row[f"{name}, PSNR dB"] = with_interval(psnr_db(maps, truth(test), MAX_INDENTATION_MM), mine)
            row[f"{name}, wrong %"] = with_interval(100.0 * (off > WRONG), mine, 0)
            row["run time us"] = round(1e6 * timeit(partial(run, test), number=1) / len(maps))
    report.table(list(rows.values()), "By method, and by what a user could do about it.")
    cells: list[Row] = []
    for name, truth in TRUTHS.items():
        against = replace(test.frozen, presses=replace(test.frozen.presses, patterns=truth(test)))
        verdicts = judged(model, against, [None] * len(test.frozen))
        cells.append({"truth": name} | verdicts.cells(~verdicts.light))
    report.table(cells, f"Patterns of {model.name} that the runtime does not believe, nothing known, no gain fitted.")
    suspected = verdicts_on(model, scans, [None] * sensors)
    report.table([suspected], "Contacts of each sensor in turn, and the sensors suspected by then.")


def _ways(
    model: ModelSession, posed: ModelSession, truth: Run, other: Pressed, pads: Sequence[Pad]
) -> Iterator[tuple[str, Run, str]]:
    """Yield methods with their names and whose gain each has; the judged sensors' contacts have taught `pads`."""

    def readings(one: Pressed) -> Maps:
        return one.frozen.windows(1).reshape(len(one.frozen), -1)

    def told(known: Callable[[Pressed], Sequence[Pad | None]], xy: float = 1.0, z: float = 1.0) -> Run:
        factors = np.array([xy * z, xy * z, z], dtype=np.float32)[:, None, None]
        return lambda one: infer(model, one.frozen.windows(1) * factors, known(one)).patterns

    def all_alike(pad: Pad | None, xy: float = 1.0, z: float = 1.0) -> Run:
        return told(lambda one: [pad] * len(one.frozen), xy, z)

    def by_contacts(one: Pressed) -> list[Pad | None]:
        return [None if one is other else pads[sensor] for sensor in one.frozen.presses.pad]

    def weighed(one: Pressed) -> list[Pad]:
        return [Pad(counts_per_newton=float(value)) for value in one.counts_per_newton]

    def several(one: Pressed, taps: int) -> Maps:
        poses = stated_poses(np.random.default_rng(SEED), one.frozen.presses.poses[:, :taps], USUAL)
        return infer(posed, one.frozen.windows(taps), [None] * len(poses), poses).patterns

    wanted = truth(other)

    def nearness(run: Run) -> float:
        maps = run(other)
        return float(psnr_db(fit_gain(maps, wanted) * maps, wanted, MAX_INDENTATION_MM).mean())

    yield "bilinear", lambda one: bilinear(one.frozen.windows(1)[:, 0, 2], SCALE), "the world"
    matrix = fit_linear_map(readings(other), wanted.reshape(len(wanted), -1), 1e-2)
    yield "linear map fitted in this world", lambda one: (readings(one) @ matrix).reshape(-1, *wanted.shape[1:]), "-"
    plain, name = all_alike(None), model.name
    yield from ((name, plain, whose) for whose in ("-", "the world", "each sensor", "each pattern"))
    scaled = max((all_alike(None, *factors) for factors in product(_FACTORS, _FACTORS)), key=nearness)
    yield f"{name}, x, y and z scaled", scaled, "the world"
    yield f"{name}, counts per newton by a weight", told(weighed), "the world"
    yield f"{name}, its own contacts learned", told(by_contacts), "the world"
    pad = Pad()
    for constant in (*INPUTS, *INPUTS):
        tried = [replace(pad, **{constant: float(value)}) for value in np.linspace(*RANGES[constant], 5)]
        pad = max(tried, key=lambda one: nearness(all_alike(one)))
    yield f"{name}, constants fitted to this world", all_alike(pad), "the world"
    yield f"{name}, constants fitted to this world", all_alike(pad), "each sensor"
    yield f"{posed.name}, one tap", partial(several, taps=1), "the world"
    yield f"{posed.name}, four taps", partial(several, taps=4), "the world"


def _gains(maps: Maps, truth: Run, run: Run, whose: str, other: Pressed, own: Pressed, test: Pressed) -> Maps:
    """Return the factor on each pattern (n, 1, 1) of the test, fitted on presses of those it is of."""
    gains = np.ones(len(maps))
    if whose == "the world":
        gains[:] = fit_gain(run(other), truth(other))
    if whose == "each pattern":  # by its own truth: a bound
        gains = np.array([fit_gain(*pair) for pair in zip(maps, truth(test), strict=True)])
    if whose == "each sensor":
        sensors = own.frozen.presses.pad
        few = own.pick(np.arange(len(sensors)) - np.searchsorted(sensors, sensors) < _SHAPES)
        found, true = (part.reshape(-1, _SHAPES, *maps.shape[1:]) for part in (run(few), truth(few)))
        gains = np.array([fit_gain(*pair) for pair in zip(found, true, strict=True)])[test.frozen.presses.pad]
    return gains[:, None, None]
