"""Result of one scan, its draft, which the stages fill and which is frozen once, and the pattern of a scan before."""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import OLD_NS, Event, Note, joined
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses import PadPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift

State = Literal["zeroing", "incomplete", "baseline_in_doubt", "idle", "contact", "dropped"]
Filled = Literal["neighbours"]
WrenchOrigin = Literal["calibrated", "nominal"]
Reason = Literal["stuck", "unfamiliar", "unexplained", "sensor", "uncertain", "beyond", "pad", "baseline"]
# Why a pattern is not to be believed, each with what to look for.
REASON_TEXTS: Final[dict[Reason, str]] = {
    "stuck": "a taxel repeats itself (stuck?)",
    "unfamiliar": "readings like no contact (a magnet or steel near? the id map? the axes?)",
    "unexplained": "the pattern does not explain its readings (an unusual shape? another pad?)",
    "sensor": "one contact after another reads like none (a magnet or steel near? the id map? the sensor file?)",
    "uncertain": "the model expects a large error (a light contact? fine detail? press harder, or elsewhere)",
    "beyond": "a press deeper or stronger than the model was trained on (press less)",
    "pad": "the sensor file's pad is far outside those that the model was trained on (the file? train for this pad)",
    "baseline": "the baseline is in doubt (free the pad and zero again)",
}


class Wrench(NamedTuple):
    """Total force and torque on a pad, x, y, z; the centre and the ratio are None if hardly anything presses."""

    force_n: tuple[float, float, float]
    torque_n_mm: tuple[float, float, float]  # through the middle of the face; the last is the twist
    # From the middle of the face: where the z force alone gives the torques about x and y.
    centre_of_pressure_mm: tuple[float, float] | None
    shear_ratio: float | None  # tangential over normal force, whatever the sensor's counts per newton


class NextTap(NamedTuple):
    """Proposal for the next tap."""

    dx_mm: float  # place of the pad along x in the newest tap's axes
    dy_mm: float  # the same along y
    turn_deg: float  # turn of the pad from the newest tap, from x to y
    target: PadPose | None = None  # the same pose in the object's plane


@dataclass(frozen=True, slots=True)
class Result:
    """One scan and what was computed from it; every scan has one, whatever its state; None stands for unknown.

    The table of `edge.perception.record_fields` describes all that is a field of a record.
    """

    scan: Scan
    source: SourceKind
    model: str
    state: State
    contact: bool | None = None
    taps_used: int = 0
    pattern: NDArray[np.float32] | None = None  # (H, W), as is the deviation
    pattern_unit: str = ""
    deviation: NDArray[np.float32] | None = None
    # (3, rows, cols): newest readings over the baseline, along the pad's axes; NaN if not zeroed, dead taxels as read
    zeroed: NDArray[np.float32] | None = None
    window: NDArray[np.float32] | None = None  # (taps, 3, rows, cols), newest first, with estimates for dead taxels
    pose: PadPose | None = None
    poses: NDArray[np.float32] | None = None  # (taps, 5); None for a model that takes none
    force_counts: float | None = None
    force_n: float | None = None
    area_mm2: float | None = None
    centroid_mm: tuple[float, float] | None = None
    interval_mm: float | None = None
    traction: NDArray[np.float32] | None = None  # (3, h, w) in [kPa]
    wrench: Wrench | None = None
    wrench_origin: WrenchOrigin | None = None
    reused_from: int | None = None
    expected_rmse_mm: float | None = None
    another_tap: bool | None = None
    next_tap: NextTap | None = None
    mismatch: float | None = None
    tap_mismatch: tuple[float, ...] | None = None
    taps_dropped: int | None = None
    trusted: bool | None = None
    untrusted_reason: Reason | None = None
    run_time_us: float | None = None
    latency_us: float | None = None
    baseline: Baseline | None = None
    baseline_age_s: float | None = None
    drift: Drift | None = None
    dead: Mapping[int, str] = field(default_factory=dict)  # taxels, row-major from the top left, and the reason of each
    filled: Filled | None = None
    gains_certainty: float | None = None
    scale_error: float | None = None
    notes: tuple[Note, ...] = ()
    events: tuple[Event, ...] = ()

    def __repr__(self) -> str:
        made = [f"scan {self.scan.number} of sensor {self.scan.sensor}, {self.source}: {self.state}"]
        if self.force_counts is not None:
            made.append(f"{self.force_counts:.0f} counts")
        if self.pattern is not None:
            made.append(f"pattern {self.pattern.shape} to {self.pattern.max():.3f} {self.pattern_unit}")
        if self.trusted is not None:
            made.append("trusted" if self.trusted else f"not trusted ({self.untrusted_reason})")
        return f"<Result of {', '.join(made)}>"

    @property
    def note(self) -> str | None:
        """Notes in one line, for a person; None without any."""
        return joined(self.notes) if self.notes else None

    @property
    def event(self) -> str | None:
        """Events in one line, for a person; None without any."""
        return joined(self.events) if self.events else None

    @property
    def untrusted_text(self) -> str | None:
        """Why the pattern is not to be believed, for a person; None where it is, or is not checked."""
        return None if self.untrusted_reason is None else REASON_TEXTS[self.untrusted_reason]

    def baseline_text(self) -> str:
        """Return id and age of the baseline."""
        if self.baseline is None:
            return "no baseline"
        return f"baseline {self.baseline.id} {age_text(self.baseline_age_s)}"


def age_text(age_s: float | None) -> str:
    """Return how old something is, in seconds, minutes or hours."""
    if age_s is None:
        return "of unknown age"
    age = f"{age_s:.0f} s" if age_s < 600 else f"{age_s / 60:.0f} min" if age_s < 36000 else f"{age_s / 3600:.0f} h"
    return f"{age} old"


def mask_bits(taxels: NDArray[np.bool_]) -> int:
    """Return a (rows, cols) mask as a number: bit i is taxel i, row-major from the top left."""
    return int.from_bytes(np.packbits(taxels, bitorder="little").tobytes(), "little")


class Window(NamedTuple):
    """Taps that a pattern is due of."""

    counts: NDArray[np.float32]  # (K, 3, rows, cols) in zeroed counts, newest tap first, zeros in place of missing ones
    taps: int  # number of taps in it
    slots: Sequence[int]  # places of these taps in the window of the sensor's tracker
    poses: NDArray[np.float32] | None  # (taps, 5) as model input; None for a model that takes no poses
    tap: int  # number of the newest tap
    made_by: Hashable  # what distinguishes the pattern from others of the same readings and poses


@dataclass
class Estimate:
    """Pattern of a window, and all that follows from it: fields of a result, under their names there."""

    taps_used: int
    window: NDArray[np.float32]
    poses: NDArray[np.float32] | None
    tap_mismatch: tuple[float, ...] | None = None
    taps_dropped: int | None = None
    pattern: NDArray[np.float32] | None = None
    deviation: NDArray[np.float32] | None = None
    traction: NDArray[np.float32] | None = None
    mismatch: float | None = None
    trusted: bool | None = None
    untrusted_reason: Reason | None = None
    area_mm2: float | None = None
    centroid_mm: tuple[float, float] | None = None
    interval_mm: float | None = None
    expected_rmse_mm: float | None = None
    another_tap: bool | None = None
    wrench: Wrench | None = None
    wrench_origin: WrenchOrigin | None = None


class Step:
    """Draft of one scan's result: fields of it under their names there, and what the stages tell each other."""

    readings: NDArray[np.float32] | None = None  # (3, rows, cols), as `zeroed` with estimates for dead taxels
    doubted: bool = False  # drift or an old baseline explains the readings as well as a touch
    due: Window | None = None  # taps of which a pattern is due
    estimate: Estimate | None = None

    contact: bool | None = None
    zeroed: NDArray[np.float32] | None = None
    filled: Filled | None = None
    force_counts: float | None = None
    force_n: float | None = None
    pose: PadPose | None = None
    reused_from: int | None = None
    next_tap: NextTap | None = None
    run_time_us: float | None = None
    latency_us: float | None = None
    baseline: Baseline | None = None
    baseline_age_s: float | None = None
    drift: Drift | None = None
    dead: Mapping[int, str] = MappingProxyType({})
    gains_certainty: float | None = None
    scale_error: float | None = None
    notes: tuple[Note, ...] = ()
    events: tuple[Event, ...] = ()

    def __init__(self, scan: Scan, source: SourceKind, model: str, pattern_unit: str) -> None:
        self.scan, self.source, self.model, self.pattern_unit = scan, source, model, pattern_unit
        self.state: State = "zeroing"

    def overtake(self) -> None:
        """Leave the step without its pattern, since a newer scan of its sensor has come."""
        if not self.doubted:
            self.state = "dropped"

    def freeze(self, done_ns: int | None = None) -> Result:
        """Return the result, whose pattern was ready at a time on the clock of the scans in [ns]; None if unknown."""
        if done_ns is not None:
            waited_ns = done_ns - self.scan.time_ns
            self.latency_us = waited_ns / 1e3
            if waited_ns > OLD_NS:
                late = f"this pattern was ready {waited_ns / 1e9:.2f} s after its newest reading arrived"
                self.notes = (*self.notes, Note("late", late))
        # What no stage has set is not in the dictionary, and has its default in the result.
        values: dict[str, Any] = dict(vars(self))
        for name in ("readings", "doubted", "due", "estimate"):
            values.pop(name, None)
        due, made = self.due, self.estimate
        if made is not None:
            values |= vars(made)
            if self.reused_from is not None and due is not None:  # the newest reading is this scan's own
                values["window"] = np.concatenate([due.counts[:1], made.window[1:]])
        elif due is not None:
            values |= {"taps_used": due.taps, "window": due.counts[: due.taps], "poses": due.poses}
        if self.doubted:
            values |= {"trusted": False, "untrusted_reason": "baseline"}
        return Result(**values)


NOISE_COUNTS: Final = 2.0  # standard deviation of a reading at rest: 1.7 to 2.6 in recordings
_CHANGE_COUNTS: Final = math.sqrt(2) * NOISE_COUNTS  # the same of a change, since noise is in both scans
# Change of a relative pose, in [mm] and [deg] as model input has them: a quarter of the usual errors.
MOVED: Final = np.array([0.05, 0.05, 0.25, 0.05, 0.25], dtype=np.float32)


class LastPattern(NamedTuple):
    """Estimate of a sensor's last pattern, the number of its scan, and the taps that it was made of."""

    estimate: Estimate
    scan_number: int
    made_of: Window

    def reuse(self, step: Step, due: Window) -> bool:
        """Give a step the estimate if nothing has changed beyond noise since; return whether it has it."""
        before = self.made_of
        if due.made_by != before.made_by:  # slots and poses are then as many
            return False
        if due.poses is not None and before.poses is not None and (np.abs(due.poses - before.poses) > MOVED).any():
            return False
        change = due.counts[0] - before.counts[0]
        # Noise reaches neither five of its deviations in one reading, nor 1.4 of them in the RMS of all.
        if np.maximum.reduce(np.abs(change), axis=None) > 5 * _CHANGE_COUNTS:
            return False
        if float(np.vdot(change, change)) > (1.4 * _CHANGE_COUNTS) ** 2 * change.size:
            return False
        step.estimate, step.reused_from = self.estimate, self.scan_number
        return True
