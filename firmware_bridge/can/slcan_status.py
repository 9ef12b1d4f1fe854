"""Status that an slcan adapter reports: flags, changes of state, errors on the bus. No I/O, no clock.

    Fxx         answer to `F`: eight flags (Lawicel CAN232 manual, version 3), which the request clears
    saRRRTTT    the state, a active, w warning, p passive, b bus-off, and two error counts (Linux slcan-core.c)
    eNxx...     N errors on the bus, a letter each (Linux slcan-core.c)

EasySYNC adapters answer with other flags and without the F: that is a bad line.
"""

import re
from collections.abc import Iterable
from typing import Final

from firmware_bridge.schedule import ADAPTER_ASKED_NS

STATUS_FLAGS: Final = b"F\r"

FLAGS: Final = {
    0x01: "rx_full",
    0x02: "tx_full",
    0x04: "error_warning",
    0x08: "overrun",
    0x20: "error_passive",
    0x40: "arbitration_lost",
    0x80: "bus_error",
}
_STATES: Final = {"a": "error_active", "w": "error_warning", "p": "error_passive", "b": "bus_off"}
_ERRORS: Final = {
    "a": "ack_error",
    "b": "bit_error",
    "B": "bit_error",
    "c": "crc_error",
    "f": "form_error",
    "o": "overrun",
    "O": "tx_overrun",
    "s": "stuff_error",
}
INTERVAL_NS: Final = 5_000_000_000
MOST_UNANSWERED: Final = 3
FRAMES_TO_FORGET: Final = 1600  # frames after which a loss that an error line reported is over: a second of one sensor

BUS_OFF: Final = "the adapter reports bus-off: check bitrate, wiring and termination"
BUS_ERRORS: Final = "the adapter reports errors on the bus, and no frame arrives: check bitrate, wiring and termination"
FRAMES_LOST: Final = "the adapter lost frames: they arrive faster than it forwards them"

_STATUS = re.compile(rb"s[awpb][0-9]{6}|e[1-9][abBcfoOs]{1,9}")
_FLAGS = re.compile(rb"F[0-9A-Fa-f]{2}")


class AdapterStatus:
    """Counters of the adapter's reports, and the trouble that a user must learn of.

    Attributes:
        counts: numbers of unsolicited status lines, of answers to `F`, and of each kind of report so far.
    """

    def __init__(self) -> None:
        self.counts = {"status_lines": 0, "status_answers": 0}
        self._flags: frozenset[str] = frozenset()
        self._off_at_frame: int | None = None
        self._lost_at_frame: int | None = None

    def hear(self, line: bytes, frames: int) -> bool:
        """Process a line without its end, after so many frames in all; False if it is no status line."""
        if _FLAGS.fullmatch(line):
            value = int(line[1:], 16)
            self._flags = frozenset(name for bit, name in FLAGS.items() if value & bit)
            self.counts["status_answers"] += 1
            self._count(self._flags)
        elif _STATUS.fullmatch(line) and line[:1] == b"s":
            state = _STATES[chr(line[1])]
            self._off_at_frame = frames if state == "bus_off" else None
            self.counts["status_lines"] += 1
            self._count([state])
        elif _STATUS.fullmatch(line) and int(line[1:2]) == len(line) - 2:
            errors = [_ERRORS[letter] for letter in line[2:].decode()]
            if "overrun" in errors:
                self._lost_at_frame = frames
            self.counts["status_lines"] += 1
            self._count(errors)
        else:
            return False
        return True

    def trouble(self, frames: int, *, flags_of_a_silence: bool = False) -> str | None:
        """Return the trouble to report to the user, None if there is none.

        Bus-off is over when a frame comes, of so many `frames` so far; a loss that flags reported, when the next flags
        do not contain it. `flags_of_a_silence` is True where no frame comes, and the flags were requested since the
        last one: the flags of any bus hold an error now and then, which is no trouble while frames come.
        """
        if self._off_at_frame == frames:
            return BUS_OFF
        if flags_of_a_silence and self._flags & {"error_passive", "bus_error"}:
            return BUS_ERRORS
        recent = self._lost_at_frame is not None and frames - self._lost_at_frame < FRAMES_TO_FORGET
        return FRAMES_LOST if recent or self._flags & {"rx_full", "overrun"} else None

    def forget(self) -> None:
        """Forget the flags reported last, since the adapter no longer answers."""
        self._flags = frozenset()

    def _count(self, names: Iterable[str]) -> None:
        for name in names:
            key = f"adapter_{name}"
            self.counts[key] = self.counts.get(key, 0) + 1


class StatusQuestions:
    """Schedule of the requests for the status flags.

    The flags are requested after ADAPTER_ASKED_NS without a scan, when they can explain the silence, and otherwise at
    most once in INTERVAL_NS: some adapters obey one command a USB packet, the answer arrives among the frames, and a
    request clears the flags for every other reader. An adapter that refuses, or leaves MOST_UNANSWERED requests
    unanswered, is not asked again.
    """

    def __init__(self, status: AdapterStatus) -> None:
        """Prepare requests to the adapter whose lines `status` receives."""
        self._status = status
        self._asked = self._answers = self._refusals = self._unanswered = 0
        self._due_ns = self._scan_ns = 0
        self._answers_before_silence: int | None = None

    @property
    def answered_in_silence(self) -> bool:
        """True where no scan comes, and flags were requested and answered since the last one."""
        before = self._answers_before_silence
        return before is not None and self._status.counts["status_answers"] > before

    def reopened(self) -> None:
        """Allow requests again after the channel was reopened, if the adapter has ever answered."""
        if self._status.counts["status_answers"]:
            self._unanswered = 0

    def due(self, scans: int, refusals: int, now_ns: int) -> bool:
        """Return True if a request is due, which then counts as sent; to be called at every read.

        `scans` is the number of scans that this read returned at `now_ns`, and `refusals` that of BELs so far.
        """
        if not self._due_ns:  # the first read of all: silent from here on
            self._scan_ns, self._due_ns = now_ns, now_ns + INTERVAL_NS
        if scans:
            self._scan_ns, self._answers_before_silence = now_ns, None
        answers = self._status.counts["status_answers"]
        if self._answers_before_silence is None and now_ns - self._scan_ns >= ADAPTER_ASKED_NS:
            self._answers_before_silence = answers
        elif now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + INTERVAL_NS
        if self._asked:
            self._unanswered = 0 if answers > self._answers else self._unanswered + 1
            if self._unanswered and refusals > self._refusals:
                self._unanswered = MOST_UNANSWERED
            if self._unanswered >= MOST_UNANSWERED:
                self._status.forget()
        self._asked, self._answers, self._refusals = 1, answers, refusals
        return self._unanswered < MOST_UNANSWERED
