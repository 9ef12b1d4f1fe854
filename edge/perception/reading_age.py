"""Notes on readings that were old when they arrived."""

from typing import Final

from edge.perception.event import Note
from firmware_bridge.scans.scan import Scan

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
