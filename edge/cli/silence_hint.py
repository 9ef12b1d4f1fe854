"""Advice to a person whose source gives no scan at all."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Final

FEWEST_BAD_LINES: Final = 4
"""Lines without a CAN frame from which a port is none of an slcan adapter: an adapter that was reset may send one."""


def silence_hint(sources: Sequence[str], counters: Callable[[], Mapping[str, int]]) -> str:
    """Return what may be wrong, from what arrived so far, and what to do.

    Args:
        sources: as the user named them.
        counters: returns those of the open source.
    """
    source = f" --source {shlex.quote(sources[0])}" if len(sources) == 1 else ""
    doctor = f"edge-sr doctor{source} shows what is wrong"
    arrived = counters()
    frames, received = arrived.get("frames", 0), arrived.get("received_bytes", 0)
    bad = sum(arrived.get(name, 0) for name in ("bad_lines", "non_ascii_lines"))
    if not frames and bad >= FEWEST_BAD_LINES:
        return (
            f"{received} bytes came, and no CAN frame in them: this port is of another device (a modem, a GPS "
            "receiver), or its adapter has another line speed; edge-sr devices lists what is plugged in, and @BAUD "
            "after the port sets a speed"
        )
    if frames:
        came = "none of a taxel: another kind of pad (--id-map), or another bus"
        if arrived.get("readings", 0):
            came = "no whole scan: frames are lost, or this is another kind of pad (--id-map)"
        return f"{frames} CAN frames came, and {came}; {doctor}"
    return f"is the sensor powered and its cable in? {doctor}"
