"""Draft of the result of one scan: the stages of its sensor fill it in turn, and it is frozen once, at the end."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Event, Note
from edge.perception.pattern_check import Reason
from edge.perception.result import Filled, NextTap, Result, State, WrenchOrigin
from edge.perception.scan_notes import OLD_NS, waited_note
from edge.perception.wrench import Wrench
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift

_NONE_DEAD: Final[Mapping[int, str]] = {}


class Origin(NamedTuple):
    """What all results of a run have in common: the kind of their source, the name of the model, the pattern's unit."""

    source: SourceKind
    model: str
    pattern_unit: str


@dataclass(slots=True)
class Window:
    """Taps that a pattern is due of.

    Attributes:
        counts: (K, 3, rows, cols) in zeroed counts, newest tap first, zeros in place of missing ones.
        taps: number of taps in it.
        slots: places of these taps in the window of the sensor's tracker.
        poses: (taps, 5) as model input; None for a model that takes no poses.
        tap: number of the newest tap.
        made_by: what distinguishes the pattern from others of the same readings and poses.
    """

    counts: NDArray[np.float32]
    taps: int
    slots: Sequence[int]
    poses: NDArray[np.float32] | None
    tap: int
    made_by: Hashable


@dataclass(slots=True)
class Estimate:
    """What the model makes of a window, and what follows from that; the attributes are those of a result.

    Attributes:
        scan_number: of the scan that it was made from.
        taps: number of taps that it was made from.
        window: (taps, 3, rows, cols) in zeroed counts.
        poses: (taps, 5) of the same taps; None for a model that takes no poses.
    """

    scan_number: int
    taps: int
    window: NDArray[np.float32]
    poses: NDArray[np.float32] | None
    pattern: NDArray[np.float32]
    deviation: NDArray[np.float32] | None = None
    traction: NDArray[np.float32] | None = None
    tap_mismatch: tuple[float, ...] | None = None
    taps_dropped: int | None = None
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
    """Draft of one scan's result; attributes that are not listed are those of a result.

    Attributes:
        readings: (3, rows, cols) in counts over the baseline, with estimates for dead taxels.
        doubted: drift or an old baseline explains the readings as well as a touch.
        window: taps of which a pattern is due; None where none is.
        estimate: the pattern and what follows from it, once there is one.
    """

    state: State = "zeroing"
    contact: bool | None = None
    zeroed: NDArray[np.float32] | None = None
    readings: NDArray[np.float32] | None = None
    filled: Filled | None = None
    doubted: bool = False
    force_counts: float | None = None
    force_n: float | None = None
    pose: PadPose | None = None
    window: Window | None = None
    estimate: Estimate | None = None
    reused_from: int | None = None
    next_tap: NextTap | None = None
    run_time_us: float | None = None
    latency_us: float | None = None
    baseline: Baseline | None = None
    baseline_age_s: float | None = None
    drift: Drift | None = None
    dead: Mapping[int, str] = _NONE_DEAD
    gains_certainty: float | None = None
    notes: tuple[Note, ...] = ()
    events: tuple[Event, ...] = ()

    def __init__(self, scan: Scan, origin: Origin) -> None:
        self.scan = scan
        self._origin = origin

    def overtake(self) -> None:
        """Leave the step without its pattern, since a newer scan of its sensor has come."""
        if not self.doubted:
            self.state = "dropped"

    def reuse(self, estimate: Estimate) -> None:
        """Take the pattern of an earlier scan, since nothing has changed since."""
        self.estimate, self.reused_from = estimate, estimate.scan_number
        self.state = "baseline_in_doubt" if self.doubted else "contact"

    def ready(self, clock_ns: Callable[[], int] | None) -> None:
        """Note when the pattern was ready, on the clock of the scans, in [ns]; None where they have another clock."""
        if clock_ns is None or self.estimate is None:
            return
        waited_ns = clock_ns() - self.scan.time_ns
        self.latency_us = waited_ns / 1e3
        if waited_ns > OLD_NS:
            self.notes = (*self.notes, waited_note(waited_ns))

    def freeze(self) -> Result:
        """Return the result."""
        source, model, unit = self._origin
        window, made = self.window, self.estimate
        common: dict[str, Any] = {
            "contact": self.contact,
            "pattern_unit": unit,
            "zeroed": self.zeroed,
            "pose": self.pose,
            "force_counts": self.force_counts,
            "force_n": self.force_n,
            "next_tap": self.next_tap,
            "run_time_us": self.run_time_us,
            "latency_us": self.latency_us,
            "baseline": self.baseline,
            "baseline_age_s": self.baseline_age_s,
            "drift": self.drift,
            "dead": self.dead,
            "filled": self.filled,
            "gains_certainty": self.gains_certainty,
            "notes": self.notes,
            "events": self.events,
        }
        if self.doubted:
            common |= {"trusted": False, "untrusted_reason": "baseline"}
        if made is None:
            if window is not None:
                common |= {"taps_used": window.taps, "window": window.counts[: window.taps], "poses": window.poses}
            return Result(self.scan, source, model, self.state, **common)
        taps = made.window
        if self.reused_from is not None and window is not None:  # the newest reading is this scan's own
            taps = np.concatenate([window.counts[:1], made.window[1:]])
        if not self.doubted:
            common |= {"trusted": made.trusted, "untrusted_reason": made.untrusted_reason}
        return Result(
            self.scan,
            source,
            model,
            self.state,
            taps_used=made.taps,
            pattern=made.pattern,
            deviation=made.deviation,
            window=taps,
            poses=made.poses,
            area_mm2=made.area_mm2,
            centroid_mm=made.centroid_mm,
            interval_mm=made.interval_mm,
            traction=made.traction,
            wrench=made.wrench,
            wrench_origin=made.wrench_origin,
            reused_from=self.reused_from,
            expected_rmse_mm=made.expected_rmse_mm,
            another_tap=made.another_tap,
            mismatch=made.mismatch,
            tap_mismatch=made.tap_mismatch,
            taps_dropped=made.taps_dropped,
            **common,
        )
