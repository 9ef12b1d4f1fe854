"""Decision whether readings over the baseline are a touch, or whether drift, or an old baseline, explains them as well.

The shape of a reading does not tell: a flat grip moves all taxels together, and so does a pad that has warmed, or is
another one than was zeroed. What tells is how it began. A touch is quick, and begins from a rest level that was seen in
this run; or it is local, and leaves half of the pad at rest. All else over a threshold is in doubt.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from edge.perception.contact_options import RuntimeOptions
from edge.perception.event import Note, Report
from edge.perception.result import Step, age_text
from firmware_bridge.zeroing.baseline import Origin

Doubt = Literal["unseen", "outage", "held", "below", "slow", "alike", "left"]
"""Why readings are no contact: the pad was not seen at rest near its baseline in this run, or since an outage; the
recording that is played may hold something all the time; it reads far below its baseline; the readings rose no faster
than drift; all taxels changed alike, as in a field; or it is what a release has left, which warming and recovery
explain."""

NEAR_COUNTS: Final = 50.0
"""Largest reading of a taxel at rest, on any axis: more than a pad turned over in the earth's field (36) and the first
recovery after a grip (45), and less than the change of any public recording's rest level in four hours (64 to 715)."""
SEEN_SHARE: Final = 0.75  # share of the taxels at rest by which the pad is seen at rest
LOCAL_SHARE: Final = 0.5  # share of the taxels at rest beside which the others are touched
_TEXTS: Final[dict[Doubt, str]] = {
    "unseen": "most taxels are off it together, by {counts}, and the pad was not seen at rest near it in this run",
    "outage": "after an outage most taxels are off it together, by {counts}: is this another pad?",
    "held": "taken from this recording, whose readings hardly change: the pad is free, or holds something all the time",
    "below": "far below the baseline on all taxels, by {counts}: it was taken while something pressed, or is old",
    "slow": "all taxels rose slowly together, by {counts}, as drift does",
    "alike": "all taxels changed alike by {counts}, as in a field or by warming, and as no touch does",
    "left": "all taxels stay off by {counts} after a release, as a pad does that has warmed or recovers",
}


def doubt_text(doubt: Doubt, counts: tuple[float, float, float], age_s: float | None) -> str:
    """Return a doubt in a user's words, with the medians of all taxels on x, y, z and the baseline's age in [s]."""
    seen = "x {:+.0f}, y {:+.0f}, z {:+.0f} counts".format(*counts)
    age = "of unknown age" if age_s is None else f"{age_text(age_s)} old"
    return f"baseline in doubt: {_TEXTS[doubt].format(counts=seen)} (baseline {age}); free the pad and zero again"


class BaselineDoubt:
    """Stage: decides whether a step's readings may be a touch, and reports when a doubt begins, changes and ends.

    Attributes:
        doubt: why the newest readings are in doubt; None if they are not.
        counts: medians of all taxels on x, y, z when that began.
        reported: the doubt of the newest step that was judged; `notes` state it for the user.
    """

    def __init__(self, options: RuntimeOptions, taxels: int, report: Report) -> None:
        self._report = report
        self.reported: Doubt | None = None
        self.notes: tuple[Note, ...] = ()
        self._on, self._off = options.contact_on_counts, options.contact_off_counts
        # Drift explains a rise of 40 counts/s a taxel: twice the fastest on record. A release leaves up to 150 a taxel:
        # warming by 3 K gives 120.
        self._drift_per_ns = 40.0 * taxels / 1e9
        self._left = 150.0 * taxels
        self.counts = (0.0, 0.0, 0.0)
        self.begin("file")

    def begin(self, origin: Origin) -> None:
        """Begin with a baseline of an origin: of a file, or taken from these very scans."""
        seen = origin != "file"
        self.doubt: Doubt | None = None
        self._held = origin == "unsure"
        self._seen = seen
        self._unseen: Doubt = "unseen"
        self._touched = seen  # until it was low once, nothing is known of how a contact began
        self._before: NDArray[np.float32] | None = None
        self._newest: NDArray[np.float32] | None = None
        self._level = self._peak = self._still_counts = 0.0
        self._newest_ns = self._still_ns = 0

    def lose_touch(self, *, same_pad: bool = False) -> None:
        """Forget how a contact began, and after an outage that the pad was seen: it may not be the `same_pad`."""
        if self._seen and not same_pad:
            self._before, self._newest = self._newest, None
            self._seen, self._unseen = False, "outage"
        self._touched = self._seen

    def __call__(self, step: Step) -> None:
        """Mark the step where its readings are in doubt."""
        if step.readings is None or step.force_counts is None:
            return
        doubt = self.weigh(step.readings, step.force_counts, step.scan.time_ns)
        if doubt is not self.reported:
            self.reported = doubt
            if doubt is None:
                self._report("baseline_cleared", "")
            else:
                text = doubt_text(doubt, self.counts, step.baseline_age_s)
                self.notes = (Note("baseline_in_doubt", text),)
                self._report("baseline_doubted", text)
        step.doubted = doubt is not None

    def weigh(self, zeroed: NDArray[np.float32], z_counts: float, time_ns: int) -> Doubt | None:
        """Return why readings (3, rows, cols) over the baseline, of a summed z, are in doubt; None if they are not."""
        self._newest = zeroed
        if self._held:
            return "held"
        if self._seen and -self._off < z_counts < self._off:
            self._newest_ns, self._level, self._peak = time_ns, 0.0, 0.0
            self._touched, self.doubt = False, None
            return None
        near = np.maximum.reduce(np.abs(zeroed)) <= NEAR_COUNTS
        at_rest = np.count_nonzero(near) / near.size
        if at_rest >= SEEN_SHARE:
            self._seen, self._peak, self._level = True, 0.0, 0.0
        elif not self._seen:
            self._seen = self._goes_on(zeroed)
        before, self.doubt = self.doubt, None
        if z_counts <= -self._off and float(np.median(zeroed[2])) < -NEAR_COUNTS:
            self.doubt, self._seen, self._touched = "below", False, False
        elif at_rest >= LOCAL_SHARE and z_counts >= self._on:
            self._touched = True
        elif not self._seen:
            self.doubt = None if self._touched else self._unseen
        elif at_rest < LOCAL_SHARE:
            self.doubt = self._explanation(zeroed, z_counts, time_ns, before)
        if self.doubt is not None and before is None:
            x, y, z = np.median(zeroed.reshape(3, -1), axis=1).tolist()
            self.counts = (x, y, z)
        if z_counts < self._off:
            self._touched = False
        self._peak = max(self._peak, z_counts)
        self._newest_ns = time_ns
        return self.doubt

    def _goes_on(self, zeroed: NDArray[np.float32]) -> bool:
        """Return whether the readings are those from before an outage, once."""
        before, self._before = self._before, None
        if before is None:
            return False
        far = np.abs(zeroed - before) > NEAR_COUNTS + 0.1 * np.abs(before)  # as a grip changes that has gone on
        self._touched = np.count_nonzero(far.any(axis=0)) <= (1 - SEEN_SHARE) * far[0].size
        return self._touched

    def _explanation(
        self, zeroed: NDArray[np.float32], z_counts: float, time_ns: int, before: Doubt | None
    ) -> Doubt | None:
        """Return what explains readings of most taxels over a confirmed baseline as well as a touch."""
        if not self._touched:
            rise = self._drift_per_ns * max(time_ns - self._newest_ns, 0)
            self._level = min(z_counts, self._level + rise)
            if z_counts < self._on and before is None:
                return None
            if z_counts < 2 * self._level:
                return "slow"
            if self._alike(zeroed):
                return "alike"
            self._touched = True
        if abs(z_counts - self._still_counts) > 100:
            self._still_counts, self._still_ns = z_counts, time_ns
        slack = 1.2 if before == "left" else 1.0
        left = z_counts < slack * min(self._left, 0.5 * self._peak)
        still = before == "left" or time_ns - self._still_ns >= 100_000_000
        return "left" if left and still else None

    @staticmethod
    def _alike(zeroed: NDArray[np.float32]) -> bool:
        flat = zeroed.reshape(3, -1)
        common = np.median(flat, axis=1, keepdims=True)
        # In real flat grips taxels differ by 0.55 of the median and more, in simulated presses by more than all of it.
        return bool((np.abs(flat - common) <= 10 + 0.3 * np.abs(common)).all())
