"""Options of a run, written once: `edge-sr` and `open_runtime` take them from here, with their meaning and default."""

import math
from dataclasses import dataclass, field
from typing import Any, Final

from edge.errors import UsageError
from edge.validation import as_float, check_whole

ON_COUNTS: Final = 1500.0  # summed z at which a tap begins: about 1.3 N, twelve times the thermal drift of one taxel
OFF_COUNTS: Final = 750.0
IDLE_RESET_S: Final = 5.0


def _option(default: Any, form: str, text: str) -> Any:
    return field(default=default, metadata={"form": form, "text": text})


# fmt: off
@dataclass(frozen=True, slots=True)
class RuntimeOptions:
    """Options of making results from scans, each with its form and text in the help of `edge-sr`."""

    contact_on_counts: float = _option(
        ON_COUNTS, "--contact-on-counts N", "a tap begins when the z readings, summed over the pad, reach N counts; "
        "some 1150 counts are 1 N (default %(default)g)")
    contact_off_counts: float = _option(
        OFF_COUNTS, "--contact-off-counts N", "a tap ends when they fall below N (default %(default)g)")
    idle_reset_s: float = _option(
        IDLE_RESET_S, "--idle-reset-s T", "forget earlier taps after T seconds without contact (default %(default)g)")
    taps: int | None = _option(
        None, "--taps K", "combine at most K taps to a pattern (default: as many as the model takes; if it takes poses "
        "of the pad and there are none 1, or as many as its name states, such as mtsr4)")
    every_scan: bool = _option(False, "--every-scan", "compute a pattern even if the readings have not changed")
    learn: bool = _option(True, "--no-learn", "do not learn from contacts how sensitive each taxel is")
    follow_drift: bool = True  # let the rest level follow the readings of a free pad
    # fmt: on

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
