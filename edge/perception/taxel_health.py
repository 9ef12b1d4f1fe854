"""Health of a sensor's taxels, scan by scan: held readings, dead taxels, their reasons, and estimates of dead ones."""

from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from edge.perception.event import Note
from edge.perception.result import Step
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.recording.npz_recording import read_npz
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import TAXEL_SILENT_SCANS
from firmware_bridge.zeroing.baseline import Baseline, deformation

HOLD_SCANS: Final = 5  # for which a taxel that is missing from a torn scan keeps its last reading
# Longest time that a reading is held from when it was taken: what was pressed half a second ago is another press. It
# may have arrived 60 ms before its scan's end, the longest pause inside one: none that is held is older than 150 ms.
HOLD_NS: Final = 90_000_000
# Repeats of a taxel in a row, while a quarter of the taxels are new, that make a pattern doubtful, and the taxel stuck:
# no run in real grips, which are as torn at their source, is longer than 3.
REPEATS: Final = 5
STUCK_SCANS: Final = 20
FROZEN_SENSOR_SCANS: Final = 10  # scans alike in all taxels: with noise of two counts 48 equal values do not come twice
# Scans without a new count of a taxel, whatever the others do: most are stuck, or one old scan is sent for ever. A
# server that sends 507 scans a second, of a sensor that renews a taxel four times, reaches 127.
FROZEN_SCANS: Final = 300
FAR_SCANS: Final = 20
BACK_SCANS: Final = 10  # good scans after which a dead taxel is believed again, so that none flickers
RANGE_ENDS: Final = (0, 65535)  # of a chip: a count there is no reading, unless the taxel rests nearby and wraps round
NEAR_END_COUNTS: Final = 500.0
LONE_COUNTS: Final = 1500.0  # size of a reading from which a lone taxel is checked: as large as a contact
# Share of the largest taxel's reading that the second largest reaches in any contact: at least 0.030 with a small
# sphere on one taxel alone, 0.063 on simulated taps, 0.67 on real grips.
LONE_SHARE: Final = 0.015
REST_COUNTS: Final = 500.0  # reading below which a taxel that was far from rest is believed again
# Limits of x, y and z: twice what sensors in the field have shown, whose z only rises when pressed.
_LOW, _HIGH = np.array([(-2800, 2800), (-2800, 2800), (-2800, 27000)], dtype=np.float32).T[:, :, None, None]
_WORDS: Final = {
    "silent": "silent",
    "saturated": "at the end of its range",
    "stuck": "stuck",
    "far": "far from rest where it cannot be",
    "unzeroed": "not zeroed",
}
_OVERLOADED: Final = ": overloaded, too near a magnet, or broken"
# Factors on deviations with 0 to 8 of sixteen taxels dead, so that 90 % intervals hold 90 % of validation's pixels.
WIDENING: Final = (1.0, 1.05, 1.12, 1.19, 1.29, 1.36, 1.47, 1.61, 1.79)


class Fault(IntEnum):
    """Why a taxel is dead."""

    SILENT = 1
    SATURATED = 2
    STUCK = 3
    FAR = 4
    UNZEROED = 5


Fill = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Health:
    """Stage: the newest reading of each taxel over the baseline, which taxels are dead, and estimates of those.

    A taxel is dead while it is silent or saturated for longer than its last reading is held; stuck, when it repeats
    itself while most others do not; far, when it reads what no contact makes; or was not heard while zeroing. One that
    is wrong in a way that a contact could be is not found: a small sphere on it looks to its neighbours like a fault.
    """

    def __init__(
        self,
        grid_shape: tuple[int, int],
        mounting: Mounting | None = None,
        estimator: NDArray[np.float64] | None = None,
    ) -> None:
        """Start with no reading of a grid (rows, cols); without an estimator dead taxels allow no pattern."""
        self._mounting, self._estimator = mounting, estimator
        self._fill: Fill | None = None
        self.held: NDArray[np.int32] = np.zeros((3, *grid_shape), dtype=np.int32)  # newest reading of each taxel
        # The dead are another array only where they are others than before.
        self.dead, self._arrived, self._saturated, self._unzeroed = np.zeros((4, *grid_shape), dtype=bool)
        # Scans since a taxel arrived, in which it repeated itself, was far, was well, and gave no new count.
        self._age, self._still, self._far, self._well, self._old = np.zeros((5, *grid_shape), dtype=np.int64)
        self._code = np.zeros(grid_shape, dtype=np.int8)
        self._read_ns = np.zeros(grid_shape, dtype=np.int64)
        self._whole_ns = 0
        self._repeats = 0
        self._baseline: Baseline | None = None
        self.sound = False  # every taxel is believed, and nothing speaks against one
        self.most_repeats = 0  # of a taxel that is believed
        self.reasons: dict[int, str] = {}  # name of the Fault of each dead taxel, row-major from the top left

    @property
    def silent_long(self) -> NDArray[np.bool_]:
        """Taxels (rows, cols) that have not arrived for TAXEL_SILENT_SCANS."""
        return (self._age >= TAXEL_SILENT_SCANS) & ~self._saturated

    @property
    def widening(self) -> np.float32:
        """Factor on the deviations of a pattern that is made with estimates."""
        return np.float32(WIDENING[min(-(-16 * len(self.reasons) // self.dead.size), len(WIDENING) - 1)])

    def forget(self) -> None:
        """Hold no earlier reading any longer; dead taxels stay dead until enough good scans arrive."""
        self._arrived[:] = False
        self.sound = False

    def __call__(self, step: Step, baseline: Baseline | None) -> bool:
        """Put the newest readings over the baseline, NaN of taxels not zeroed; return whether other taxels are dead."""
        scan, dead = step.scan, self.dead
        if baseline is not self._baseline and baseline is not None:
            unzeroed = np.isnan(baseline.counts).any(axis=0)
            if self._baseline is None or (unzeroed != self._unzeroed).any():  # not where it has drifted alone
                self._unzeroed, self.sound = unzeroed, False
        self._baseline = baseline
        if self.sound and baseline is not None and scan.whole:
            zeroed = np.subtract(scan.counts, baseline.counts, dtype=np.float32)
            if self._mounting is not None:
                zeroed = self._mounting.correct(zeroed)
            if _is_plain(scan.counts, zeroed):
                np.copyto(self.held, scan.counts)
                self._whole_ns = scan.not_before_ns
                step.zeroed = zeroed
                return False
        self._find_saturated(scan, baseline)
        read = scan.fresh & ~self._saturated
        self._arrived |= read
        np.copyto(self.held, scan.counts, where=read)
        step.zeroed = None if baseline is None else deformation(self.held, baseline, self._mounting)
        self._judge(scan, read, step.zeroed)
        step.dead = self.reasons
        if self.dead is dead:
            return False
        possible = 0 < 2 * np.count_nonzero(self.dead) <= dead.size
        self._fill = filler(self._estimator, self.dead) if self._estimator is not None and possible else None
        return True

    def fill(self, step: Step) -> None:
        """Set the readings for a pattern; none where a taxel has not arrived yet, or too many are dead."""
        readings = step.zeroed
        if not self.sound:
            silent = sum(reason == "silent" for reason in self.reasons.values())
            # Half of them silent are not a defect but a wrong id map.
            if readings is not None and self._fill is not None and 2 * silent < self.dead.size:
                readings, step.filled = self._fill(readings), "neighbours"
            step.notes = (*step.notes, *self._notes(step.filled))
            if not (self._arrived | self.dead).all() or (step.dead and step.filled is None):
                return
        if readings is not None:
            step.readings, step.force_counts = readings, float(np.add.reduce(readings[2], axis=None))

    def _notes(self, filled: str | None) -> list[Note]:
        """Return notes on taxels that are not believed; filled is None where that leaves no pattern."""
        notes: list[Note] = []
        overloaded = np.flatnonzero(self._saturated & ~self.dead)
        if overloaded.size:
            text = f"its last reading is held, {_named(overloaded)} {_WORDS['saturated']}{_OVERLOADED}"
            notes.append(Note("held", text))
        kinds: dict[str, list[int]] = {}
        for taxel, reason in self.reasons.items():
            kinds.setdefault(reason, []).append(taxel)
        if filled is not None and kinds:
            dead = ", ".join(f"{_named(taxels)} {_WORDS[reason]}" for reason, taxels in kinds.items())
            owner = "its" if len(self.reasons) == 1 else "their"
            return [*notes, Note("estimated", f"{dead}: estimated from {owner} neighbours")]
        if self._repeats >= FROZEN_SENSOR_SCANS:
            text = f"no pattern, the sensor is frozen: its last {self._repeats} scans are alike bit for bit"
            notes.append(Note("frozen", text))
            kinds.pop("stuck", None)
        silent_long = np.count_nonzero(self.silent_long)
        for reason, taxels in kinds.items():
            remedy = {"saturated": _OVERLOADED, "unzeroed": ": zero again"}.get(reason, ": it may be broken")
            if reason == "silent" and 2 * silent_long == self.dead.size:
                remedy = ": try another --id-map"
            elif reason == "silent" and not silent_long:
                remedy = ""
            notes.append(Note("dead", f"no pattern, {_named(taxels)} {_WORDS[reason]}{remedy}"))
        return notes

    def _find_saturated(self, scan: Scan, baseline: Baseline | None) -> None:
        """Mark taxels at an end of the chip's range on some axis and far from rest."""
        self._saturated &= ~scan.fresh
        ends = (scan.counts == RANGE_ENDS[0]) | (scan.counts == RANGE_ENDS[1])
        if baseline is not None and ends.any():
            far = np.abs(deformation(scan.counts, baseline)) > NEAR_END_COUNTS
            self._saturated |= (ends & far).any(axis=0)

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
        fault[self._unzeroed] = Fault.UNZEROED
        fault[self._far >= FAR_SCANS] = Fault.FAR
        frozen = self._repeats >= FROZEN_SENSOR_SCANS
        fault[(self._still >= STUCK_SCANS) | (self._old >= FROZEN_SCANS) | frozen] = Fault.STUCK
        held_ns = scan.time_ns - np.maximum(self._read_ns, self._whole_ns)
        gone = (self._age > HOLD_SCANS) | (self._arrived & (self._age > 0) & (held_ns > HOLD_NS))
        fault[gone] = Fault.SILENT
        fault[gone & self._saturated] = Fault.SATURATED

        good = read & scan.renewed
        if size is not None:
            good &= (self._code != Fault.FAR) | (size < REST_COUNTS)
        self._well += good
        self._well[(fault > 0) | ~read | (self._still > 0)] = 0
        code = np.where(fault > 0, fault, np.where(self._well >= BACK_SCANS, 0, self._code)).astype(np.int8)
        if (code != self._code).any():
            dead = code > 0
            if (dead != self.dead).any():
                self.dead = dead  # a new array, so that a change is detected by identity
            self._code = code
            self.reasons = {int(taxel): Fault(code.flat[taxel]).name.lower() for taxel in np.flatnonzero(code)}
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


def _is_plain(counts: NDArray[np.int32], zeroed: NDArray[np.float32]) -> bool:
    """Return quickly whether no taxel of a sound sensor can be far, or at an end of its range."""
    sizes = np.abs(zeroed)
    largest = float(np.maximum.reduce(sizes, axis=None))
    if largest <= NEAR_END_COUNTS:  # without contact, only one that rests at an end is at it
        return True
    if np.minimum.reduce(counts, axis=None) <= RANGE_ENDS[0] or np.maximum.reduce(counts, axis=None) >= RANGE_ENDS[1]:
        return False
    if largest <= LONE_COUNTS:
        return True
    of_taxels = np.maximum.reduce(sizes).ravel()
    of_taxels.partition(-2)
    lone = of_taxels[-2] < LONE_SHARE * of_taxels[-1]
    return not (lone or (zeroed < _LOW).any() or (zeroed > _HIGH).any())


def _named(taxels: list[int] | NDArray[np.integer]) -> str:
    return f"taxel {', '.join(map(str, taxels))}"


def filler(covariances: NDArray[np.float64], dead: NDArray[np.bool_]) -> Fill:
    """Return what puts estimates in the place of dead taxels (rows, cols), not all, into scans of zeroed counts.

    Readings are modelled as drawn from one of several kinds of contact, each a zero-mean Gaussian of any scale. The
    living taxels give the probability of each kind, and each kind, by its covariances of all channels, an estimate.
    """
    off = np.tile(dead.ravel(), len(AXES))
    lost, live = np.flatnonzero(off), np.flatnonzero(~off)
    living = covariances[:, live[:, None], live]
    kinds = Kinds(living)
    maps = np.linalg.solve(living, covariances[:, live[:, None], lost]).transpose(0, 2, 1)

    def fill(zeroed: NDArray[np.float32]) -> NDArray[np.float32]:
        readings = zeroed.ravel()[live].astype(np.float64)
        counts = zeroed.copy()
        counts.flat[lost] = kinds.weigh(readings[None])[0] @ (maps @ readings)
        return counts

    return fill


class Kinds:
    """Probabilities of kinds of contact, equally frequent, by their covariances (kinds, n, n) of readings of any scale.

    Source: Tyler 1987, angular central Gaussian.
    """

    def __init__(self, covariances: NDArray[np.float64]) -> None:
        factors = np.linalg.cholesky(covariances)
        self._whiteners = np.linalg.inv(factors)
        self._log_sizes = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)

    def weigh(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability of each kind, (m, kinds), from readings (m, n)."""
        square = np.square(self._whiteners @ readings.T).sum(axis=1) + np.finfo(np.float64).tiny
        log_weight = -readings.shape[1] / 2 * np.log(square) - self._log_sizes[:, None]
        weight = np.exp(log_weight - log_weight.max(axis=0))
        return (weight / weight.sum(axis=0)).T


def ridged(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (kinds, n, n) with a ridge on each diagonal, for gains and noise of the individual sensor."""
    ridges = 2e-3 * np.trace(covariances, axis1=1, axis2=2) / covariances.shape[1]
    return covariances + ridges[:, None, None] * np.eye(covariances.shape[1])


def load_estimator(path: Path, grid_shape: tuple[int, int]) -> NDArray[np.float64]:
    """Load the covariances (kinds, 3 taxels, 3 taxels) that `train.freeze` has made, or raise an EdgeError."""
    channels = len(AXES) * grid_shape[0] * grid_shape[1]
    try:
        covariances = read_npz(path, ["covariances"], 1 << 24)["covariances"]
        if covariances.shape[1:] != (channels, channels):
            raise ValueError(f"covariances are {covariances.shape}, expected (n, {channels}, {channels})")
    except (OSError, ValueError, KeyError) as error:
        raise EdgeError(f"{path} cannot be read ({error}): make it with 'python -m train.freeze'") from error
    return ridged(covariances.astype(np.float64))
