"""What the runtime says about one scan."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Event, Note, joined
from edge.perception.wrench import Wrench
from firmware_bridge.links.base import SourceKind
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift

MADE: Final = (
    *("state", "pattern", "deviation", "area_mm2", "centroid_mm", "interval_mm"),
    *("expected_rmse_mm", "another_tap", "traction", "wrench", "wrench_origin"),
)
"""Of a result, what is made of a pattern."""

State = Literal["zeroing", "incomplete", "idle", "contact", "dropped"]
Filled = Literal["neighbours"]
WrenchOrigin = Literal["calibrated", "nominal"]


@dataclass(frozen=True, slots=True)
class Result:
    """One scan and what was made of it; there is one for every scan, whatever its state.

    Attributes:
        scan: as it came.
        source: what kind of source it came from; "emulated" is not a sensor.
        model: name of the model.
        state: "zeroing" while there is no baseline, "incomplete" when a taxel was not heard yet, or more are dead than
            can be made up for, "idle" without contact, "contact" with a pattern, "dropped" when there was contact but
            a newer scan was already waiting.
        contact: None while it cannot be known.
        taps_used: taps that the pattern was made from; 0 without contact. Fewer than there were where no more were
            expected to help.
        pattern: (H, W) float32 in `pattern_unit`, or None.
        pattern_unit: unit of the pattern.
        deviation: (H, W) float32, standard deviation of each pixel of the pattern, in `pattern_unit`; None without a
            pattern, or where the model gives none.
        zeroed: (3, rows, cols) float32, each taxel's newest reading over the baseline in counts, along the pad's axes,
            NaN where it was not zeroed; those of dead taxels as they read. None without a baseline.
        window: (taps, 3, rows, cols) float32, the taps that the pattern is made from, newest first, as `zeroed` with
            something for dead taxels; None without contact.
        force_counts: summed z over the baseline, or None while it cannot be known.
        force_n: the same in [N], if a calibration was given; else the vendor's z force, where the scan has one.
        area_mm2: touched area of the pattern, in [mm2].
        centroid_mm: x, y of the touched area's centroid from the sensor's centre, x to the right
            and y down, in [mm].
        interval_mm: how far a touched pixel may be off: half of the interval that holds 90 % of pixels, mean over the
            touched ones, in [mm]; None without a deviation.
        traction: (3, h, w) float32, force on the pad per area along x, y and z, z into the pad, over the same face as
            the pattern, in [kPa]; None without a pattern, or where the model gives none.
        wrench: the traction summed up, see edge.perception.wrench; None without.
        wrench_origin: "calibrated" where the model was told the sensor's counts per newton, else "nominal": in the
            sensitivity that it was trained for, which is not this sensor's own; None without a wrench.
        reused_from: number of the scan whose pattern this is, where nothing had changed beyond noise since; else None.
        expected_rmse_mm: RMS error that patterns so doubtful had on taps not trained on, in [mm]; None where not known.
        another_tap: whether another tap is expected to lower that error enough to be worth it; None where the model
            takes no further tap, or it is not known.
        run_time_us: of the inference, of all sensors' that ran in one call, scaling of the input included, in [us];
            None where the pattern was there already.
        latency_us: from the read that gave the scan's last byte to the pattern being ready, in [us]; what the adapter
            and the kernel took before that read is not in it. None without a pattern.
        baseline: subtracted from the scan, or None.
        baseline_age_s: how long ago the baseline was taken, in [s]; None also where a clock was wrong then.
        drift: what of the baseline was followed since it was taken, and which step in rest level was not.
        dead: taxels that are not believed, row-major from the top left, and why: "silent", "saturated", "stuck", "far"
            (reads what no contact makes) or "unzeroed"; empty where all are. A pattern made meanwhile is made without
            them.
        filled: what stood for the dead ones: an estimate from their "neighbours"; None where none is dead, or there is
            no pattern.
        notes: what the user should know, such as why zeroing started over.
        events: what happened before this scan: taps were forgotten, zeroing was done or refused, the rest level made a
            step, another model makes the patterns.
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
    run_time_us: float | None = None
    latency_us: float | None = None
    baseline: Baseline | None = None
    baseline_age_s: float | None = None
    drift: Drift | None = None
    dead: Mapping[int, str] = field(default_factory=dict)
    filled: Filled | None = None
    notes: tuple[Note, ...] = ()
    events: tuple[Event, ...] = ()

    @property
    def note(self) -> str | None:
        """The notes in one line, for a person; None without any."""
        return joined(self.notes)

    @property
    def event(self) -> str | None:
        """The events in one line, for a person; None without any."""
        return joined(self.events)

    def baseline_text(self) -> str:
        """Which baseline, how old."""
        if self.baseline is None:
            return "no baseline"
        if self.baseline_age_s is None:
            return f"baseline {self.baseline.id} of unknown age"
        return f"baseline {self.baseline.id} {age_text(self.baseline_age_s)} old"


def age_text(age_s: float) -> str:
    """An age in [s], in seconds, minutes or hours."""
    return f"{age_s:.0f} s" if age_s < 600 else f"{age_s / 60:.0f} min" if age_s < 36000 else f"{age_s / 3600:.0f} h"


def mask_bits(taxels: NDArray[np.bool_]) -> int:
    """A (rows, cols) mask as a number: bit i is taxel i, row-major from the top left."""
    return _bits(taxels.tobytes())


@lru_cache(maxsize=256)  # most scans have one of a few masks, and numpy takes ten times as long on sixteen taxels
def _bits(taxels: bytes) -> int:
    return int.from_bytes(np.packbits(np.frombuffer(taxels, dtype=np.bool_), bitorder="little").tobytes(), "little")
