"""Fault intervals: the format that a user writes, and a mixture of all faults.

lost@2+3                from the second second on, for three seconds
lost=.05@2+3            one frame in twenty
dead=6.11@2+3           taxel 11 of sensor 6
dead=6.11@2+.008        one frame of it, at 100 scans a second
unplug@8+.5,garbage@9+2
mixed@5+600             all of them, drawn from the seed, for ten minutes
"""

import math
import random
from collections.abc import Sequence
from typing import Final, NamedTuple

from fault_frames import FRAME_FAULTS
from fault_lines import LINE_FAULTS

BURSTS: Final = "bursts"
"""Fault of an adapter that holds bytes back for 16 ms, the default of an FTDI chip."""
UNPLUG: Final = "unplug"
"""Fault in which the cable is pulled, and comes back under a name from the kernel."""
RENAME: Final = "rename"
"""Fault in which the cable is pulled, and comes back under another name."""
RESET: Final = "reset"
"""Fault in which the adapter restarts, its cable in: channel closed, at another bitrate than the sensor's."""
LINK_FAULTS: Final = (UNPLUG, RENAME, RESET)
NAMES: Final = (*FRAME_FAULTS, *LINE_FAULTS, BURSTS, *LINK_FAULTS)
MIXED: Final = "mixed"

LONGEST_OUTAGE_S: Final = 1.5
CALM_S: Final = 3.0
"""Time without faults at the end of a mixture, to settle all accounts, and between two breaks of the link, in [s]."""


class Stretch(NamedTuple):
    """Fault and its interval, in [s] since the channel was first opened; `parameter` is empty for the usual one."""

    name: str
    parameter: str
    start_s: float
    end_s: float

    def __str__(self) -> str:
        parameter = f"={self.parameter}" if self.parameter else ""
        return f"{self.name}{parameter}@{self.start_s:.2f}+{self.end_s - self.start_s:.2f}"


def parse_stretches(text: str, seed: int = 0) -> list[Stretch]:
    """Parse the fault intervals that a user wrote.

    Args:
        text: stretches in the format above, separated by commas.
        seed: seed of a mixture.

    Raises:
        ValueError: no such fault, or no such time.
    """
    stretches: list[Stretch] = []
    for part in text.split(","):
        what, _, when = part.strip().partition("@")
        name, _, parameter = what.partition("=")
        start_s, long_s = (_seconds(number, part) for number in when.partition("+")[::2])
        if name == MIXED:
            stretches += mixture(start_s, long_s, seed)
        elif name in NAMES:
            stretches.append(Stretch(name, parameter, start_s, start_s + long_s))
        else:
            raise ValueError(f"fault is {name!r}, expected one of: {', '.join((*NAMES, MIXED))}")
    return sorted(stretches, key=lambda stretch: stretch.start_s)


def mixture(start_s: float, long_s: float, seed: int) -> list[Stretch]:
    """Draw all faults in turns, each turn in another order, several at once; breaks of the link well apart.

    Args:
        start_s: earliest begin of the first fault, in [s].
        long_s: duration from then on, in [s]; its last CALM_S are without faults.
        seed: seed of order, times and lengths.
    """
    draw = random.Random(f"mixture {seed}")
    end_s = start_s + long_s - CALM_S
    stretches: list[Stretch] = []
    for names, pause_s in (((*FRAME_FAULTS, *LINE_FAULTS, BURSTS), 0.4), (LINK_FAULTS, CALM_S)):
        time_s = start_s + draw.uniform(0, pause_s)
        turn: Sequence[str] = ()
        while True:
            turn = turn or draw.sample(names, len(names))
            name, turn = turn[0], turn[1:]
            long_s = draw.uniform(0.2, LONGEST_OUTAGE_S)
            if time_s + long_s > end_s:
                break
            stretches.append(Stretch(name, "", time_s, time_s + long_s))
            time_s += draw.uniform(0.5, 1.5) * pause_s + (long_s if name in LINK_FAULTS else 0.0)
    return sorted(stretches, key=lambda stretch: stretch.start_s)


def _seconds(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise ValueError(f"fault is {part!r}, expected NAME@START+LENGTH in seconds, such as lost@2+3")
    return value
