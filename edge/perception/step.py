"""Draft of the result of one scan: the stages of its sensor fill it in turn, and it is frozen once, at the end."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import OLD_NS, Event, Note, waited_note
from edge.perception.pattern_check import Reason
from edge.perception.result import Filled, NextTap, Result, State, WrenchOrigin
from edge.perception.wrench import Wrench
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses import PadPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift

_NONE_DEAD: Final[Mapping[int, str]] = {}


class Origin(NamedTuple):
    """Fields that all results of a run have in common."""

    source: SourceKind
    model: str
    pattern_unit: str


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
    """Pattern of a window, and everything that follows from it: fields of a result, under their names there."""

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
    """Draft of one scan's result: fields of it under their names there, and what the stages tell each other.

    Attributes:
        readings: (3, rows, cols) in counts over the baseline, with estimates for dead taxels.
        doubted: drift or an old baseline explains the readings as well as a touch.
        due: taps of which a pattern is due; None where none is.
    """

    readings: NDArray[np.float32] | None = None
    doubted: bool = False
    due: Window | None = None
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
    dead: Mapping[int, str] = _NONE_DEAD
    gains_certainty: float | None = None
    notes: tuple[Note, ...] = ()
    events: tuple[Event, ...] = ()

    def __init__(self, scan: Scan, origin: Origin) -> None:
        self.scan, self._origin = scan, origin
        self.state: State = "zeroing"

    def overtake(self) -> None:
        """Leave the step without its pattern, since a newer scan of its sensor has come."""
        if not self.doubted:
            self.state = "dropped"

    def ready(self, done_ns: int) -> None:
        """State when the pattern was ready, on the clock of the scans, in [ns]."""
        waited_ns = done_ns - self.scan.time_ns
        self.latency_us = waited_ns / 1e3
        if waited_ns > OLD_NS:
            self.notes = (*self.notes, waited_note(waited_ns))

    def freeze(self) -> Result:
        """Return the result."""
        # What no stage has set is not in the dictionary, and has its default in the result.
        values: dict[str, Any] = {name: value for name, value in vars(self).items() if name not in _OF_STAGES}
        due, made = self.due, self.estimate
        if made is not None:
            values |= vars(made)
            if self.reused_from is not None and due is not None:  # the newest reading is this scan's own
                values["window"] = np.concatenate([due.counts[:1], made.window[1:]])
        elif due is not None:
            values |= {"taps_used": due.taps, "window": due.counts[: due.taps], "poses": due.poses}
        if self.doubted:
            values |= {"trusted": False, "untrusted_reason": "baseline"}
        return Result(**values, **self._origin._asdict())


_OF_STAGES: Final = frozenset({"readings", "doubted", "due", "estimate", "_origin"})
