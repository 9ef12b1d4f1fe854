"""Accounts of a run among faults: losses and arrivals, counted by the injector and by the program."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from fault_judge import Found
from fault_log import Told


@dataclass(frozen=True, slots=True)
class Account:
    """One count, by the injector and by the program.

    Attributes:
        name: what is counted.
        injected: count by the injector, or detected in records.
        counted: count by the program.
        fewer: by how much `injected` may be less where equality is impossible.
        more: by how much `injected` may be more.
        why: reason that it may be less or more.
    """

    name: str
    injected: int
    counted: int
    fewer: int = 0
    more: int = 0
    why: str = ""

    @property
    def verdict(self) -> str:
        """Verdict: equal, consistent within the tolerance, or no."""
        if self.injected == self.counted:
            return EQUAL
        return CONSISTENT if -self.fewer <= self.injected - self.counted <= self.more else DIFFERENT

    @property
    def tolerance(self) -> str:
        """Difference that is allowed between both counts, with its reason."""
        return (
            f"{f'+{self.more}' if self.more else ''}{f'-{self.fewer}' if self.fewer else ''} {self.why}".strip() or "0"
        )


EQUAL, CONSISTENT, DIFFERENT = "equal", "consistent", "no"
TAXELS: Final = 16
LINE_BYTES: Final = 26
"""Length of a frame with a time stamp."""
_RECEIVED = re.compile(r"^received: (.*)$", re.MULTILINE)


def counted_at_the_end(said: str) -> dict[str, int]:
    """Return the counters in the summary of a run, which include what came after its last record."""
    lines = _RECEIVED.findall(said)
    pairs = (text.rpartition(" ") for text in lines[-1].split(", ")) if lines else ()
    return {name: int(count) for name, _, count in pairs if count.isdigit()}


def accounts(found: Found, told: Told, said: str = "") -> list[Account]:
    """Return the accounts of losses and arrivals by both sides; `said` is the program's summary.

    A record that was left out held a reading or a missing taxel in each of its sixteen places. Only the program's own
    count of missing taxels shows how many there were of each. So that account can be no more than consistent, and with
    it the account of readings closes exactly.

    Lines of events that were left out are counted with those of scans. A scan that the program counted, and that is in
    no record and not left out, is missed all the same.

    An opening drops what lies in the terminal. Where the injector did not run meanwhile, it detects nothing there and
    takes those bytes as read. The program counts the bytes that were dropped, the injector those of them that it has as
    unread; the difference is frames that only one side has.
    """
    truth: Mapping[str, Any] = told.accounts["counters"]
    counted = {**found.last_counters, **counted_at_the_end(said)}
    left_out = counted.get("unwritten", 0)
    events_left_out = min(left_out, max(0, found.records + left_out - counted["scans"]))
    scans_left_out = left_out - events_left_out
    readings = truth["frames"] - truth["foreign"]
    explained = counted["duplicates"] + counted["unconfirmed"]
    explained += counted.get("abandoned", 0) + counted.get("resynchronised", 0)
    explained += TAXELS * scans_left_out - (counted["missing_taxels"] - found.missing)
    unread = told.accounts["fates"].get("unread", 0)
    dropped = max(0, counted.get("dropped_bytes", 0) - LINE_BYTES * unread) // LINE_BYTES
    cut = LINE_BYTES * min(dropped, counted.get("reopenings", 0))
    bad_lines = counted["bad_lines"] + counted["non_ascii_lines"]

    def of_what_was_dropped(name: str, handed_on: int, came: int, fewer: int = 0, more: int = dropped) -> Account:
        return Account(name, handed_on, came, fewer, more, "dropped at openings" if more else "")

    return [
        of_what_was_dropped("frames", truth["frames"], counted["frames"]),
        of_what_was_dropped("foreign frames", truth["foreign"], counted["foreign"]),
        of_what_was_dropped("lines that are no frame", truth["bad_lines"], bad_lines),
        of_what_was_dropped(
            "bytes of no frame", truth["skipped_bytes"], counted["skipped_bytes"], cut, LINE_BYTES * dropped
        ),
        of_what_was_dropped("readings", readings, counted["readings"]),
        of_what_was_dropped("frames twice in a row", truth["duplicates"], counted["duplicates"]),
        of_what_was_dropped("readings in no record", found.unshown, explained),
        Account(
            "taxels missing in records",
            found.missing,
            counted["missing_taxels"],
            TAXELS * scans_left_out,
            why="in records left out" if scans_left_out else "",
        ),
        Account(
            "records of scans",
            found.records + left_out,
            counted["scans"],
            more=events_left_out,
            why="events left out" if events_left_out else "",
        ),
    ]
