"""Health of a sensor's taxels, scan by scan: held readings, dead taxels, their reasons and what stands for them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.dead_taxel_fill import Filler, TaxelEstimator
from edge.perception.event import Note
from edge.perception.result import Step
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import TAXEL_SILENT_SCANS
from firmware_bridge.zeroing.baseline import Baseline, deformation

HOLD_SCANS: Final = 5
"""Scans for which a taxel that is missing from a torn scan keeps its last reading: 50 ms at 100 Hz."""
HOLD_NS: Final = 90_000_000
"""Longest time that a reading is held, in [ns] from scan to scan, however few scans arrived meanwhile: what was pressed
half a second ago is another press. A reading may have arrived 60 ms before the end of its scan, the longest pause
inside one, so no held reading is older than 150 ms. The time counts from when the reading was taken, since a reader
that was kept from running cannot date its arrival."""
STUCK_SCANS: Final = 20
"""Repeats of a taxel in a row that make it stuck. A living taxel sends the same three counts twice in a quarter of the
scans in which a quarter of the taxels are new, as torn as real grips are at their source, and no run there is longer
than 3. If scans were independent, twenty in a row would come once in decades at 100 Hz; with noise of two counts
alone, which repeats one scan in 350, never."""
FROZEN_SENSOR_SCANS: Final = 10
"""Scans bit for bit alike in all taxels: with noise of two counts 48 equal values do not come twice."""
FROZEN_SCANS: Final = 300
"""Scans without a new count of a taxel, whatever the others do: most are stuck at once, or one old scan is sent for
ever. A server that sends 507 scans a second, of a sensor that renews a taxel four times, reaches 127."""
FAR_SCANS: Final = 20
BACK_SCANS: Final = 10
"""Good scans after which a dead taxel counts as alive again, so that an intermittent one does not flicker."""
RANGE_ENDS: Final = (0, 65535)
"""Ends of a chip's range. A count there has left the range and is not a reading, unless the taxel rests nearby and
wraps round."""
NEAR_END_COUNTS: Final = 500.0
LONE_COUNTS: Final = 1500.0  # size of a reading from which a lone taxel is checked: as large as a contact
LONE_SHARE: Final = 0.015
"""Share of the largest taxel's reading that the second largest reaches in any contact: at least 0.030 with a small
sphere on one taxel alone, 0.063 on simulated taps, 0.67 on real grips."""
REST_COUNTS: Final = 500.0  # reading below which a taxel that was far from rest is believed again
REACH_COUNTS: Final = ((-2800.0, 2800.0), (-2800.0, 2800.0), (-2800.0, 27000.0))
"""Limits of x, y, z: twice what sensors in the field have shown, whose z only rises when pressed."""
REASONS: Final = ("silent", "saturated", "stuck", "far", "unzeroed")
SILENT, SATURATED, STUCK, FAR, UNZEROED = range(1, 6)
_LOW, _HIGH = np.array(REACH_COUNTS, dtype=np.float32).T[:, :, None, None]
_WORDS: Final = {
    "silent": "silent",
    "saturated": "at the end of its range",
    "stuck": "stuck",
    "far": "far from rest where it cannot be",
    "unzeroed": "not zeroed",
}
_OVERLOADED: Final = ": overloaded, too near a magnet, or broken"


class TaxelWatch:
    """Tracker of the health of one sensor's taxels.

    A taxel is dead while it is silent or saturated for longer than its last reading is held; stuck, when it repeats
    itself while most others do not; far, when it reads what no contact makes; or was not heard while zeroing. It is
    believed again after BACK_SCANS good scans. A taxel that is stuck only nearly, or wrong in a way that a contact
    could be, is not found: a small sphere on one taxel looks to its neighbours like a fault.

    Attributes:
        held: (3, rows, cols), the newest reading of each taxel.
        dead: taxels (rows, cols) that are not believed; another array only where they are others than before.
        reasons: dead taxels, row-major from the top left, and one of REASONS for each.
        sound: every taxel is believed, and nothing speaks against one.
        most_repeats: scans for which a taxel that is believed has repeated itself while a quarter of the others were
            new.
    """

    def __init__(self, grid_shape: tuple[int, int], mounting: Mounting | None = None) -> None:
        """Start with no reading of a grid (rows, cols); without a mounting its axes are as wired."""
        self._mounting = mounting
        self.held: NDArray[np.int32] = np.zeros((3, *grid_shape), dtype=np.int32)
        self.dead: NDArray[np.bool_] = np.zeros(grid_shape, dtype=bool)
        self._code = np.zeros(grid_shape, dtype=np.int8)
        self._arrived = np.zeros(grid_shape, dtype=bool)
        self._saturated = np.zeros(grid_shape, dtype=bool)
        self._unzeroed = np.zeros(grid_shape, dtype=bool)
        self._age = np.zeros(grid_shape, dtype=np.int64)
        self._read_ns = np.zeros(grid_shape, dtype=np.int64)
        self._whole_ns = 0
        self._still = np.zeros(grid_shape, dtype=np.int64)
        self._far = np.zeros(grid_shape, dtype=np.int64)
        self._well = np.zeros(grid_shape, dtype=np.int64)
        self._size = np.zeros((3, *grid_shape), dtype=np.float32)
        self._old = np.zeros(grid_shape, dtype=np.int64)
        self._repeats = 0
        self._baseline: Baseline | None = None
        self.sound = False
        self.most_repeats = 0
        self.reasons: dict[int, str] = {}

    @property
    def waiting(self) -> bool:
        """True while a taxel has not arrived yet and is not given up."""
        return not self.sound and not bool((self._arrived | self.dead).all())

    @property
    def silent_long(self) -> NDArray[np.bool_]:
        """Taxels (rows, cols) that have not arrived for TAXEL_SILENT_SCANS."""
        return (self._age >= TAXEL_SILENT_SCANS) & ~self._saturated

    @property
    def may_be_estimated(self) -> bool:
        """True while enough taxels live; half of them silent are not a defect but a wrong id map."""
        silent = sum(reason == "silent" for reason in self.reasons.values())
        return len(self.reasons) <= self.dead.size // 2 and 2 * silent < self.dead.size

    def forget(self) -> None:
        """Hold no earlier reading any longer; dead taxels stay dead until enough good scans arrive."""
        self._arrived[:] = False
        self.sound = False

    def push(self, scan: Scan, baseline: Baseline | None) -> NDArray[np.float32] | None:
        """Take one scan and return the newest readings (3, rows, cols) over the baseline; None without a baseline.

        NaN stands for taxels that were not zeroed, in both.
        """
        if baseline is not self._baseline and baseline is not None:
            unzeroed = np.isnan(baseline.counts).any(axis=0)
            if self._baseline is None or (unzeroed != self._unzeroed).any():  # not where it has drifted alone
                self._unzeroed, self.sound = unzeroed, False
        self._baseline = baseline
        if self.sound and baseline is not None and scan.whole:
            zeroed = np.subtract(scan.counts, baseline.counts, dtype=np.float32)
            if self._mounting is not None:
                zeroed = self._mounting.correct(zeroed)
            np.abs(zeroed, out=self._size)
            largest = float(np.maximum.reduce(self._size, axis=None))
            # Near rest, without contact, no taxel is far or at an end that is not its rest. In contact every taxel must
            # be inside the range, and not far as one is that has wrapped round.
            if largest <= NEAR_END_COUNTS or (
                RANGE_ENDS[0] < np.minimum.reduce(scan.counts, axis=None)
                and np.maximum.reduce(scan.counts, axis=None) < RANGE_ENDS[1]
                and not self._may_be_far(zeroed, largest)
            ):
                np.copyto(self.held, scan.counts)
                self._whole_ns = scan.not_before_ns
                return zeroed
        ends = self._find_saturated(scan, baseline)
        zeroed = None
        if not ends and self.sound and scan.whole:
            np.copyto(self.held, scan.counts)
            self._whole_ns = scan.not_before_ns
            zeroed = None if baseline is None else deformation(scan.counts, baseline, self._mounting)
            if zeroed is None:
                return zeroed
            np.abs(zeroed, out=self._size)
            if not self._may_be_far(zeroed, float(self._size.max())):
                return zeroed
        read = scan.fresh & ~self._saturated
        self._arrived |= read
        np.copyto(self.held, scan.counts, where=read)
        if baseline is not None:
            zeroed = deformation(self.held, baseline, self._mounting)
        self._judge(scan, read, zeroed)
        return zeroed

    def notes(self, filled: str | None) -> tuple[Note, ...]:
        """Return notes on taxels that are not believed, of which there are estimates or, with None, no pattern."""
        if self.sound:
            return ()
        notes: list[Note] = []
        overloaded = np.flatnonzero(self._saturated & ~self.dead)
        if overloaded.size:
            text = f"its last reading is held, {_named(overloaded)} {_WORDS['saturated']}{_OVERLOADED}"
            notes.append(Note("held", text))
        kinds = {reason: self._dead_by(reason) for reason in dict.fromkeys(self.reasons.values())}
        if filled is not None and kinds:
            dead = ", ".join(f"{_named(taxels)} {_WORDS[reason]}" for reason, taxels in kinds.items())
            owner = "its" if len(self.reasons) == 1 else "their"
            notes.append(Note("estimated", f"{dead}: estimated from {owner} neighbours"))
            return tuple(notes)
        silent_long = self.silent_long
        id_map = 2 * np.count_nonzero(silent_long) == silent_long.size
        remedies = {"saturated": _OVERLOADED, "unzeroed": ": zero again"}
        if self._repeats >= FROZEN_SENSOR_SCANS:
            text = f"no pattern, the sensor is frozen: its last {self._repeats} scans are alike bit for bit"
            notes.append(Note("frozen", text))
            kinds.pop("stuck", None)
        for reason, taxels in kinds.items():
            remedy = remedies.get(reason, ": it may be broken")
            if reason == "silent":
                remedy = ": try another --id-map" if id_map else remedy if silent_long.any() else ""
            if taxels:
                notes.append(Note("dead", f"no pattern, {_named(taxels)} {_WORDS[reason]}{remedy}"))
        return tuple(notes)

    def _dead_by(self, reason: str) -> list[int]:
        return [taxel for taxel, why in self.reasons.items() if why == reason]

    def _find_saturated(self, scan: Scan, baseline: Baseline | None) -> bool:
        """Mark taxels at an end of the chip's range on some axis and far from rest; return whether there are any."""
        low, high = RANGE_ENDS
        ends = (scan.counts == low) | (scan.counts == high)
        if not self.sound:
            self._saturated &= ~scan.fresh
        if baseline is not None and ends.any():
            far = np.abs(deformation(scan.counts, baseline)) > NEAR_END_COUNTS
            self._saturated |= (ends & far).any(axis=0)
            return bool(self._saturated.any())
        return False

    def _may_be_far(self, zeroed: NDArray[np.float32], largest: float) -> bool:
        """Return quickly whether a taxel may be far, if all taxels live; only then the full check is made."""
        if largest <= LONE_COUNTS:
            return False
        sizes = np.maximum.reduce(self._size).ravel()
        sizes.partition(-2)
        return bool(sizes[-2] < LONE_SHARE * sizes[-1] or (zeroed < _LOW).any() or (zeroed > _HIGH).any())

    def _judge(self, scan: Scan, read: NDArray[np.bool_], zeroed: NDArray[np.float32] | None) -> None:
        self._age += 1
        self._age[read] = 0
        self._read_ns[read] = scan.not_before_ns
        # A scan with few new taxels is no evidence against one that is not new: the adapter repeats itself.
        if 4 * np.count_nonzero(scan.renewed) >= np.count_nonzero(~self.dead) > 0:
            self._still += scan.fresh & ~scan.renewed
        self._still[scan.renewed] = 0
        self._old += scan.fresh
        self._old[scan.renewed] = 0
        self._repeats = self._repeats + 1 if scan.repeated else 0
        size = self._follow_far(zeroed)

        fault = np.zeros_like(self._code)
        fault[self._unzeroed] = UNZEROED
        fault[self._far >= FAR_SCANS] = FAR
        frozen = self._repeats >= FROZEN_SENSOR_SCANS
        fault[(self._still >= STUCK_SCANS) | (self._old >= FROZEN_SCANS) | frozen] = STUCK
        held_ns = scan.time_ns - np.maximum(self._read_ns, self._whole_ns)
        gone = (self._age > HOLD_SCANS) | (self._arrived & (self._age > 0) & (held_ns > HOLD_NS))
        fault[gone] = SILENT
        fault[gone & self._saturated] = SATURATED

        good = read & scan.renewed
        if size is not None:
            good &= (self._code != FAR) | (size < REST_COUNTS)
        self._well += good
        self._well[(fault > 0) | ~read | (self._still > 0)] = 0
        code = np.where(fault > 0, fault, np.where(self._well >= BACK_SCANS, 0, self._code)).astype(np.int8)
        if (code != self._code).any():
            dead = code > 0
            if (dead != self.dead).any():
                self.dead = dead  # a new array, so that a change is detected by identity
            self._code = code
            self.reasons = {int(taxel): REASONS[code.flat[taxel] - 1] for taxel in np.flatnonzero(code)}
        counting = self._age.any() or self._still.any() or self._far.any() or self._old.any()
        self.sound = not counting and not self.dead.any() and bool(self._arrived.all())
        self.most_repeats = int(np.where(self.dead, 0, self._still).max())

    def _follow_far(self, zeroed: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        """Count scans in which a taxel reads what no contact makes; return the largest of its axes, (rows, cols)."""
        if zeroed is None:
            return None
        # A taxel that is dead or was not zeroed gives no reading, and others may not be measured by it.
        size = np.nan_to_num(np.abs(zeroed).max(axis=0))
        beyond = ((zeroed < _LOW) | (zeroed > _HIGH)).any(axis=0)
        living = np.where(self.dead, 0, size)
        second, first = np.partition(living, -2, axis=None)[-2:]
        if first > LONE_COUNTS and second < LONE_SHARE * first:
            beyond |= living == first
        self._far += 1
        self._far[~beyond] = 0
        return size


def _named(taxels: list[int] | NDArray[np.integer]) -> str:
    return f"taxel {', '.join(map(str, taxels))}"


class Health:
    """Stage: the newest reading of each taxel over the baseline, and estimates of those of dead taxels.

    Without an estimator there is no pattern while a taxel is dead.
    """

    def __init__(self, watch: TaxelWatch, estimator: TaxelEstimator | None) -> None:
        self._watch, self._estimator = watch, estimator
        self._filler: Filler | None = None

    def __call__(self, step: Step, baseline: Baseline | None) -> bool:
        """Take the step's readings; return whether other taxels are dead than before."""
        watch = self._watch
        before = watch.dead
        step.zeroed = watch.push(step.scan, baseline)
        step.dead = watch.reasons
        if watch.dead is before:
            return False
        dead = np.count_nonzero(watch.dead)
        possible = self._estimator is not None and 0 < 2 * dead <= watch.dead.size
        self._filler = self._estimator.filler(watch.dead) if self._estimator is not None and possible else None
        return True

    def fill(self, step: Step) -> None:
        """Set the readings for a pattern; none where a taxel has not arrived yet, or too many are dead."""
        watch, readings = self._watch, step.zeroed
        if readings is not None and self._filler is not None and watch.may_be_estimated:
            readings, step.filled = self._filler(readings), "neighbours"
        if not watch.sound:
            step.notes = (*step.notes, *watch.notes(step.filled))
            if watch.waiting or (step.dead and step.filled is None):
                return
        if readings is not None:
            step.readings, step.force_counts = readings, float(np.add.reduce(readings[2], axis=None))
