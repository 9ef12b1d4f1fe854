"""Checks of the taxels of one sensor, and the statistics of its scans that they judge. No I/O, no clock."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor.findings import Finding, graded, judged, worst
from edge.perception.result import NOISE_COUNTS
from edge.perception.run_options import OFF_COUNTS
from edge.perception.taxel_health import RANGE_ENDS
from edge.pipeline.cadence import Cadence
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import COUNTS_ON_CIRCLE, CREEP_LIMIT_COUNTS, LOAD_LIMIT_COUNTS


class Samples:
    """Scans of one sensor, without the first, which may have been cut in mid-cycle."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        self._kept = kept = scans[1:]
        self.scans = len(kept)
        # (n, 3, taxels) raw counts, and (n, taxels): whether the taxel sent a reading, and whether that is new.
        self.counts: NDArray[np.int32] = np.array([scan.counts.reshape(3, -1) for scan in kept], dtype=np.int32)
        self.fresh = self.counts[:, 0] != ABSENT
        self.renewed: NDArray[np.bool_] = np.array([scan.renewed.ravel() for scan in kept], dtype=bool)
        self.time_s = np.array([scan.time_ns - kept[0].time_ns for scan in kept], dtype=np.float64) / NS_PER_S
        self.living: NDArray[np.bool_] = self.fresh.mean(axis=0) >= 0.5  # (taxels,)

    def period_s(self) -> float:
        """Return the period from scan to scan, in [s]."""
        together = min(100, self.scans // 2)  # an adapter that delivers scans in bunches makes one meaningless
        period_s = float(np.median(self.time_s[together:] - self.time_s[:-together])) / together
        return max(period_s, 1e-4)  # where a machine that stood still took most scans at once

    def lost(self) -> int:
        """Count the scans that never came, as a run does."""
        cadence = Cadence()
        for scan in self._kept:
            cadence.follow(scan)
        return cadence.missed

    def torn(self) -> NDArray[np.bool_]:
        """Return (n,), True for scans in which a living taxel was silent."""
        return ~self.fresh[:, self.living].all(axis=1)

    def half_old(self) -> NDArray[np.bool_]:
        """Return (n,), True for scans in which a quarter of the living taxels or more sent an old reading again."""
        old = (self.fresh & ~self.renewed)[:, self.living]
        return 4 * old.sum(axis=1) >= max(1, int(self.living.sum()))

    def stuck(self) -> NDArray[np.bool_]:
        """Return (taxels,), True for living taxels with a new reading in one scan in a hundred at most."""
        arrived = np.maximum(self.fresh.sum(axis=0), 1)
        return self.living & ((self.renewed & self.fresh).sum(axis=0) <= 0.01 * arrived)

    def noise_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the standard deviation from scan to scan, without creep; NaN where too little came."""
        noise = np.full(self.counts.shape[1:], np.nan)
        both = self.fresh[1:] & self.fresh[:-1]
        steps = around_counts(np.diff(self.counts, axis=0))
        for taxel in np.flatnonzero(self.living):
            noise[:, taxel] = _noise_of(steps[both[:, taxel], :, taxel])
        return noise

    def rest_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the median reading; NaN where a taxel is not living."""
        return self._median(slice(None))

    def drift_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the last tenth less the first; NaN where a taxel is not living."""
        part = max(1, int(0.1 * self.scans))
        return around_counts(self._median(slice(-part, None)) - self._median(slice(part)))

    def _median(self, part: slice) -> NDArray[np.float64]:
        medians = np.full(self.counts.shape[1:], np.nan)
        for taxel in np.flatnonzero(self.living):
            read = self.counts[part, :, taxel][self.fresh[part, taxel]]
            if len(read):
                medians[:, taxel] = (read[0] + np.median(around_counts(read - read[0]), axis=0)) % COUNTS_ON_CIRCLE
        return medians


def _noise_of(steps: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the standard deviation of readings (...) from the steps between them (n, ...), without rare large ones."""
    sizes = np.sort(np.abs(steps), axis=0)
    kept = sizes[: int(0.98 * len(sizes))].astype(np.float64)
    if not len(kept):
        return np.full(steps.shape[1:], np.nan)
    return np.sqrt((kept**2).mean(axis=0) / 2) / 0.9346  # of a normal variable of deviation 1 the RMS is then 0.9346


def around_counts(steps: NDArray[Any]) -> NDArray[Any]:
    """Return steps the short way round the circle."""
    half = COUNTS_ON_CIRCLE // 2
    return (steps + half) % COUNTS_ON_CIRCLE - half


NOISE_LIMITS_COUNTS: Final = ((4.0, 8.0), (4.0, 8.0), (6.0, 12.0))
"""Limits of "look" and "wrong" for x, y, z. On record are 1.1 to 2.8 and 2 to 4.7; four taps need under eight."""
STRAY_COUNTS: Final = 12_000.0
"""Largest distance of a taxel's rest from the others' on one axis: z of one model spans 9700 from end to end."""


def check_silent(samples: Samples, wrong_map: bool) -> Finding:
    """Check for silent taxels. Half of them silent are no defect where the id map is wrong."""
    silent = np.flatnonzero(~samples.living)
    if not silent.size:
        return Finding("silent taxels", "ok", "none")
    measured = f"{_named(silent)} of {samples.living.size}"
    if wrong_map:
        return Finding("silent taxels", "not known", measured, "none", "see id map")
    remedy = "broken, or a frame filter of the adapter leaves it out; the runtime makes up for up to eight"
    return Finding("silent taxels", "wrong", measured, "none", remedy)


def check_stuck(samples: Samples) -> Finding:
    """Check for taxels that repeat one reading, or stand at an end of their range."""
    stuck = samples.stuck()
    rest = samples.rest_counts()
    # A rest near an end that goes round the circle is noisy there; a reading that has left the range is not.
    ends = samples.living & (np.isin(rest, RANGE_ENDS) & (samples.noise_counts() == 0)).any(axis=0)
    if ends.any():
        remedy = "overloaded, too near a magnet or steel, or broken: free it, and replace the sensor if it persists"
        return Finding("stuck taxels", "wrong", f"{_named(ends)} at an end of its range", "none", remedy)
    if not stuck.any():
        return Finding("stuck taxels", "ok", "none")
    if stuck[samples.living].all():
        remedy = "one old scan is sent over and over: switch the sensor off and on, or restart the server that sends it"
        return Finding("stuck taxels", "wrong", "all that arrive", "none", remedy)
    return Finding("stuck taxels", "wrong", _named(stuck), "none", "broken: the runtime makes up for up to eight")


def check_noise(samples: Samples) -> Finding:
    """Check the standard deviation of each taxel at rest."""
    noise = np.where(samples.stuck(), np.nan, samples.noise_counts())
    if np.isnan(noise).all():
        return Finding("noise", "not known", "no taxel sends new readings")
    largest = np.nanmax(noise, axis=1)
    verdict = worst(graded(most, *limits) for most, limits in zip(largest, NOISE_LIMITS_COUNTS, strict=True))
    limits = np.asarray(NOISE_LIMITS_COUNTS)[:, :1]
    axis, taxel = _farthest(noise / limits)
    medians = ", ".join(f"{name} {np.nanmedian(plane):.1f}" for name, plane in zip(AXES, noise, strict=True))
    measured = f"{medians} counts; most on taxel {taxel} {AXES[axis]}, {noise[axis, taxel]:.1f}"
    norm = f"{NOISE_COUNTS:.0f} counts, up to {' / '.join(f'{look:.0f}' for look, _ in NOISE_LIMITS_COUNTS)}"
    loud = int((noise > limits).any(axis=0).sum())
    remedy = f"taxel {taxel} alone is noisy: a loose magnet or a broken chip"
    if loud > 1:
        remedy = "keep motors, magnets and power cables away from the pad, and keep it still"
    return judged("noise", verdict, measured, norm, remedy)


def check_rest(samples: Samples) -> Finding:
    """Check the readings of the free pad: they differ between models and axes, but are alike within a pad."""
    rest = samples.rest_counts()
    if np.isnan(rest).all():
        return Finding("rest levels", "not known", "no taxel has arrived")
    spans = (f"{n} {np.nanmin(r):.0f} to {np.nanmax(r):.0f}" for n, r in zip(AXES, rest, strict=True))
    from_first = around_counts(rest - rest[:, np.flatnonzero(samples.living)[:1]])
    stray = np.abs(around_counts(from_first - np.nanmedian(from_first, axis=1, keepdims=True)))
    axis, taxel = _farthest(stray)
    norm = f"alike within {STRAY_COUNTS:.0f} counts on an axis"
    measured = f"{', '.join(spans)} counts"
    remedy = f"taxel {taxel} {AXES[axis]} rests far from the others: pressed, too near a magnet, or broken"
    return judged("rest levels", "look" if stray[axis, taxel] > STRAY_COUNTS else "ok", measured, norm, remedy)


def check_drift(samples: Samples) -> Finding:
    """Check the drift of the rest from the first tenth of the time to the last."""
    drift = np.where(samples.stuck(), np.nan, samples.drift_counts())
    if np.isnan(drift).all():
        return Finding("drift", "not known", "no taxel sends new readings")
    sizes = np.abs(drift)
    axis, taxel = _farthest(sizes)
    z_sum = float(np.nansum(drift[2]))
    most = f"{drift[axis, taxel]:+.0f} counts on taxel {taxel} {AXES[axis]}"
    measured = f"{most}, summed z {z_sum:+.0f}, in {float(samples.time_s[-1]):.0f} s"
    norm = f"under {CREEP_LIMIT_COUNTS:.0f} on a taxel"
    remedy = "let it warm up for ten minutes, unloaded and still, then zero again"
    if float(np.nanmax(sizes[2])) > LOAD_LIMIT_COUNTS:
        remedy = "more than warming up causes: something pressed or released it meanwhile; free it and measure again"
    # 94 counts are the most of a single taxel: as much in every taxel is a contact.
    verdict = "wrong" if abs(z_sum) >= OFF_COUNTS else graded(sizes[axis, taxel], CREEP_LIMIT_COUNTS, 94.0)
    return judged("drift", verdict, measured, norm, remedy)


def _farthest(values: NDArray[np.floating]) -> tuple[int, int]:
    axis, taxel = np.unravel_index(int(np.nanargmax(values)), values.shape)
    return int(axis), int(taxel)


def _named(taxels: NDArray[np.generic]) -> str:
    numbers = np.flatnonzero(taxels) if taxels.dtype == bool else taxels
    return f"taxel {', '.join(str(number) for number in numbers.tolist())}"
