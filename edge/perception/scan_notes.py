"""Notes on the scans of a sensor: old readings, patterns that were ready late, and stored settings that are missing."""

from collections.abc import Collection
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


UNCHECKED: Final = Note("not_checked", "not checked: the model has no checks")
"""Note on each pattern of a model that nothing is known of by which to believe it."""


def waited_note(waited_ns: int) -> Note:
    """Return the note on a pattern that was ready more than OLD_NS after its newest reading arrived, in [ns]."""
    return Note("late", f"this pattern was ready {waited_ns / 1e9:.2f} s after its newest reading arrived")


def notes_on_missing(sensor: str, mounted: Collection[str], zeroed: Collection[str]) -> tuple[Note, ...]:
    """Return notes on what is stored for other sensors, but not for this one.

    Args:
        sensor: name of this one.
        mounted: names of the sensors with a mounting.
        zeroed: names of the sensors with a baseline.
    """
    notes: list[Note] = []
    if mounted and sensor not in mounted:
        known = ", ".join(sorted(mounted))
        text = f"the sensor file has no sensor {sensor}, only {known}: taken as wired"
        notes.append(Note("not_in_sensor_file", text))
    if zeroed and sensor not in zeroed:
        text = f"no stored baseline for sensor {sensor}, only for {', '.join(sorted(zeroed))}: zeroing"
        notes.append(Note("no_stored_baseline", text))
    return tuple(notes)
