"""Advice to a person whose source gives no scan: first what came, by the counters of what was received."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Final

FEWEST_BAD_LINES: Final = 4
"""Lines without a CAN frame from which a port is none of an slcan adapter: an adapter that was reset may send one."""
FEWEST_SKIPPED_BYTES: Final = 120  # the same of bytes that belong to no line at all: four of the longest lines
_MESSAGES: Final = {
    "without_readings": "they name no sensor: is one plugged in, and in the server's xServ.ini?",
    "foreign_sensor": "their sensors are of another pad: --id-map",
    "bad_sensor": "the counts of their sensors are not those of a pad",
    "bad_json": "they are no JSON: another server answers at this address",
    "bad_sequence": "they have no number: another server answers at this address",
    "too_long": "they are too long: another server answers at this address",
    "duplicate_keys": "their keys are not unique: another server answers at this address",
    "welcomes": "the server only greets: is a sensor plugged in, and in its xServ.ini?",
}
"""Reasons why messages of a server gave no reading, by their counters."""


def silence_hint(sources: Sequence[str], counters: Callable[[], Mapping[str, int]]) -> str:
    """Return what came of the sources, as the user named them, what may be wrong, and what to do."""
    source = f" --source {shlex.quote(sources[0])}" if len(sources) == 1 else ""
    doctor = f"edge-sr doctor{source} shows what is wrong"
    arrived = counters()
    frames, received, messages = (arrived.get(name, 0) for name in ("frames", "received_bytes", "messages"))
    if messages:
        why = max(_MESSAGES, key=lambda name: arrived.get(name, 0))
        if arrived.get(why, 0):
            return f"{messages} messages came from the server, and no reading in them: {_MESSAGES[why]}; {doctor}"
        return f"{messages} messages came from the server, and no whole scan in them; {doctor}"
    if frames:
        came = "none of a taxel: another kind of pad (--id-map), or another bus"
        if arrived.get("readings", 0):
            came = "no whole scan: frames are lost, or this is another kind of pad (--id-map)"
        return f"{frames} CAN frames came, and {came}; {doctor}"
    bad, binary = arrived.get("bad_lines", 0), arrived.get("non_ascii_lines", 0)
    if bad + binary >= FEWEST_BAD_LINES or arrived.get("skipped_bytes", 0) >= FEWEST_SKIPPED_BYTES:
        what = "text of another device (a modem, a GPS receiver)"
        if not bad + binary:
            what = "no line that ends as an adapter's: another device, such as one whose lines end with LF alone"
        elif binary > bad:
            what = "no text: another line speed than the adapter's, or another device"
        return (
            f"{received} bytes came, and no CAN frame in them: {what}; edge-sr devices lists what is plugged in, and "
            "@BAUD after the port sets a speed"
        )
    errors = sum(arrived.get(name, 0) for name in ("error_frames", "fd_frames"))
    if errors:
        return (
            f"{errors} error frames or frames of CAN FD came, and no reading: the bus runs at another bitrate than "
            f"1 Mbit/s, or lacks its termination; {doctor}"
        )
    if arrived.get("refusals", 0):
        return f"the adapter refused {arrived['refusals']} commands, and sent no CAN frame; {doctor}"
    came = f"{received} bytes came, the adapter's answers alone" if received else "nothing came"
    return f"{came}: is the sensor powered and its cable in? {doctor}"
