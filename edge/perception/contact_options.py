"""Options of a run, under one name each from the flags of `edge-sr` to the tap tracker."""

import math
from dataclasses import dataclass
from typing import Final

from edge.errors import UsageError
from edge.validation import as_float, check_whole

ON_COUNTS: Final = 1500.0  # summed z at which a tap begins: about 1.3 N, twelve times the thermal drift of one taxel
OFF_COUNTS: Final = 750.0
IDLE_RESET_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class RuntimeOptions:
    """Options of making results from scans; each is a flag of its name, and a keyword of `open_runtime`.

    Raises:
        UsageError: the contact thresholds, the time or the taps are out of range.
    """

    contact_on_counts: float = ON_COUNTS
    contact_off_counts: float = OFF_COUNTS
    idle_reset_s: float = IDLE_RESET_S
    every_scan: bool = False
    follow_drift: bool = True
    learn: bool = True
    taps: int | None = None

    def __post_init__(self) -> None:
        on_counts, off_counts = self.contact_on_counts, self.contact_off_counts
        if not 0 < off_counts <= on_counts < math.inf:
            raise UsageError(f"contact thresholds are on {on_counts}, off {off_counts}: expected 0 < off <= on")
        idle_reset_s = as_float(self.idle_reset_s)
        if idle_reset_s is None or not idle_reset_s > 0:
            raise UsageError(f"idle_reset_s is {self.idle_reset_s} s, expected more than 0")
        if self.taps is not None:
            check_whole("taps", self.taps, 1)


DEFAULTS: Final = RuntimeOptions()
