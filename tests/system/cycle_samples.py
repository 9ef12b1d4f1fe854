"""Streams of which every reading names its cycle, readers of them, and the evaluation of their scans."""

import random
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from firmware_bridge.can import gs_usb
from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.xela_controller import FRAME_S, Controller, bus_timeline
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.gs_usb_scans import GsUsbScans
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.slcan_scans import SlcanScans

LINE_BYTES: Final = 4095
"""Bytes that a pseudo-terminal holds for a reader that does not read."""
ADAPTER_S: Final = 0.001
FTDI_S: Final = 0.016
_HOST_FRAME: Final = struct.Struct("<IIBBBB8sI")

Timed = tuple[float, CanFrame]
Fault = Callable[[list[Timed]], list[Timed]]


class Reader(NamedTuple):
    """Way in which a stream is read.

    Attributes:
        name: name of the way.
        stamped: the adapter stamps frames.
        usb: gs_usb, a frame a transfer; else slcan.
        latency_s: the adapter hands on what it has once in this time, in [s].
    """

    name: str
    stamped: bool
    usb: bool = False
    latency_s: float = ADAPTER_S


READERS: Final = (
    Reader("slcan, plain", stamped=False),
    Reader("slcan, stamped", stamped=True),
    Reader("slcan, plain, 16 ms bursts", stamped=False, latency_s=FTDI_S),
    Reader("slcan, stamped, 16 ms bursts", stamped=True, latency_s=FTDI_S),
    Reader("gs_usb, stamped", stamped=True, usb=True),
)
PLAIN, STAMPED, PLAIN_BURSTS, STAMPED_BURSTS, USB = READERS


def numbered(cycles: int, first: int = 0) -> Recording:
    """Return a recording in which every reading is the number of its cycle."""
    counts = np.broadcast_to(np.arange(first, first + cycles)[:, None, None, None], (cycles, 3, 4, 4)).astype(np.int32)
    return Recording(Path("numbered.csv"), (Track("4", counts, None),), 100.0)


def bus(
    cycles: int,
    rates_hz: Sequence[float] = (100.0,),
    *,
    seed: int = 0,
    jitter_s: float = 0.001,
    frame_s: float = FRAME_S,
    first_frame: int = 0,
) -> list[Timed]:
    """Return the stream of sensors "4", "6", ..., each at its rate."""
    track = numbered(cycles, first=1000).tracks[0]
    controllers = [Controller(track, 4 + 2 * n, rate_hz) for n, rate_hz in enumerate(rates_hz)]
    timeline = bus_timeline(
        controllers, jitter_s=jitter_s, seed=seed, loop=False, frame_s=frame_s, first_frame=first_frame
    )
    return list(timeline)


def in_order(frames: Iterable[Timed], order: Sequence[int], model: ModelMap = USPA44_MAP) -> list[Timed]:
    """Return the stream of a sensor that sends its taxels in another order: `order` are places of the usual one."""
    ids = [can_id for can_id, _ in model.wire_order("4")]
    renamed = {ids[place]: ids[other] for place, other in enumerate(order)}
    return [(time_s, frame._replace(can_id=renamed[frame.can_id])) for time_s, frame in frames]


def losing(share: float, seed: int = 0) -> Fault:
    """Lose each frame with this probability."""
    draw = random.Random(seed)
    return lambda frames: [timed for timed in frames if draw.random() >= share]


def pausing(pause_s: float, every_s: float, seed: int = 0) -> Fault:
    """Switch the bus off for so long again and again; what is sent meanwhile is lost."""
    draw = random.Random(seed)

    def fault(frames: list[Timed]) -> list[Timed]:
        starts = _moments(frames, every_s, draw)
        return [one for one in frames if not any(start <= one[0] < start + pause_s for start in starts)]

    return fault


def _moments(frames: list[Timed], every_s: float, draw: random.Random) -> list[float]:
    last_s = frames[-1][0]
    return [every_s * (n + draw.uniform(0.2, 0.8)) for n in range(1, int(last_s / every_s))]


def doubling(share: float, seed: int = 0) -> Fault:
    """Repeat frames."""
    draw = random.Random(seed)
    return lambda frames: [one for one in frames for _ in range(1 + (draw.random() < share))]


def swapping(share: float, seed: int = 0) -> Fault:
    """Swap frames with the next one."""
    draw = random.Random(seed)

    def fault(frames: list[Timed]) -> list[Timed]:
        swapped = list(frames)
        at = 0
        while at + 1 < len(swapped):
            if draw.random() < share:
                (early_s, early), (late_s, late) = swapped[at : at + 2]
                swapped[at : at + 2] = [(early_s, late), (late_s, early)]
                at += 1
            at += 1
        return swapped

    return fault


def _handed_on(frames: Iterable[Timed], reader: Reader) -> Iterator[tuple[float, list[Timed]]]:
    if reader.usb:
        yield from ((time_s + 0.0002, [(time_s, frame)]) for time_s, frame in frames)
        return
    ticks = groupby(frames, key=lambda timed: int(timed[0] / reader.latency_s))
    yield from (((tick + 1) * reader.latency_s, list(lot)) for tick, lot in ticks)


def _stalled(
    lots: Iterable[tuple[float, list[Timed]]], stalls: Sequence[tuple[float, float]], reader: Reader
) -> Iterator[tuple[float, list[Timed]]]:
    """Stop reading in the stalls; what waits is lost beyond the room that there is."""
    room = 64 if reader.usb else LINE_BYTES // (26 if reader.stamped else 22)
    waiting: list[list[Timed]] = []
    until_s = 0.0
    for time_s, lot in lots:
        if waiting and time_s >= until_s:
            yield from ((until_s, old) for old in waiting)
            waiting = []
        stall = next(((start, long) for start, long in stalls if start <= time_s < start + long), None)
        if stall is None:
            yield time_s, lot
            continue
        until_s = sum(stall)
        left = room - sum(map(len, waiting))
        waiting.append(lot[: max(left, 0)])


@dataclass
class Worth:
    """Scans of a stream, evaluated against the cycles that were sent.

    Attributes:
        scans: number of scans.
        whole: scans with sixteen new readings.
        mixed: whole scans of more than one cycle.
        waits_ms: times from the last frame of a cycle, as it was read, to its scan.
        counters: counters of the reader.
        numbers: cycles of whole scans, by sensor.
    """

    scans: int = 0
    whole: int = 0
    mixed: int = 0
    waits_ms: list[float] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)
    numbers: dict[str, list[int]] = field(default_factory=dict)


def read(
    frames: list[Timed],
    reader: Reader,
    *,
    stalls: Sequence[tuple[float, float]] = (),
    model: ModelMap = USPA44_MAP,
) -> Worth:
    """Read a stream."""
    worth = Worth()
    scans: SlcanScans | GsUsbScans
    if reader.usb:
        scans = GsUsbScans(model)
        scans.start(stamped=reader.stamped, channels=1)
    else:
        scans = SlcanScans(model)
    read_ns: dict[tuple[str, int], int] = {}
    start_ns = 5_000_000_000
    for time_s, lot in _stalled(_handed_on(frames, reader), stalls, reader):
        now_ns = start_ns + round(time_s * 1e9)
        for _, frame in lot:
            read_ns[model.taxels[frame.can_id][0], int.from_bytes(frame.data[1:3], "big")] = now_ns
        if reader.usb:
            given = [scan for timed in lot for scan in scans.feed(_host_frame(*timed), now_ns)]
        else:
            given = scans.feed(b"".join(_line(*timed, reader) for timed in lot), now_ns)
        for scan in given:
            _judge(scan, now_ns, read_ns, worth)
    worth.counters = scans.counters()
    return worth


def _judge(scan: Scan, now_ns: int, read_ns: dict[tuple[str, int], int], worth: Worth) -> None:
    numbers = np.unique(scan.counts[2][scan.fresh])
    worth.scans += 1
    worth.whole += scan.whole
    worth.mixed += scan.whole and len(numbers) > 1
    if scan.whole:
        worth.numbers.setdefault(scan.sensor, []).append(int(numbers[-1]))
        worth.waits_ms.append((now_ns - read_ns[scan.sensor, int(numbers[-1])]) / 1e6)


def _line(time_s: float, frame: CanFrame, reader: Reader) -> bytes:
    return encode_frame(frame._replace(timestamp_ms=int(time_s * 1000) % 60_000) if reader.stamped else frame)


def _host_frame(time_s: float, frame: CanFrame) -> bytes:
    stamp_us = round(time_s * 1e6) & 0xFFFFFFFF
    return _HOST_FRAME.pack(gs_usb.RECEIVED, frame.can_id, 8, 0, 0, 0, frame.data, stamp_us)
