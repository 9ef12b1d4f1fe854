"""Frames of sensors on a faulty wire, the ways to read them, and what became of their scans. Pure.

Every reading tells its sensor, taxel and cycle, so that a scan of two cycles is seen at once. A line of the head of one
frame and the tail of another is a reading of neither, as the wire has no checksum.
"""

import math
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final

from firmware_bridge.can import gs_usb
from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import FRAME_S
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.frame_scans import GsUsbScans
from firmware_bridge.scans.slcan_scans import SlcanScans

START_S: Final = 100.0
WRAP_MS: Final = 60_000
STAMPS: Final[dict[str, Callable[[float, random.Random], float]]] = {
    "good": lambda ms, _: ms,
    "jitter of 4 ms": lambda ms, draw: ms + draw.uniform(0, 4),
    "jitter of 10 ms": lambda ms, draw: ms + draw.uniform(0, 10),
    "jitter of 40 ms": lambda ms, draw: ms + draw.uniform(0, 40),
    "standing still": lambda _, __: 4711,
    "1 % slow": lambda ms, _: ms * 0.99,
    "1 % fast": lambda ms, _: ms * 1.01,
    "0.1 % slow": lambda ms, _: ms * 0.999,
    "in us": lambda ms, _: ms * 1000,
    "in 0.1 ms": lambda ms, _: ms * 10,
    "in 10 ms": lambda ms, _: ms / 10,
    "in steps of 16 ms": lambda ms, _: ms // 16 * 16,
    "random": lambda _, draw: draw.randrange(WRAP_MS),
}
READERS: Final = ("each ms", "whole scans", "each 16 ms", "usb")
"""Of slcan lines; `usb`: of a gs_usb adapter with time stamps, a frame a transfer."""

Timed = tuple[float, CanFrame]
Owner = tuple[int, int]
"""Sensor and cycle of a reading."""


def _check(cycle: int, sensor: int, taxel: int) -> int:
    mixed = cycle * 40_503 + taxel * 9_973 + sensor * 61
    return (mixed ^ mixed >> 7) & 0xFFFF


def bus(cycles: int, rates_hz: Sequence[float] = (100.0,), order: Sequence[int] = range(16)) -> list[Timed]:
    """Return frames and their times, in [s], of sensors 4, 6, ..., each at its rate, its places in an order."""
    draw, frames = random.Random(0), list[Timed]()
    for lane, rate_hz in enumerate(rates_hz):
        sensor = 4 + 2 * lane
        ids = USPA44_MAP.wire_order(str(sensor))
        for cycle in range(cycles):
            begin_s = START_S + (cycle + draw.uniform(0, 0.05)) / rate_hz
            for place in range(16):
                can_id, taxel = ids[order[place]]
                check = _check(cycle, sensor, taxel)
                data = struct.pack(">B3HB", 0x93, cycle, check, check ^ 0x5A5A, 0x0F)
                frames.append((begin_s + (place * len(rates_hz) + lane + 1) * FRAME_S, CanFrame(can_id, data)))
    return sorted(frames, key=itemgetter(0))


def _owner(frame: CanFrame) -> Owner:
    return frame.can_id & 0xF, int.from_bytes(frame.data[1:3], "big")


# Faults.


def losing(frames: Sequence[Timed], share: float) -> list[Timed]:
    """Lose a share of the frames."""
    draw = random.Random(1)
    return [timed for timed in frames if draw.random() >= share]


def doubling(frames: Sequence[Timed], share: float) -> list[Timed]:
    """Give a share of the frames twice."""
    draw = random.Random(0)
    return [one for one in frames for _ in range(1 + (draw.random() < share))]


def swapping(frames: Sequence[Timed], share: float) -> list[Timed]:
    """Let frames change places."""
    draw, swapped = random.Random(0), list(frames)
    for at in range(len(frames) - 1):
        if draw.random() < share:
            (early_s, early), (late_s, late) = swapped[at : at + 2]
            swapped[at : at + 2] = [(early_s, late), (late_s, early)]
    return swapped


def losing_cycles(frames: Sequence[Timed], sensors: int, draw: random.Random) -> list[Timed]:
    """Lose as many frames in a row as make the parts of two cycles fit, after fifty cycles."""
    left, kept = 0, list[Timed]()
    for number, timed in enumerate(frames):
        if number >= 800 * sensors and not left and draw.random() < 1 / 800:
            left = draw.choice((16, 32, 48)) * draw.choice((1, sensors))
        if left:
            left -= 1
        else:
            kept.append(timed)
    return kept


def losing_bytes(lines: Sequence[tuple[float, bytes]], sensors: int, draw: random.Random) -> list[tuple[float, bytes]]:
    """Lose up to 60 ms of bytes at a time, within lines too, as of a full terminal, after fifty cycles."""
    until_s, cut, kept = 0.0, False, list[tuple[float, bytes]]()
    for number, (time_s, line) in enumerate(lines):
        text = line
        if time_s <= until_s:
            text = b""
        elif cut:
            cut, text = False, line[draw.randrange(len(line) + 1) :]
        elif number >= 800 * sensors and draw.random() < 1 / 800:
            until_s, cut = time_s + draw.uniform(0, 0.06), True
            text = line[: draw.randrange(len(line) + 1)]
        kept.append((time_s, text))
    return kept


# Reading.


@dataclass
class Found:
    """What became of the scans."""

    numbers: dict[str, list[int]] = field(default_factory=dict)  # cycles of the whole scans, by sensor
    torn: int = 0  # scans without all sixteen readings
    mixed: int = 0  # whole ones with readings of two cycles
    missed: int = 0  # cycles of which every byte was handed on, and no whole scan was returned
    late: int = 0  # scans whose reading is called old, though it was on the bus less than 50 ms before
    lag_ms: float = 0.0  # longest time from bus to `device_ns`, beyond which none of them may be
    wait_ns: int = 0  # longest time from the arrival of a scan's newest reading until it was returned
    counters: dict[str, int] = field(default_factory=dict)  # those of the link

    @property
    def whole(self) -> int:
        """Number of whole scans."""
        return sum(map(len, self.numbers.values()))


def read(
    frames: Sequence[Timed], stamps: str | None, reader: str, *, bytes_lost: int = 0, broken_s: float = math.inf
) -> Found:
    """Read frames with these time stamps of an slcan adapter; `bytes_lost` of so many sensors.

    The link breaks at `broken_s` [s], and is opened again.
    """
    draw, found, ends_s = random.Random(f"{stamps} {reader}"), Found(), dict[Owner, float]()
    lines = list(_lines(frames, stamps, draw))
    kept = losing_bytes(lines, bytes_lost, draw) if bytes_lost else lines
    handed = Counter[Owner]()
    for (time_s, frame), (_, line), (_, text) in zip(frames, lines, kept, strict=True):
        ends_s[_owner(frame)] = time_s
        handed[_owner(frame)] += text == line
    if reader == "usb":
        scans = GsUsbScans()
        scans.start(stamped=True)
        pieces = _transfers(frames)
    else:
        scans = SlcanScans()
        pieces = _pieces(scans, reader, kept, draw)
    for now_s, data in pieces:
        if now_s > broken_s:
            scans.begin_anew()
            broken_s = math.inf
        now_ns = round(now_s * 1e9)
        for scan in scans.feed(data, now_ns):
            sensor = int(scan.sensor)
            cycles = {
                x
                for taxel, (x, y, z) in enumerate(scan.counts.reshape(3, 16).T.tolist())
                if scan.fresh.flat[taxel] and y == z ^ 0x5A5A == _check(x, sensor, taxel)  # else never sent
            }
            if not scan.complete:
                found.torn += 1
                continue
            newest = max(cycles)
            found.numbers.setdefault(scan.sensor, []).append(newest)
            found.mixed += len(cycles) > 1
            found.wait_ns = max(found.wait_ns, now_ns - scan.time_ns)
            if scan.device_ns is not None:
                bus_s = ends_s[sensor, newest]
                found.late += scan.time_ns - scan.device_ns > 50_000_000 and now_s - bus_s < 0.05
                found.lag_ms = max(found.lag_ms, (bus_s - scan.device_ns / 1e9) * 1e3)
    whole = {(int(sensor), cycle) for sensor, cycles in found.numbers.items() for cycle in cycles}
    found.missed = len({owner for owner, lines in handed.items() if lines == 16} - whole)
    found.counters = scans.counters()
    return found


def _lines(frames: Iterable[Timed], stamps: str | None, draw: random.Random) -> Iterator[tuple[float, bytes]]:
    for time_s, frame in frames:
        stamp_ms = None if stamps is None else int(STAMPS[stamps](time_s * 1e3, draw)) % WRAP_MS
        yield time_s, encode_frame(frame._replace(timestamp_ms=stamp_ms))


def _transfers(frames: Iterable[Timed]) -> Iterator[tuple[float, bytes]]:
    for time_s, frame in frames:
        head = struct.pack("<IIBBBB", gs_usb.RECEIVED, frame.can_id, 8, 0, 0, 0)
        yield time_s + 0.0002, head + frame.data + struct.pack("<I", round(time_s * 1e6))


def _pieces(
    scans: SlcanScans, reader: str, lines: Iterable[tuple[float, bytes]], draw: random.Random
) -> Iterator[tuple[float, bytes]]:
    step_s = 0.016 if reader == "each 16 ms" else 0.001
    due_s, since_s, waiting = START_S, 0.0, b""
    for time_s, line in lines:
        if reader == "whole scans":  # as a reader does that sleeps until the last byte of a scan
            if waiting and time_s - since_s > 0.02:
                yield since_s + 0.02, waiting
                waiting = b""
            since_s = since_s if waiting else time_s
            waiting += line
            if len(waiting) >= scans.bytes_until_scan():
                yield time_s + draw.uniform(0.0001, 0.0008), waiting
                waiting = b""
            continue
        if time_s > due_s:
            if waiting:
                yield due_s, waiting
            due_s, waiting = due_s + step_s * (1 + int((time_s - due_s) / step_s)), b""
        waiting += line
    if waiting:
        yield due_s + step_s, waiting
