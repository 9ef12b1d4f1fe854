"""Force through press, hold and release, from the volume of the patterns.

A pattern's deformation summed over its area becomes newtons by one factor, fitted on training presses. There are no
offsets, and no curve is shifted, so that drift, lag and residual loads remain visible.

Source: Wu and Liu 2024, Fig. 15.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation import metrics
from edge.evaluation.classical_methods import fit_gain
from edge.perception.contact_options import ON_COUNTS
from edge.perception.tap_tracker import TapTracker
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.paper_taps import PaperTaps, between_frames
from train.data.press_batches import read_presses
from train.data.presses import SEED, PressSet
from train.experiments.paper.protocol import compact_methods, mixed
from train.experiments.support.workbench import Method, Workbench
from train.freeze import SCALE, TEST_FORCE_N
from train.physics.sensor_noise import Nuisances, apply_nuisances, read_windows
from train.report import Report, Row, with_interval
from train.surfaces.poses import TARGET_ANGLES_DEG

PRESS_S, HOLD_S, RELEASE_S, REST_S = 2.0, 5.0, 1.0, 2.0
_ENDS_S: Final = np.cumsum([PRESS_S, HOLD_S, RELEASE_S, REST_S])
RANGE_N: Final = TEST_FORCE_N
CLAIM_N: Final = 0.02 * RANGE_N
"""Volume force above which a pattern claims a contact, in [N]: 2 % of the range."""


class Course:
    """Times (t,) in [s] of the scans of one press, at a rate, and the share of its set force at each; free at 0 s."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.time_s: NDArray[np.float64] = np.arange(1, round(_ENDS_S[-1] * rate_hz) + 1) / rate_hz
        self.share: NDArray[np.float64] = np.interp(self.time_s, [0, *_ENDS_S], [0, 1, 1, 0, 0])

    def phase(self, number: int) -> NDArray[np.bool_]:
        """Return the scans of the press (0), hold (1), release (2) or rest (3), each with its end but not its start."""
        return np.searchsorted(_ENDS_S, self.time_s - 0.5 / self.rate_hz) == number


@dataclass(frozen=True, slots=True)
class Scans:
    """Windows (n, K, 3, rows, cols) in zeroed counts, with their true forces and volumes of patterns, (n,)."""

    windows: NDArray[np.float32]
    force_n: NDArray[np.floating]
    volume_mm3: NDArray[np.floating]


def pressed(sequences: PaperTaps, number: int, course: Course, nuisances: Nuisances) -> Scans:
    """Return the scans of a sequence's newest tap along a course.

    One sensor reads all taps of the sequence; the earlier taps are read at their ends.
    """
    index, seed = np.array([number]), [SEED, 3, number]
    angle_deg = sequences.poses[index, :, 2]
    end = sequences.share_at_force(index, TEST_FORCE_N)
    share = end[:, :1] * course.share
    clean = between_frames(sequences.counts[index, 0], share)[:, None]
    newest = apply_nuisances(clean, nuisances, seed, tap_s=course.time_s[-1], angle_deg=angle_deg[:, :1])[0, 0]
    earlier = read_windows(sequences.counts[index], end, nuisances, seed, PRESS_S / end, angle_deg)[0, 1:]
    whole_mm3 = volume_mm3(sequences.patterns_at(index, end[:, 0]), sequences.scale)
    return Scans(
        windows=np.concatenate([newest[:, None], np.broadcast_to(earlier, (len(newest), *earlier.shape))], axis=1),
        force_n=sequences.force_n[number, 0, -1] * share[0],
        volume_mm3=whole_mm3 * course.share,  # flat contacts: in proportion to the indentation
    )


def contact(scans: Scans, course: Course) -> NDArray[np.bool_]:
    """Return the scans (n,) in which the runtime detects a contact."""
    tracker = TapTracker(taps=1)
    times_ns = np.rint(course.time_s * 1e9).astype(np.int64)
    return np.array(
        [tracker.push(scan, int(now_ns)).contact for scan, now_ns in zip(scans.windows[:, 0], times_ns, strict=True)]
    )


def errors(
    true_n: NDArray[np.floating], found_n: NDArray[np.floating], gate: NDArray[np.bool_], course: Course
) -> dict[str, float]:
    """Return the figures of one press, in [% of RANGE_N] or in [% of scans]."""
    resting, loaded = course.phase(3), ~course.phase(3)
    return {
        "error %": _rms_percent(found_n - true_n),
        "with its own factor %": _rms_percent(fit_gain(found_n, true_n) * found_n - true_n),
        "above the threshold %": _rms_percent(np.where(gate, found_n, 0) - true_n),
        "loop %": loop_percent(true_n, found_n, course),
        "at no load %": 100 * float(np.abs(found_n[resting]).mean()) / RANGE_N,
        "false contact, % of scans": 100 * float((found_n[resting] > CLAIM_N).mean()),
        "past the threshold, % of scans": 100 * float(gate[resting].mean()),
        "loaded but missed, % of scans": 100 * float((~gate[loaded]).mean()),
    }


def loop_percent(true_n: NDArray[np.floating], found_n: NDArray[np.floating], course: Course) -> float:
    """Return the largest difference between press and release at equal true force, in [% of RANGE_N].

    Both branches are interpolated linearly between scans; the tenths next to their turning points are left out.
    """
    at_n = np.linspace(0.1, 0.9, 33) * true_n.max()
    ways: list[NDArray[np.float64]] = []
    for phase in (0, 2):
        way = np.flatnonzero(course.phase(phase))
        way = way[np.argsort(true_n[way], kind="stable")]
        ways.append(np.interp(at_n, true_n[way], found_n[way]))
    return 100 * float(np.abs(ways[0] - ways[1]).max()) / RANGE_N


def volume_mm3(patterns: NDArray[np.floating], scale: int) -> NDArray[np.floating]:
    """Return the sum of patterns (n, H, W) in [mm] over their area, (n,) in [mm3]."""
    return metrics.volume_mm3(patterns, USPA44.pixel_pitch_mm(scale))


def _rms_percent(error_n: NDArray[np.floating]) -> float:
    return 100 * float(np.sqrt(np.mean(error_n**2))) / RANGE_N


_TAPS: Final = 4
_ANGLE: Final = 1
"""Index of the test angle at which each surface is pressed: 30 degrees, the paper's target."""
_ZEROED: Final = Nuisances().without("thermal_drift_counts", "earth_field_counts")
CONDITIONS: Final = {"just zeroed": _ZEROED, "drifted": Nuisances()}


@dataclass(frozen=True, slots=True)
class Gauge:
    """Quantity that rises with the force, (n,), with its factor to newtons: least squares, on `known` scans."""

    name: str
    measure: Callable[[Scans], NDArray[np.floating]]
    cost: Row
    newtons_per_unit: float

    @classmethod
    def fitted(cls, name: str, measure: Callable[[Scans], NDArray[np.floating]], cost: Row, known: Scans) -> "Gauge":
        """Return the gauge with the least-squares factor to these scans' forces."""
        return cls(name, measure, cost, fit_gain(measure(known), known.force_n))

    def force_n(self, scans: Scans) -> NDArray[np.floating]:
        """Return forces (n,) in [N]."""
        return self.newtons_per_unit * self.measure(scans)


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `force-recovery`; the full run takes some minutes once the networks are there."""
    data = mixed(bench)
    course = Course(20.0 if bench.quick else 100.0)
    known = training_presses(data, 50 if bench.quick else 600)
    quantities: list[tuple[str, Callable[[Scans], NDArray[np.floating]], Row]] = [
        ("summed z", lambda scans: scans.windows[:, 0, 2].sum(axis=(1, 2)), {"parameters": 1, "MMAC": 0.0}),
        *((one.name, _volume_of(one), one.cost) for one in compact_methods(bench, data, ("stsr", "mtsr4"))),
        ("true pattern", lambda scans: scans.volume_mm3, {}),
    ]
    gauges = [Gauge.fitted(name, measure, cost, known) for name, measure, cost in quantities]
    sequences = bench.held_out("test").newest(_TAPS)
    sequences = sequences.pick(np.arange(_ANGLE, len(sequences), len(TARGET_ANGLES_DEG)))

    rows: list[Row] = []
    by_surface: list[Row] = []
    shown: dict[str, tuple[Scans, list[NDArray[np.floating]]]] = {}
    for condition, nuisances in CONDITIONS.items():
        figures: dict[str, list[dict[str, float]]] = {gauge.name: [] for gauge in gauges}
        for number in tracked(range(len(sequences)), condition, "press"):
            scans = pressed(sequences, number, course, nuisances)
            gate = contact(scans, course)
            found_n = [gauge.force_n(scans) for gauge in gauges]
            for gauge, force_n in zip(gauges, found_n, strict=True):
                figures[gauge.name].append(errors(scans.force_n, force_n, gate, course))
            shown.setdefault(condition, (scans, found_n))
        for gauge in gauges:
            row: Row = {"nuisances": condition, "model": gauge.name}
            for label in figures[gauge.name][0]:
                values = np.array([press[label] for press in figures[gauge.name]])
                row[label] = with_interval(values, np.arange(len(values)))
            rows.append(row | {"N per unit": gauge.newtons_per_unit} | gauge.cost)
        for i, name in enumerate(sequences.surfaces):
            cells: Row = {f"{gauge.name} error %": round(figures[gauge.name][i]["error %"], 2) for gauge in gauges}
            by_surface.append({"nuisances": condition, "surface": str(name)} | cells)

    report = Report("force-recovery", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{len(sequences)} surfaces at the held-out position, each pressed to {TEST_FORCE_N:g} N (or as deep as may "
        f"be) in {PRESS_S:g} s, held {HOLD_S:g} s, released in {RELEASE_S:g} s, then {REST_S:g} s at no load, at "
        f"{course.rate_hz:g} scans a second. Every press is read by a sensor of its own, whose lag goes through the "
        "whole course. `just zeroed` is without drift and earth field, `drifted` with all nuisances. One factor per "
        f"method from {len(known.force_n)} training presses on sensors just zeroed, no offset anywhere. `true pattern` "
        "is what a pattern without error would give."
    )
    report.say(
        f"Errors in % of {RANGE_N:g} N: RMS over the whole course, with the common factor and with the one that suits "
        "the press best, which leaves out what shape and gain do to the factor. Loop: largest difference between press "
        "and release at equal true force. At no load: mean |force|, and false contacts: scans whose pattern sums up to "
        f"more than {CLAIM_N:g} N, and scans that pass the runtime's contact threshold ({ON_COUNTS:g} counts of summed "
        "z), below which no pattern is made; that threshold misses loaded scans, too."
    )
    report.table(rows, "Force recovery, means over presses with 95 % intervals.")
    report.table(by_surface, "RMS errors over the course in % of the range, by surface.", "surfaces")
    with report.figure(size=(13, 8)) as figure:
        axes = figure.subplots(len(shown), 2, width_ratios=(3, 2), squeeze=False)
        for (over_time, loop), (condition, (scans, found_n)) in zip(axes, shown.items(), strict=True):
            over_time.plot(course.time_s, scans.force_n, "k", label="true")
            loop.plot([0, scans.force_n.max()], [0, scans.force_n.max()], "k", linewidth=0.8)
            for gauge, force_n in zip(gauges, found_n, strict=True):
                over_time.plot(course.time_s, force_n, linewidth=1, label=gauge.name)
                loop.plot(scans.force_n, force_n, linewidth=1)
            title = f"{sequences.surfaces[0]}, {condition}"
            over_time.set(title=title, xlabel="time [s]", ylabel="force [N]")
            loop.set(xlabel="true force [N]", ylabel="force found [N]")
        axes[0, 0].legend()
    return report.write()


def training_presses(data: PressSet, presses: int) -> Scans:
    """Return training presses, read by sensors that were just zeroed."""
    picked = data.pick(np.random.default_rng([SEED, 1]).integers(len(data), size=presses)).with_taps(_TAPS)
    readings = read_presses(picked, _ZEROED, SEED)
    return Scans(readings, picked.force_n[:, 2], volume_mm3(picked.patterns.astype(np.float32), data.scale))


def _volume_of(network: Method) -> Callable[[Scans], NDArray[np.floating]]:
    return lambda scans: volume_mm3(network.patterns(scans.windows), SCALE)
