"""Contact, the peak frame of each tap, and the window of K taps for the network.

Contact has two thresholds on the summed z, so that noise around one of them cannot split a tap. While a tap goes on
the window holds its current frame, not its peak, so that a robot gets a pattern from the first scan of a tap. Earlier
taps are remembered by their peaks.
"""

import math
from collections.abc import Container
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose

MIN_TAP_SCANS: Final = 2
"""Fewest scans of a tap. A touch in a single scan may be a flipped bit; it is reported, but not remembered as a tap."""


@dataclass(eq=False, slots=True)
class TapPeak:
    """Peak of a tap: the tap's number, when its readings (3, rows, cols) were taken, in [ns], and its pose if known."""

    tap: int
    time_ns: int
    readings: NDArray[np.float32]
    pose: PadPose | None = None


class TapTracker:
    """Tracker of the taps of one sensor.

    Attributes:
        contact: True while a tap goes on.
        tap: number of the tap, from 0; without contact that of the last one.
        taps_used: taps in the window, the current one included; 0 without contact.
        window: (K, 3, rows, cols) float32, newest first, zeros in place of missing taps; read-only.
        peaks: of the earlier taps in the window, newest first.
    """

    def __init__(
        self,
        taps: int,
        options: RuntimeOptions = DEFAULTS,
        grid_shape: tuple[int, int] = (USPA44.rows, USPA44.cols),
    ) -> None:
        """Start without contact, with a window of K taps of a grid (rows, cols).

        Raises:
            UsageError: `taps` is less than 1.
        """
        if taps < 1:
            raise UsageError(f"taps is {taps}, expected at least 1")
        self._on_counts = options.contact_on_counts
        self._off_counts = options.contact_off_counts
        self._idle_reset_ns = options.idle_reset_s * 1e9
        self._shape = (taps, 3, *grid_shape)
        self._newest = np.zeros(self._shape[1:], dtype=np.float32)
        self._peak: TapPeak | None = None
        self.contact = False
        self.tap = -1
        self._last_contact_ns = 0
        self.reset()

    @property
    def taps_used(self) -> int:  # noqa: D102 - above
        return 1 + len(self.peaks) if self.contact else 0

    @property
    def window(self) -> NDArray[np.float32]:  # noqa: D102 - above
        window = np.zeros(self._shape, dtype=np.float32)
        if self.contact:
            window[0] = self._newest
        for slot, peak in enumerate(self.peaks, 1):
            window[slot] = peak.readings
        window.setflags(write=False)
        return window

    def reset(self) -> None:
        """Forget every tap. A tap in progress continues as the first one, with a new number."""
        self.tap += self.contact
        self.peaks: tuple[TapPeak, ...] = ()
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def forget(self, slots: Container[int]) -> None:
        """Forget the earlier taps at these places of the window; those before them move up."""
        self.peaks = tuple(peak for slot, peak in enumerate(self.peaks, 1) if slot not in slots)

    def push(
        self,
        deformation: NDArray[np.float32],
        time_ns: int,
        z_counts: float | None = None,
        taken_ns: int | None = None,
        *,
        doubted: bool = False,
    ) -> None:
        """Take one scan of zeroed counts (3, rows, cols).

        The idle time is measured between scans, from the last one in contact. Time that runs backwards counts as no
        time; a gap within a tap does not end the tap. A scan that is doubted, by `BaselineDoubt` of zeroing.py, is no
        contact, whatever its z: this ends a tap where a pad rests.
        """
        z_counts = float(deformation[2].sum()) if z_counts is None else z_counts
        if self.contact:
            self.contact = z_counts >= self._off_counts and not doubted
            if not self.contact:
                self._release()
        elif z_counts >= self._on_counts and not doubted:
            self._forget_if_idle(time_ns)
            self.contact = True
            self.tap += 1

        if self.contact:
            self._last_contact_ns = time_ns
            self._tap_scans += 1
            self._newest = deformation.copy()
            if z_counts > self._peak_counts:
                self._peak_counts = z_counts
                self._peak = TapPeak(self.tap, time_ns if taken_ns is None else taken_ns, self._newest)
        else:
            self._forget_if_idle(time_ns)

    def _release(self) -> None:
        if self._tap_scans >= MIN_TAP_SCANS and self._peak is not None:
            self.peaks = (self._peak, *self.peaks)[: self._shape[0] - 1]
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def _forget_if_idle(self, time_ns: int) -> None:
        self._last_contact_ns = min(self._last_contact_ns, time_ns)
        if time_ns - self._last_contact_ns > self._idle_reset_ns:
            self.reset()
