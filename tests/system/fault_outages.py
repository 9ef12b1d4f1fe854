"""Times that a run among faults took to go on after an outage."""

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from fault_judge import Found
from fault_log import Told
from fault_stretches import LINK_FAULTS, RESET

NEVER_NS: Final = 2**62
OUTAGES: Final = (*LINK_FAULTS, "bus-off")
LONGEST_BACK_S: Final = 1.0
"""Within this time a link that is back is to be used: from then on nothing that follows excuses a wait."""


def seconds_to_use(found: Found, told: Told, names: Sequence[str]) -> list[float]:
    """Return the time from the end of each outage of these names to the first record of what came after it, in [s].

    An adapter's reset is over at once. The time is inf where no further record came. Outages that did not end are left
    out, and so are those that another one overlaps or follows before the first record and before LONGEST_BACK_S are
    over; but where no further record came, only another outage that did not end excuses it.
    """
    outages = list(_outages(told))
    handed_ns, arrived_ns = np.array(found.arrivals, dtype=np.int64).reshape(-1, 2).T
    times: list[float] = []
    for name, begin_ns, end_ns in outages:
        if name not in names or end_ns == NEVER_NS:
            continue
        others = [(begin, end) for what, begin, end in outages if (what, begin) != (name, begin_ns)]
        used_ns = int(arrived_ns[handed_ns > end_ns].min(initial=NEVER_NS))
        if used_ns == NEVER_NS:
            others = [(begin, end) for begin, end in others if end == NEVER_NS]
        due_ns = min(used_ns, end_ns + round(1e9 * LONGEST_BACK_S))
        if not any(begin <= due_ns and end >= begin_ns for begin, end in others):
            times.append((used_ns - end_ns) / 1e9 if used_ns < NEVER_NS else math.inf)
    return times


def _outages(told: Told) -> Iterator[tuple[str, int, int]]:
    """Yield stretches without data of any sensor: name, begin and end in [ns]; NEVER_NS without an end."""
    begun: dict[str, tuple[str, int]] = {}
    for event in told.events:
        if event["fault"] not in OUTAGES and not event["stretch"].startswith("vanished=1@"):
            continue
        if event["what"] == "begin":
            begun[event["stretch"]] = event["fault"], event["time_ns"]
            continue
        fault, begin_ns = begun.pop(event["stretch"])
        yield fault, begin_ns, begin_ns if fault == RESET else event["time_ns"]
    for fault, begin_ns in begun.values():
        yield fault, begin_ns, begin_ns if fault == RESET else NEVER_NS
