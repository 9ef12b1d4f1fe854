"""What happens beside scans, for those who follow a run: in records, on the terminal."""

from dataclasses import dataclass
from typing import Final

from firmware_bridge.links.base import Notice

KINDS: Final = ("lost", "silent", "back", "trouble", "well", "sink", "note", "refused")


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened.

    Attributes:
        time_ns: monotonic time, in [ns].
        kind: one of KINDS: the link's ("lost", "silent", "back", "trouble", "well"), of one sensor's silence while
            others go on ("silent", "back"), "sink", one was given up or nobody reads it, "note", what is to be known of
            a recording, or what is told to those who look alone: "refused", what was asked for and is not done, and
            "note", all else.
        sensor: of which sensor, or None.
        text: in a user's words.
    """

    time_ns: int
    kind: str
    sensor: str | None
    text: str

    @classmethod
    def of(cls, notice: Notice) -> "Event":
        """What a link had to tell."""
        return cls(notice.time_ns, notice.kind, None, notice.text)
