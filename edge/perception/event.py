"""Events and notes of a run, each of a closed set of kinds: programs read the kind, the text is made for display.

An event happens once; a note holds for as long as results carry it.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args

from firmware_bridge.errors import harmless
from firmware_bridge.links.base import Notice, NoticeKind
from firmware_bridge.scans.scan import Scan

# fmt: off
EventKind = Literal[
    NoticeKind, "sink", "reset", "refused", "poses_silent", "poses_back", "poses_trouble",
    "zeroing", "zeroed", "in_contact", "given_up", "rest_level", "baseline_doubted", "baseline_cleared",
    "tap_dropped", "suspected", "cleared", "gains_learned", "tap_without_pose", "tap_out_of_reach",
]
NoteKind = Literal[
    "held", "estimated", "dead", "frozen", "rest_level", "late", "not_checked",
    "zeroing", "zeroing_restarted", "no_stored_baseline", "not_in_sensor_file", "baseline_in_doubt",
]
# fmt: on
KINDS: Final[frozenset[str]] = frozenset(get_args(EventKind))
NOTE_KINDS: Final[frozenset[str]] = frozenset(get_args(NoteKind))

_OF_SENSOR = ("rest_level", "baseline_doubted", "gains_learned", "tap_dropped", "tap_without_pose", "tap_out_of_reach")
_TEXTS: Final = {
    "reset": "earlier taps forgotten",
    "zeroing": "sensor {sensor}: no baseline yet, zeroing since the start",
    "zeroed": "sensor {sensor} zeroed on demand: {detail}",
    "in_contact": "zeroing refused: sensor {sensor} is in contact: free the pad, or force it "
    '(Z, or {{"cmd": "zero", "force": true}})',
    "given_up": "sensor {sensor}: zeroing given up, the old baseline stays: {detail}",
    "suspected": "sensor {sensor} is suspected: {detail}",
    "cleared": "sensor {sensor}: contacts read as they should again",
    "baseline_cleared": "sensor {sensor}: the baseline is no longer in doubt",
    **dict.fromkeys(_OF_SENSOR, "sensor {sensor}: {detail}"),
}
"""Texts of kinds that say more than their detail."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a run.

    Attributes:
        time_ns: monotonic time, in [ns].
        kind: one of KINDS, which docs/formats.md describes.
        sensor: name of the sensor, or None if the event concerns all, or none.
        detail: what the kind leaves open, in a user's words.
        sensors: common prefix of the names of the sensors that an event of a link concerns, as in `Notice`.
    """

    time_ns: int
    kind: EventKind
    sensor: str | None
    detail: str = ""
    sensors: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "detail", harmless(self.detail))

    @property
    def text(self) -> str:
        """Text of the event in a user's words."""
        return _TEXTS.get(self.kind, "{detail}").format(sensor=self.sensor, detail=self.detail)

    @classmethod
    def of(cls, notice: Notice) -> "Event":
        """Return the event of a link's notice."""
        return cls(notice.time_ns, notice.kind, None, notice.text, notice.sensors)


class Report(Protocol):
    """Takes an event of a sensor: its kind, and what that leaves open."""

    def __call__(self, kind: EventKind, detail: str = "") -> object: ...  # noqa: D102 - above


@dataclass(frozen=True, slots=True)
class Note:
    """One remark on a result for its user.

    Attributes:
        kind: one of NOTE_KINDS, which docs/formats.md describes.
        text: in a user's words.
    """

    kind: NoteKind
    text: str


def joined(parts: Iterable[Event | Note]) -> str | None:
    """Return the texts of events or notes in one line; None without any."""
    return "; ".join(part.text for part in parts) or None


OLD_NS: Final = 50_000_000
"""Age from which a reading is old, in [ns], by the device's time stamps and counted from its fastest recent reading:
three times as long as a slow adapter holds readings."""


def age_notes(scan: Scan) -> tuple[Note, ...]:
    """Return the notes on a scan whose readings were old."""
    if scan.device_ns is None:
        if scan.unread_ns <= OLD_NS:
            return ()
        text = (
            f"this reading may have been {scan.unread_ns / 1e9:.2f} s old when it arrived: nothing was read meanwhile"
        )
        return (Note("late", text),)
    if scan.time_ns - scan.device_ns <= OLD_NS:
        return ()
    return (Note("late", f"this reading was {(scan.time_ns - scan.device_ns) / 1e9:.2f} s old when it arrived"),)


UNCHECKED: Final = Note("not_checked", "not checked: the model has no checks")
"""Note on each pattern of a model that nothing is known of by which to believe it."""


def waited_note(waited_ns: int) -> Note:
    """Return the note on a pattern that was ready more than OLD_NS after its newest reading arrived, in [ns]."""
    return Note("late", f"this pattern was ready {waited_ns / 1e9:.2f} s after its newest reading arrived")


def notes_on_missing(sensor: str, mounted: Collection[str], zeroed: Collection[str]) -> tuple[Note, ...]:
    """Return notes on what is stored for other sensors, `mounted` or `zeroed`, but not for this one."""
    notes: list[Note] = []
    if mounted and sensor not in mounted:
        others = ", ".join(sorted(mounted))
        text = f"the sensor file has no sensor {sensor}, only {others}: taken as wired"
        notes.append(Note("not_in_sensor_file", text))
    if zeroed and sensor not in zeroed:
        text = f"no stored baseline for sensor {sensor}, only for {', '.join(sorted(zeroed))}: zeroing"
        notes.append(Note("no_stored_baseline", text))
    return tuple(notes)
