"""Run among faults that is made by hand, for the tests of its evaluation."""

import numpy as np
from fault_accounts import DIFFERENT, accounts
from fault_judge import judge
from fault_log import Told
from fault_played import telling_counts
from fault_records import Seen
from fault_truth import FATES, ROW

from firmware_bridge.scans.can_id_maps import USPA44_MAP

PERIOD_NS = 10_000_000
COUNTERS = ("frames", "foreign", "bad_lines", "skipped_bytes", "duplicates")
ALL = 0xFFFF


class Forged:
    """A run of one sensor that went well, to be spoilt in one place."""

    def __init__(self, cycles: int = 20):
        counts = telling_counts(0)[:cycles].reshape(cycles, 3, 16)
        self.rows = np.zeros(16 * cycles, dtype=ROW)
        self.seen: list[Seen] = []
        self.events: list[dict] = []
        for cycle in range(cycles):
            for at, (can_id, taxel) in enumerate(USPA44_MAP.wire_order("4")):
                row = self.rows[16 * cycle + at]
                row["can_id"], row["cycle"], row["bus_us"] = can_id, cycle, 10_000 * cycle + 130 * at
                row["handed_ns"] = row["written_ns"] = PERIOD_NS * cycle + 130_000 * at
                row["xyz"] = counts[cycle, :, taxel]
            self.seen.append(self.record(cycle, counts[cycle].T))

    def record(self, number: int, counts: np.ndarray, **changes) -> Seen:
        time_ns = PERIOD_NS * number + 2_000_000
        counters = dict.fromkeys(
            (*COUNTERS, "non_ascii_lines", "readings", "unconfirmed", "abandoned", "missing_taxels", "missed"), 0
        )
        counters |= {"frames": 16 * (number + 1), "readings": 16 * (number + 1), "scans": number + 1}
        head = {"sensor": "4", "scan": number, "time_ns": time_ns, "fresh": ALL, "renewed": ALL, "dead": {}}
        head |= {"device_time_ns": time_ns - 1_000_000, "latency_us": 1000.0, "note": None}
        return Seen(time_ns + 1_000_000, head | {"counters": counters} | changes, counts.astype(np.int32), True)

    def change(self, number: int, **changes) -> None:
        """Change entries in the head of a record."""
        one = self.seen[number]
        self.seen[number] = one._replace(head=one.head | changes)

    @property
    def told(self) -> Told:
        fates = {FATES[fate]: int((self.rows["fate"] == fate).sum()) for fate in set(self.rows["fate"].tolist())}
        counters = dict.fromkeys(COUNTERS, 0) | {"frames": sum(fates.get(name, 0) for name in FATES[:6])}
        account = {"counters": counters, "fates": fates, "begun": {}, "noise": 0, "openings": 1}
        return Told(self.rows, self.events, account)

    def judged(self):
        return judge(self.seen, self.told)


def differing(found, forged: Forged) -> list[str]:
    return [book.name for book in accounts(found, forged.told) if book.verdict == DIFFERENT]


def outage(name: str, begin_s: float, end_s: float) -> list[dict]:
    stretch = f"{name}@{begin_s}"
    return [
        {"time_ns": int(1e9 * time_s), "what": what, "fault": name, "stretch": stretch}
        for what, time_s in (("begin", begin_s), ("end", end_s))
    ]
