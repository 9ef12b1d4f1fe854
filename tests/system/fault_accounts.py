"""What was lost and what came in a run among faults, counted by the injector and by the program."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from fault_judge import Found

from firmware_bridge.emulation.fault_log import Told


@dataclass(frozen=True, slots=True)
class Account:
    """One count, by the injector and by the program.

    Attributes:
        name: of what.
        told: by the injector, or found in records.
        counted: by the program.
        fewer: by how much the first may be less where equality cannot be: what was in records that were left out for
            a reader that was too slow, here ourselves.
    """

    name: str
    told: int
    counted: int
    fewer: int = 0

    @property
    def verdict(self) -> str:
        """Equal, consistent, or no."""
        if self.told == self.counted:
            return EQUAL
        return CONSISTENT if 0 < self.counted - self.told <= self.fewer else DIFFERENT

    @property
    def tolerance(self) -> str:
        """By how much they may differ."""
        return f"up to {self.fewer} fewer in records" if self.fewer else "0"


EQUAL, CONSISTENT, DIFFERENT = "equal", "consistent", "no"
TAXELS: Final = 16
_RECEIVED = re.compile(r"^received: (.*)$", re.MULTILINE)


def counted_at_the_end(said: str) -> dict[str, int]:
    """The counters in the summary of a run: what came behind its last record is in them, too."""
    lines = _RECEIVED.findall(said)
    pairs = (text.rpartition(" ") for text in lines[-1].split(", ")) if lines else ()
    return {name: int(count) for name, _, count in pairs if count.isdigit()}


def accounts(found: Found, told: Told, said: str = "") -> list[Account]:
    """Return what was lost and what came, by both sides; `said` is the program's summary.

    A record that was left out held a reading or a missing taxel in each of its sixteen places. How many of which, the
    program's own count of missing ones alone tells; so that account can be no more than consistent, and with it the
    one of readings closes exactly.
    """
    truth: Mapping[str, Any] = told.accounts["counters"]
    counted = {**found.last_counters, **counted_at_the_end(said)}
    left_out = counted.get("unwritten", 0)
    readings = truth["frames"] - truth["foreign"]
    explained = counted["duplicates"] + counted["unconfirmed"]
    explained += counted.get("abandoned", 0) + counted.get("resynchronised", 0)
    explained += TAXELS * left_out - (counted["missing_taxels"] - found.missing)
    return [
        Account("frames", truth["frames"], counted["frames"]),
        Account("foreign frames", truth["foreign"], counted["foreign"]),
        Account("lines that are no frame", truth["bad_lines"], counted["bad_lines"] + counted["non_ascii_lines"]),
        Account("bytes of no frame", truth["skipped_bytes"], counted["skipped_bytes"]),
        Account("readings", readings, counted["readings"]),
        Account("frames twice in a row", truth["duplicates"], counted["duplicates"]),
        Account("readings in no record", found.unshown, explained),
        Account("taxels missing in records", found.missing, counted["missing_taxels"], TAXELS * left_out),
        Account("records of scans", found.records + left_out, counted["scans"]),
    ]
