"""Events of a run, which happen once, and notes, which results carry: programs read the kind, people the text."""

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
# Texts of kinds that say more than their detail.
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


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a run; docs/formats.md describes the kinds."""

    time_ns: int  # monotonic
    kind: EventKind
    sensor: str | None  # None if the event concerns all, or none
    detail: str = ""  # what the kind leaves open, in a user's words
    sensors: str = ""  # common prefix of the names of the sensors that an event of a link concerns, as in `Notice`

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
    """Takes an event of a sensor."""

    def __call__(self, kind: EventKind, detail: str = "") -> object: ...  # noqa: D102 - above


@dataclass(frozen=True, slots=True)
class Note:
    """One remark on a result, in a user's words; docs/formats.md describes the kinds."""

    kind: NoteKind
    text: str


def joined(parts: Iterable[Event | Note]) -> str | None:
    """Return the texts of events or notes in one line; None without any."""
    return "; ".join(part.text for part in parts) or None


# Age from which a reading is old, by the device's time stamps and counted from its fastest recent reading: three times
# as long as a slow adapter holds readings.
OLD_NS: Final = 50_000_000


def age_notes(scan: Scan) -> tuple[Note, ...]:
    """Return the notes on a scan whose readings were old, or may have been where nothing was read meanwhile."""
    old_ns, was = scan.unread_ns, "may have been"
    if scan.device_ns is not None:
        old_ns, was = scan.time_ns - scan.device_ns, "was"
    return (Note("late", f"this reading {was} {old_ns / 1e9:.2f} s old when it arrived"),) if old_ns > OLD_NS else ()


UNCHECKED: Final = Note("not_checked", "not checked: the model has no checks")


def notes_on_missing(sensor: str, mounted: Collection[str], zeroed: Collection[str]) -> tuple[Note, ...]:
    """Return notes on what is stored for other sensors, `mounted` or `zeroed`, but not for this one."""
    notes: list[Note] = []
    if mounted and sensor not in mounted:
        text = f"the sensor file has no sensor {sensor}, only {', '.join(sorted(mounted))}: taken as wired"
        notes.append(Note("not_in_sensor_file", text))
    if zeroed and sensor not in zeroed:
        text = f"no stored baseline for sensor {sensor}, only for {', '.join(sorted(zeroed))}: zeroing"
        notes.append(Note("no_stored_baseline", text))
    return tuple(notes)
