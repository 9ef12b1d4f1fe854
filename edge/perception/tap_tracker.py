"""Contact, the peak frame of each tap, and the window of K taps that the network sees.

Contact has two thresholds on the summed z, so that noise around one of them cannot chop a tap in
pieces. While a tap goes on the window holds its current frame, not its peak: a robot gets a
pattern from the first scan of a tap. The peaks are what earlier taps are remembered by.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError

ON_COUNTS: Final = 1500.0
"""Summed z at which a tap begins: about 1.3 N, twelve times the thermal drift of one taxel."""
OFF_COUNTS: Final = 750.0
IDLE_TIMEOUT_S: Final = 5.0
MIN_TAP_SCANS: Final = 2
"""A touch seen in one scan only may be a flipped bit; it is reported, but not remembered as a tap."""


@dataclass(frozen=True, slots=True)
class TapState:
    """What the tracker knows after a scan.

    Attributes:
        contact: a tap is going on.
        tap: number of the tap, from 0; of the last one without contact.
        taps_used: taps in the window, the current one included; 0 without contact.
        window: (K, 3, rows, cols) float32, newest first, zeros where there was no tap. It is the
            tracker's own array: read-only, and overwritten by the next push.
    """

    contact: bool
    tap: int
    taps_used: int
    window: NDArray[np.float32]


def check_thresholds(on_counts: float, off_counts: float) -> None:
    """Of contact, by summed z.

    Raises:
        UsageError: they cannot be.
    """
    if not 0 < off_counts <= on_counts < math.inf:
        raise UsageError(f"contact thresholds are on {on_counts}, off {off_counts}: expected 0 < off <= on")


class TapTracker:
    """Follows the taps of one sensor; allocates no array after construction."""

    def __init__(
        self,
        taps: int,
        on_counts: float = ON_COUNTS,
        off_counts: float = OFF_COUNTS,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        grid_shape: tuple[int, int] = (4, 4),
    ) -> None:
        """Start without contact.

        Args:
            taps: K, the length of the window.
            on_counts: summed z at which a tap begins.
            off_counts: summed z below which it ends.
            idle_timeout_s: time without contact after which earlier taps are forgotten, in [s].
            grid_shape: (rows, cols) of the sensor.

        Raises:
            UsageError: one of these cannot be.
        """
        if taps < 1:
            raise UsageError(f"taps is {taps}, expected at least 1")
        check_thresholds(on_counts, off_counts)
        if not idle_timeout_s > 0:
            raise UsageError(f"idle time-out is {idle_timeout_s} s, expected more than 0")
        self._on_counts = on_counts
        self._off_counts = off_counts
        self._idle_timeout_ns = idle_timeout_s * 1e9
        self._window = np.zeros((taps, 3, *grid_shape), dtype=np.float32)
        self._shown = self._window.view()
        self._shown.setflags(write=False)
        self._peak = np.zeros((3, *grid_shape), dtype=np.float32)
        self._contact = False
        self._tap = -1
        self._last_contact_ns = 0
        self.reset()

    @property
    def contact(self) -> bool:
        """A tap is going on."""
        return self._contact

    def reset(self) -> None:
        """Forget every tap. A tap in progress goes on, as the first one, under a number of its own."""
        self._tap += self._contact
        self._window.fill(0)
        self._earlier = 0
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def push(self, deformation: NDArray[np.float32], time_ns: int, z_counts: float | None = None) -> TapState:
        """Follow one scan.

        The idle time is measured between scans, from the last one in contact. Time that runs
        backwards counts as no time; a gap within a tap does not end the tap.

        Args:
            deformation: (3, rows, cols) float32, zeroed counts.
            time_ns: of the scan, in [ns].
            z_counts: its summed z, where that is known better than from `deformation`.
        """
        z_counts = float(deformation[2].sum()) if z_counts is None else z_counts
        if self._contact:
            self._contact = z_counts >= self._off_counts
            if not self._contact:
                self._release()
        elif z_counts >= self._on_counts:
            self._forget_if_idle(time_ns)
            self._contact = True
            self._tap += 1

        if self._contact:
            self._last_contact_ns = time_ns
            self._tap_scans += 1
            self._window[0] = deformation
            if z_counts > self._peak_counts:
                self._peak_counts = z_counts
                self._peak[...] = deformation
        else:
            self._forget_if_idle(time_ns)
        taps_used = 1 + self._earlier if self._contact else 0
        return TapState(self._contact, self._tap, taps_used, self._shown)

    def _release(self) -> None:
        if self._tap_scans >= MIN_TAP_SCANS and len(self._window) > 1:
            for slot in range(len(self._window) - 1, 1, -1):
                self._window[slot] = self._window[slot - 1]
            self._window[1] = self._peak
            self._earlier = min(self._earlier + 1, len(self._window) - 1)
        self._window[0].fill(0)
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def _forget_if_idle(self, time_ns: int) -> None:
        self._last_contact_ns = min(self._last_contact_ns, time_ns)
        if time_ns - self._last_contact_ns > self._idle_timeout_ns:
            self.reset()
