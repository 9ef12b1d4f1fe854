"""One press over time: its course, the readings of a sensor along it, and the error of an estimated force."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation import metrics
from edge.evaluation.classical_methods import fit_gain
from edge.perception.tap_tracker import TapTracker
from firmware_bridge.pad_geometry import USPA44
from train.data.generation_config import SEED
from train.data.paper_taps import PaperTaps, between_frames
from train.freeze import TEST_FORCE_N
from train.physics.sensor_noise import Nuisances, apply_nuisances, read_windows

PRESS_S, HOLD_S, RELEASE_S, REST_S = 2.0, 5.0, 1.0, 2.0
_ENDS_S: Final = np.cumsum([PRESS_S, HOLD_S, RELEASE_S, REST_S])
RANGE_N: Final = TEST_FORCE_N
CLAIM_N: Final = 0.02 * RANGE_N
"""Volume force above which a pattern claims a contact, in [N]: 2 % of the range."""


@dataclass(frozen=True, slots=True)
class Course:
    """Course of one press; the pad is free at 0 s.

    Attributes:
        rate_hz: scan rate, in [Hz].
        time_s: time of each scan, (t,), in [s]; the first is one step after 0.
        share: share of the press at each scan, (t,); 1 at its set force.
    """

    rate_hz: float
    time_s: NDArray[np.float64] = field(init=False)
    share: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        time_s = np.arange(1, round(_ENDS_S[-1] * self.rate_hz) + 1) / self.rate_hz
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "share", np.interp(time_s, [0, *_ENDS_S], [0, 1, 1, 0, 0]))

    def phase(self, number: int) -> NDArray[np.bool_]:
        """Return the scans of the press (0), hold (1), release (2) or rest (3), each with its end but not its start."""
        return np.searchsorted(_ENDS_S, self.time_s - 0.5 / self.rate_hz) == number


@dataclass(frozen=True, slots=True)
class Scans:
    """Scans with their true force and volume.

    Attributes:
        windows: (n, K, 3, rows, cols) in zeroed counts.
        force_n: (n,) in [N].
        volume_mm3: (n,) sum of the true pattern over its area, in [mm3].
    """

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
        force_n=sequences.force_at(index, share)[0],
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
        "error": _rms_percent(found_n - true_n),
        "own": _rms_percent(fit_gain(found_n, true_n) * found_n - true_n),
        "gated": _rms_percent(np.where(gate, found_n, 0) - true_n),
        "loop": loop_percent(true_n, found_n, course),
        "rest": 100 * float(np.abs(found_n[resting]).mean()) / RANGE_N,
        "false": 100 * float((found_n[resting] > CLAIM_N).mean()),
        "false gated": 100 * float(gate[resting].mean()),
        "missed": 100 * float((~gate[loaded]).mean()),
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
