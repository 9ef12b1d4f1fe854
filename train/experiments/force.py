"""Figs. 14 and 15: error by contact force, small forces included, and force through press, hold and release.

PSNR is taken against one full scale for all, so it is highest for the shallowest patterns. The effect of the force on
shapes shows in the error relative to the truth's own RMS, and in SSIM with the truth's own peak as full scale.

A pattern's deformation summed over its area becomes newtons by one factor, fitted on training presses. There are no
offsets, and no course is shifted, so that drift, lag and residual loads remain visible.

Source: Wu and Liu 2024, Figs. 14 and 15.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import log
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_gain
from edge.evaluation.metrics import contact_iou, psnr_db, ssim, volume_mm3
from edge.perception.contact_options import ON_COUNTS
from edge.perception.tap_tracker import TapTracker
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.paper_taps import PaperTaps, between_frames, windows
from train.data.press_batches import read_presses
from train.data.presses import SEED, PressSet
from train.experiments.paper_tables import classical_methods, compact_methods, mixed
from train.experiments.workbench import Figures, Method, Workbench
from train.freeze import SCALE, TEST_FORCE_N
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.sensor_noise import Nuisances, apply_nuisances, read_windows
from train.report import Report, Row, with_interval
from train.surfaces.poses import TARGET_ANGLES_DEG

EDGES_N: Final = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 8.0)


class Bin(NamedTuple):
    """Scans of one range of forces: windows (n, K, 3, rows, cols) in zeroed counts, truth (n, H, W), sequences (n,).

    The newest tap is pressing, the earlier ones are at their ends.
    """

    force_n: tuple[float, float]
    windows: NDArray[np.float32]
    patterns: NDArray[np.float32]
    touching: NDArray[np.bool_]
    tap: NDArray[np.int64]


def small_forces(bench: Workbench, report: Report) -> None:
    """Measure errors by contact force; a few minutes once the networks are there."""
    data = mixed(bench)
    methods = compact_methods(bench, data, ("stsr", "mtsr2", "mtsr4"))
    methods += classical_methods(bench, data, ("linear map", "bilinear"))
    sequences = bench.held_out("test").at_scale(SCALE)
    draws = 1 if bench.quick else 4
    found = [scans_between(sequences, bounds, draws, [SEED, number]) for number, bounds in enumerate(pairwise(EDGES_N))]
    bins = [scans for scans in found if scans is not None]
    rows = [_row(method, scans) for scans in tracked(bins, "forces", "range") for method in methods]
    report.say(
        f"The {len(sequences)} test taps, newest scan somewhere on its press, earlier taps at their ends of "
        f"{TEST_FORCE_N:g} N; forces drawn evenly over their logarithm, {draws} a tap and "
        "range, every scan read by a sensor of its own with all nuisances at their defaults. Small shapes are as deep "
        f"as they may ({MAX_INDENTATION_MM} mm) before high forces, so those have fewer taps. PSNR and SSIM are "
        "against the declared full scale: the less there is, the better they look. Relative error is RMS error over "
        "the truth's RMS, and SSIM at own scale has each truth's peak as full scale: they measure errors of shape."
    )
    report.table(rows, "Errors by contact force, with 95 % intervals by tap.")


def scans_between(sequences: PaperTaps, force_n: tuple[float, float], draws: int, seed: Sequence[int]) -> Bin | None:
    """Return scans of sequences that reach such forces, drawn log-uniformly; None if no sequence does."""
    rng = np.random.default_rng([*seed, 0])
    index = np.repeat(np.arange(len(sequences)), draws)
    wanted_n = np.exp(rng.uniform(log(force_n[0]), log(force_n[1]), len(index)))
    end_n = sequences.force_n[index, 0, -1]
    reached = end_n >= 0.99 * wanted_n  # some presses reach their largest indentation before
    if not reached.any():
        return None
    index, wanted_n = index[reached], wanted_n[reached]
    taps_n = np.full((len(index), sequences.taps), TEST_FORCE_N)
    taps_n[:, 0] = wanted_n
    readings, patterns = windows(sequences, index, taps_n, Nuisances(), [*seed, 1])
    return Bin(force_n, readings, patterns, sequences.touching[index], index)


def errors(method: Method, scans: Bin) -> Figures:
    """Return every metric of every scan, (n,) each."""
    patterns, truth = method.patterns(scans.windows).astype(np.float64), scans.patterns.astype(np.float64)
    peak = truth.max(axis=(1, 2), keepdims=True)
    return {
        "psnr_db": psnr_db(patterns, truth, MAX_INDENTATION_MM),
        "ssim": ssim(patterns, truth, MAX_INDENTATION_MM),
        "ssim_own": ssim(patterns / peak, truth / peak, 1.0),
        "relative_percent": 100 * np.sqrt(np.mean((patterns - truth) ** 2, (1, 2)) / np.mean(truth**2, (1, 2))),
        "contact_iou": contact_iou(patterns, scans.touching, method.contact_level),
    }


def _row(method: Method, scans: Bin) -> Row:
    found = errors(method, scans)
    return {
        "force N": "{:g}..{:g}".format(*scans.force_n),
        "scans": len(scans.tap),
        "taps": len(np.unique(scans.tap)),
        "model": method.name,
        "PSNR dB": with_interval(found["psnr_db"], scans.tap),
        "SSIM": round(float(found["ssim"].mean()), 4),
        "SSIM at own scale": with_interval(found["ssim_own"], scans.tap, 3),
        "relative error %": with_interval(found["relative_percent"], scans.tap, 1),
        "IoU": round(float(found["contact_iou"].mean()), 4),
        **method.cost,
    }


PRESS_S, HOLD_S, RELEASE_S, REST_S = 2.0, 5.0, 1.0, 2.0
PRESS, HOLD, RELEASE, REST = range(4)
_ENDS_S: Final = np.cumsum([PRESS_S, HOLD_S, RELEASE_S, REST_S])
RANGE_N: Final = TEST_FORCE_N
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(SCALE)
CLAIM_N: Final = 0.02 * RANGE_N  # volume force above which a pattern claims a contact, in [N]: 2 % of the range


class Course:
    """Scans of one press at a rate, which starts from a free pad at 0 s.

    `time_s` (t,) are their times in [s], `share` those of the set force, and `phase` is PRESS, HOLD, RELEASE or REST,
    each with its end but not its start.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.time_s: NDArray[np.float64] = np.arange(1, round(_ENDS_S[-1] * rate_hz) + 1) / rate_hz
        self.share: NDArray[np.float64] = np.interp(self.time_s, [0, *_ENDS_S], [0, 1, 1, 0, 0])
        self.phase: NDArray[np.int64] = np.searchsorted(_ENDS_S, self.time_s - 0.5 / rate_hz)


class Scans(NamedTuple):
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
    whole_mm3 = volume_mm3(sequences.patterns_at(index, end[:, 0]), USPA44.pixel_pitch_mm(sequences.scale))
    return Scans(
        windows=np.concatenate([newest[:, None], np.broadcast_to(earlier, (len(newest), *earlier.shape))], axis=1),
        force_n=sequences.force_n[number, 0, -1] * share[0],
        volume_mm3=whole_mm3 * course.share,  # flat contacts: in proportion to the indentation
    )


def contact(scans: Scans, course: Course) -> NDArray[np.bool_]:
    """Return the scans (n,) in which the runtime detects a contact."""
    tracker = TapTracker(taps=1)
    times_ns = np.rint(course.time_s * 1e9).astype(np.int64)
    touched: list[bool] = []
    for scan, now_ns in zip(scans.windows[:, 0], times_ns, strict=True):
        tracker.push(scan, int(now_ns))
        touched.append(tracker.contact)
    return np.array(touched)


def course_errors(
    true_n: NDArray[np.floating], found_n: NDArray[np.floating], gate: NDArray[np.bool_], course: Course
) -> dict[str, float]:
    """Return the figures of one press, in [% of RANGE_N] or in [% of scans]."""
    resting = course.phase == REST
    return {
        "error %": _rms_percent(found_n - true_n),
        "with its own factor %": _rms_percent(fit_gain(found_n, true_n) * found_n - true_n),
        "above the threshold %": _rms_percent(np.where(gate, found_n, 0) - true_n),
        "loop %": loop_percent(true_n, found_n, course),
        "at no load %": 100 * float(np.abs(found_n[resting]).mean()) / RANGE_N,
        "false contact, % of scans": 100 * float((found_n[resting] > CLAIM_N).mean()),
        "past the threshold, % of scans": 100 * float(gate[resting].mean()),
        "loaded but missed, % of scans": 100 * float((~gate[~resting]).mean()),
    }


def loop_percent(true_n: NDArray[np.floating], found_n: NDArray[np.floating], course: Course) -> float:
    """Return the largest difference between press and release at equal true force, in [% of RANGE_N].

    Both branches are interpolated linearly between scans; the tenths next to their turning points are left out.
    """
    at_n = np.linspace(0.1, 0.9, 33) * true_n.max()
    ways: list[NDArray[np.float64]] = []
    for phase in (PRESS, RELEASE):
        way = np.flatnonzero(course.phase == phase)
        way = way[np.argsort(true_n[way], kind="stable")]
        ways.append(np.interp(at_n, true_n[way], found_n[way]))
    return 100 * float(np.abs(ways[0] - ways[1]).max()) / RANGE_N


def _rms_percent(error_n: NDArray[np.floating]) -> float:
    return 100 * float(np.sqrt(np.mean(error_n**2))) / RANGE_N


_TAPS: Final = 4
_ZEROED: Final = Nuisances().without("thermal_drift_counts", "earth_field_counts")


def recovery(bench: Workbench, report: Report) -> None:
    """Measure the force that patterns state through press, hold and release; some minutes with the networks there."""
    data = mixed(bench)
    course = Course(20.0 if bench.quick else 100.0)
    known = training_presses(data, 50 if bench.quick else 600)
    networks = compact_methods(bench, data, ("stsr", "mtsr4"))
    measures: dict[str, Callable[[Scans], NDArray[np.floating]]] = {
        "summed z": lambda scans: scans.windows[:, 0, 2].sum(axis=(1, 2)),
        **{network.name: _volume_of(network) for network in networks},
        "true pattern": lambda scans: scans.volume_mm3,
    }
    costs: dict[str, Row] = {"summed z": {"parameters": 1, "MMAC": 0.0}, "true pattern": {}}
    costs |= {network.name: network.cost for network in networks}
    newtons_per_unit = {name: fit_gain(measure(known), known.force_n) for name, measure in measures.items()}
    sequences = bench.held_out("test").newest(_TAPS)
    sequences = sequences.pick(np.arange(1, len(sequences), len(TARGET_ANGLES_DEG)))  # at 30 degrees, as in the paper

    rows: list[Row] = []
    for condition, nuisances in {"just zeroed": _ZEROED, "drifted": Nuisances()}.items():
        figures: dict[str, list[dict[str, float]]] = {name: [] for name in measures}
        for number in tracked(range(len(sequences)), condition, "press"):
            scans = pressed(sequences, number, course, nuisances)
            gate = contact(scans, course)
            for name, measure in measures.items():
                found_n = newtons_per_unit[name] * measure(scans)
                figures[name].append(course_errors(scans.force_n, found_n, gate, course))
        for name, presses in figures.items():
            row: Row = {"nuisances": condition, "model": name}
            for label in presses[0]:
                row[label] = with_interval(np.array([press[label] for press in presses]), np.arange(len(presses)))
            rows.append(row | {"N per unit": newtons_per_unit[name]} | costs[name])
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


def training_presses(data: PressSet, presses: int) -> Scans:
    """Return training presses, read by sensors that were just zeroed."""
    picked = data.pick(np.random.default_rng([SEED, 1]).integers(len(data), size=presses)).with_taps(_TAPS)
    readings = read_presses(picked, _ZEROED, SEED)
    return Scans(readings, picked.force_n[:, 2], volume_mm3(picked.patterns.astype(np.float32), _PIXEL_MM))


def _volume_of(network: Method) -> Callable[[Scans], NDArray[np.floating]]:
    return lambda scans: volume_mm3(network.patterns(scans.windows), _PIXEL_MM)
