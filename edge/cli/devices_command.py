"""`edge-sr devices`: list what is plugged in, what to type to read it, and what prevents its use."""

import argparse
import json
from collections.abc import Sequence
from typing import TextIO

from edge.terminal.text_wrap import columns, wrapped
from firmware_bridge.errors import DeviceError
from firmware_bridge.links.discovery import Found, devices

NOTHING = (
    "no adapter found: check both plugs of a VScom (the second is the sensor's power), the lines of `dmesg` since "
    "it was plugged in, and that this user is in the group dialout"
)
SERVER_HINT = "The vendor's server, where one runs, is not searched for: --source xela-server:ws://HOST:5000"


def run(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Print the devices, opening none, as JSON for programs; raises DeviceError if no adapter is among them."""
    found, notes = devices()
    if options.json:
        out.write(json.dumps({"devices": [one._asdict() for one in found], "notes": notes}, indent=1) + "\n")
    else:
        out.write("".join(f"{line}\n" for line in page(found, notes, columns())))
    if not any(one.adapter for one in found):
        raise DeviceError(NOTHING)


def page(found: Sequence[Found], notes: Sequence[str], width: int) -> list[str]:
    """Return lines for a reader, adapters first; only text to be typed and longer words are wider than `width`."""
    lines: list[str] = []
    for one in sorted(found, key=lambda one: not one.adapter):
        serial = f"serial {one.serial_number}" if one.serial_number else None
        lines += wrapped("  ".join(word for word in (one.path, one.usb_id, serial) if word), width, indent="  ")
        lines += wrapped(f"{'looks like ' if one.adapter else ''}{one.looks_like}", width, "  ", "  ")
        lines.append(f"  --source {one.source}")
        for problem in one.problems:
            lines += wrapped(problem, width, "  ! ", "    ")
    for note in (*notes, SERVER_HINT):
        lines += wrapped(note, width)
    return lines
