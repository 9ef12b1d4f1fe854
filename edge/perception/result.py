"""Result of the runtime for one scan."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Event, Note, joined
from edge.perception.pattern_check import REASON_TEXTS, Reason
from edge.perception.wrench import Wrench
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses import PadPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift

State = Literal["zeroing", "incomplete", "baseline_in_doubt", "idle", "contact", "dropped"]
Filled = Literal["neighbours"]
WrenchOrigin = Literal["calibrated", "nominal"]


class NextTap(NamedTuple):
    """Proposal for the next tap."""

    dx_mm: float  # place of the pad along x in the newest tap's axes
    dy_mm: float  # the same along y
    turn_deg: float  # turn of the pad from the newest tap, from x to y
    target: PadPose | None = None  # the same pose in the object's plane


@dataclass(frozen=True, slots=True)
class Result:
    """One scan and what was computed from it; every scan has one, whatever its state.

    Attributes that are not listed here are fields of a record: `edge.perception.result_fields` describes them. None
    stands for an unknown or missing value.

    Attributes:
        scan: the scan as it arrived.
        pattern: (H, W) float32 in `pattern_unit`, as is `deviation`; `traction` is (3, h, w) float32 in [kPa].
        zeroed: (3, rows, cols) float32, each taxel's newest reading over the baseline in counts, along the pad's axes,
            NaN if it was not zeroed; dead taxels as they read. None without a baseline.
        window: (taps, 3, rows, cols) float32, the taps that the pattern is made from, newest first, as `zeroed` with
            estimates for dead taxels; None without contact.
        pose: of the pad at this scan, in the object's plane; None where it is not available.
        poses: (taps, 5) float32, poses of the same taps as `window` in the axes of the newest tap's pad: dx and dy in
            [mm], turn in [deg], and their standard deviations; None for a model that takes no poses.
        wrench: sums of the traction over the pad, see edge.perception.wrench.
        baseline: subtracted from the scan.
        drift: drift that was followed since the baseline was taken, and the step in rest level that was not.
        dead: dead taxels, row-major from the top left, and the reason of each; empty if all are alive.
        notes: remarks for the user, such as why zeroing started over.
        events: events before this scan: taps were forgotten, zeroing was done or refused, the rest level made a step.
    """

    scan: Scan
    source: SourceKind
    model: str
    state: State
    contact: bool | None = None
    taps_used: int = 0
    pattern: NDArray[np.float32] | None = None
    pattern_unit: str = ""
    deviation: NDArray[np.float32] | None = None
    zeroed: NDArray[np.float32] | None = None
    window: NDArray[np.float32] | None = None
    pose: PadPose | None = None
    poses: NDArray[np.float32] | None = None
    force_counts: float | None = None
    force_n: float | None = None
    area_mm2: float | None = None
    centroid_mm: tuple[float, float] | None = None
    interval_mm: float | None = None
    traction: NDArray[np.float32] | None = None
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
    dead: Mapping[int, str] = field(default_factory=dict)
    filled: Filled | None = None
    gains_certainty: float | None = None
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
        """Reason for which the pattern is not to be believed, for a person; None where it is, or is not checked."""
        return None if self.untrusted_reason is None else REASON_TEXTS[self.untrusted_reason]

    def baseline_text(self) -> str:
        """Return id and age of the baseline in words."""
        if self.baseline is None:
            return "no baseline"
        if self.baseline_age_s is None:
            return f"baseline {self.baseline.id} of unknown age"
        return f"baseline {self.baseline.id} {age_text(self.baseline_age_s)} old"


def age_text(age_s: float) -> str:
    """Return an age in [s] as text in seconds, minutes or hours."""
    return f"{age_s:.0f} s" if age_s < 600 else f"{age_s / 60:.0f} min" if age_s < 36000 else f"{age_s / 3600:.0f} h"


def mask_bits(taxels: NDArray[np.bool_]) -> int:
    """Return a (rows, cols) mask as a number: bit i is taxel i, row-major from the top left."""
    return _bits(taxels.tobytes())


@lru_cache(maxsize=256)  # most scans have one of a few masks, and numpy takes ten times as long on sixteen taxels
def _bits(taxels: bytes) -> int:
    return int.from_bytes(np.packbits(np.frombuffer(taxels, dtype=np.bool_), bitorder="little").tobytes(), "little")
