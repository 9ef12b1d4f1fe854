"""Zeroing again while a sensor runs; the old baseline stays in use until there is a new one."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Note
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline, BaselineEstimator

GIVE_UP_NS: Final = 15_000_000_000
"""Longest zeroing on demand, in [ns] of scan time: ten tries at 100 Hz, and four at 30 Hz."""


class Rezeroing:
    """Zeroing of one sensor on demand: takes one new baseline, or gives up.

    Attributes:
        note: its progress.
    """

    def __init__(self, old: Baseline | None, *, force: bool, unix_time_s: Callable[[], float] = time.time) -> None:
        """Start with the next scan.

        Args:
            old: the baseline so far; a load shows as a difference from it. None zeroes away a load.
            force: zero away a contact.
            unix_time_s: dates the new one, in [s] since 1970.
        """
        self.note = Note("zeroing", "zeroing: keep the pad still and free")
        self._old = old
        self._force = force
        self._unix_time_s = unix_time_s
        self._end_ns: int | None = None
        self._why = f"fewer than {FEWEST_SCANS} whole scans"
        self._estimator = self._new_estimator()

    def push(self, scan: Scan, contact: bool, silent: NDArray[np.bool_] | None) -> Baseline | None:
        """Take one more scan; return the new baseline once there are enough.

        Args:
            scan: the sensor's next one.
            contact: True while a tap goes on, which starts the zeroing over unless it is forced.
            silent: taxels (rows, cols) to zero without, as in `BaselineEstimator.push`.

        Raises:
            BaselineRefusedError: the tries have taken too long; the message gives the last reason. The old baseline
                stays.
        """
        if self._end_ns is None:
            self._end_ns = scan.time_ns + GIVE_UP_NS
        if scan.time_ns >= self._end_ns:
            raise BaselineRefusedError(f"{self._why}; tried for {GIVE_UP_NS / 1e9:.0f} s")
        try:
            if contact and not self._force:
                if self._estimator.scans:
                    self._estimator = self._new_estimator()
                raise BaselineRefusedError("the pad is in contact: free it")
            taken = self._estimator.push(scan, silent)
        except BaselineRefusedError as refusal:
            self._why = str(refusal)
            self.note = Note("zeroing_restarted", f"zeroing started over: {refusal}")
            return None
        return None if taken is None else replace(taken, origin="demand")

    def _new_estimator(self) -> BaselineEstimator:
        return BaselineEstimator(reference=self._old, clock=self._unix_time_s)
