"""Sinks and consumers that fail in a run among faults, and whether what they leave is whole."""

import os
import resource
import time
from pathlib import Path
from typing import Final

import orjson
from fault_records import Ran

from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.formats import load_recording

SLOW_AFTER_S: Final = 3.0
SLOW_FOR_S: Final = 4.0
GONE_AFTER_S: Final = 6.0
ROOM_BYTES: Final = 6_000_000
"""Size of the file system that fills: a few hundred records."""
_PERIOD_S: Final = 20.0


def failing_sinks(folder: Path) -> list[str]:
    """A pipe that is read slowly, one whose reader goes, a device and a disk that are full; in --sink's words."""
    sinks: list[str] = []
    for name in ("slow", "gone"):
        os.mkfifo(folder / f"{name}.fifo")
        sinks.append(f"jsonl:{folder / name}.fifo")
    return [*sinks, "jsonl:/dev/full", f"jsonl:{folder / 'full.jsonl'}", f"mcap:{folder / 'full.mcap'}"]


def fill_up() -> None:
    """Let this process write no file beyond ROOM_BYTES."""
    # A file that may not grow further is the full disk that needs no rights; pipes and terminals know no such limit.
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM_BYTES, ROOM_BYTES))


def read_slowly(path: Path, ran: Ran) -> None:
    """Read for a while, then not, and so on."""
    with path.open("rb") as stream:
        turn_s = time.monotonic()
        for line in stream:
            try:
                ran.unwritten = orjson.loads(line).get("counters", {"unwritten": ran.unwritten})["unwritten"]
            except orjson.JSONDecodeError:
                ran.broken.append(f"slow.fifo: record {ran.slow + 1} is not whole")
            ran.slow += 1
            if time.monotonic() - turn_s > SLOW_AFTER_S:
                time.sleep(SLOW_FOR_S)
                turn_s = time.monotonic() + _PERIOD_S


def read_and_go(path: Path) -> None:
    """Read for a while and close."""
    with path.open("rb") as stream:
        end_s = time.monotonic() + GONE_AFTER_S
        while time.monotonic() < end_s and stream.readline():
            pass


def look_into_files(folder: Path, ran: Ran) -> None:
    """Read what failing sinks left: whole records, the last of them perhaps cut off."""
    lines = (folder / "full.jsonl").read_bytes().split(b"\n")
    numbers: dict[str, int] = {}
    for at, line in enumerate(lines[:-1]):
        try:
            head = orjson.loads(line)
        except orjson.JSONDecodeError:
            ran.broken.append(f"full.jsonl: line {at + 1} of {len(lines)} is no record")
            continue
        if head["state"] != "event":
            if head["scan"] != numbers.get(head["sensor"], -1) + 1:
                ran.broken.append(f"full.jsonl: scan {head['scan']} of sensor {head['sensor']} in line {at + 1}")
            numbers[head["sensor"]] = head["scan"]
    try:
        for track in load_recording(folder / "full.mcap").tracks:
            mine = [] if track.numbers is None else track.numbers.tolist()
            if mine != list(range(len(mine))):
                ran.broken.append(f"full.mcap: {len(mine)} scans are of sensor {track.sensor}, not all in order")
    except RecordingError as error:
        ran.broken.append(f"full.mcap: {error}")
