"""Cycles of scans: none mixes two, whatever is lost, and a sensor's place is recovered; readings name their cycle."""

import random
import struct
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from wire_faults import FAULTS, STAMPS, Case, play
from wire_faults import READERS as LINE_READERS

from firmware_bridge.can import gs_usb
from firmware_bridge.can.slcan import encode_frame
from firmware_bridge.emulation.slcan_emulator import Controller, bus_timeline
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.frame_scans import GsUsbScans
from firmware_bridge.scans.slcan_scans import SlcanScans

LONGEST_WAIT_NS = 1_500_000
FIRST = 1000
IDS = [can_id for can_id, _ in USPA44_MAP.wire_order("4")]
ORDERS = {
    "downwards": list(range(15, -1, -1)),
    "rows backwards": [4 * (place // 4) + 3 - place % 4 for place in range(16)],
    "begun elsewhere": [*range(5, 16), *range(5)],
    "any": [9, 2, 14, 0, 7, 11, 4, 1, 15, 6, 3, 12, 8, 5, 13, 10],
}


class Reader(NamedTuple):
    """Way to read: gs_usb with a frame a transfer, or slcan from an adapter that hands on what it has so often."""

    stamped: bool
    latency_s: float = 0.001
    usb: bool = False


PLAIN, STAMPED, PLAIN_BURSTS = Reader(False), Reader(True), Reader(False, 0.016)
STAMPED_BURSTS, USB = Reader(True, 0.016), Reader(True, usb=True)
# Plain bursts of 16 ms end anywhere in a cycle, which looks like a pause of the bus until the period is known. Later,
# cycles that come late wait for others to show that none was lost. What holds for that reader as well is that nothing
# is mixed.
every_reader = pytest.mark.parametrize("reader", [PLAIN, STAMPED, PLAIN_BURSTS, STAMPED_BURSTS, USB], ids=str)


def numbered(cycles):
    """Return a recording in which every reading is the number of its cycle."""
    counts = np.broadcast_to(np.arange(FIRST, FIRST + cycles)[:, None, None, None], (cycles, 3, 4, 4)).astype(np.int32)
    return Recording(Path("numbered.csv"), (Track("4", counts, None),), 100.0)


def bus(cycles, rates_hz=(100.0,), first_frame=0):
    """Return times and frames of sensors "4", "6", ..., each at its rate."""
    controllers = [Controller(numbered(cycles).tracks[0], 4 + 2 * n, rate_hz) for n, rate_hz in enumerate(rates_hz)]
    return list(bus_timeline(controllers, jitter_s=0.001, seed=0, loop=False))[first_frame:]


def losing(frames, share):
    draw = random.Random(1)
    return [timed for timed in frames if draw.random() >= share]


def doubling(frames, share):
    draw = random.Random(0)
    return [one for one in frames for _ in range(1 + (draw.random() < share))]


def swapping(frames, share):
    draw, swapped = random.Random(0), list(frames)
    for at in range(len(frames) - 1):
        if draw.random() < share:
            (early_s, early), (late_s, late) = swapped[at : at + 2]
            swapped[at : at + 2] = [(early_s, late), (late_s, early)]
    return swapped


def handed_on(frames, reader):
    """Yield when something is read, in [s], and what."""
    if reader.usb:
        for time_s, frame in frames:
            head = struct.pack("<IIBBBB", gs_usb.RECEIVED, frame.can_id, 8, 0, 0, 0)
            yield time_s + 0.0002, head + frame.data + struct.pack("<I", round(time_s * 1e6))
        return
    for tick, lot in groupby(frames, key=lambda timed: int(timed[0] / reader.latency_s)):
        lines = [
            encode_frame(frame._replace(timestamp_ms=int(time_s * 1000) % 60_000 if reader.stamped else None))
            for time_s, frame in lot
        ]
        yield (tick + 1) * reader.latency_s, b"".join(lines)


def read(frames, reader, broken_s=0.0):
    """Return the cycles of whole scans by sensor, how many were mixed, how long each had to wait, and counters.

    The link breaks before `broken_s` [s], and is opened again.
    """
    scans = GsUsbScans() if reader.usb else SlcanScans()
    if reader.usb:
        scans.start(stamped=True)
    found = SimpleNamespace(numbers={}, whole=0, mixed=0, waits_ns=[])
    for time_s, data in handed_on(frames, reader):
        now_ns = 5_000_000_000 + round(time_s * 1e9)
        if 0 < broken_s < time_s:
            scans.begin_anew()
            broken_s = 0.0
        for scan in filter(lambda scan: scan.whole, scans.feed(data, now_ns)):
            cycles = set(scan.counts[2].ravel().tolist())
            found.numbers.setdefault(scan.sensor, []).append(max(cycles))
            found.waits_ns.append(now_ns - scan.time_ns)
            found.whole, found.mixed = found.whole + 1, found.mixed + (len(cycles) > 1)
    found.counters = scans.counters()
    return found


@every_reader
@pytest.mark.parametrize("first_frame", range(16))
def test_who_joins_anywhere_has_the_next_cycle(reader, first_frame):
    found = read(bus(12, first_frame=first_frame), reader)
    assert found.mixed == 0 and found.numbers["4"][0] == FIRST + (first_frame > 0)
    if reader is not PLAIN_BURSTS:
        assert found.counters["resynchronised"] == (16 - first_frame) % 16
        assert found.whole == 12 - (first_frame > 0)


@every_reader
@pytest.mark.parametrize(
    ("fault", "share", "rates_hz", "fewest", "in_bursts"),
    [
        (losing, 0.0005, (100,), 395, 380),
        (losing, 0.05, (100,), 170, 165),
        (losing, 0.002, (100, 103), 760, 730),  # phases that drift
        (doubling, 0.02, (100,), 399, 385),
        (swapping, 0.02, (100,), 370, 360),
    ],
)
def test_no_scan_is_of_two_cycles_on_a_faulty_bus(reader, fault, share, rates_hz, fewest, in_bursts):
    found = read(fault(bus(400, rates_hz), share), reader)
    assert found.mixed == 0 and len(found.numbers) == len(rates_hz)
    assert found.whole > (in_bursts if reader is PLAIN_BURSTS else fewest)
    assert max(found.waits_ns) < LONGEST_WAIT_NS or reader is PLAIN_BURSTS


@pytest.mark.parametrize("reader", [PLAIN, STAMPED, STAMPED_BURSTS, USB], ids=str)
@pytest.mark.parametrize("group", [1, 2, 4, 8])
def test_a_sensor_that_sends_its_taxels_in_groups_is_read_whole(reader, group):
    frames = [
        (cycle * 0.01 + place // group * 0.009 * group / 16 + place % group * 0.00013, frame)
        for cycle in range(30)
        for place, (_, frame) in enumerate(bus(30)[16 * cycle : 16 * cycle + 16])
    ]
    found = read(frames, reader)
    assert found.mixed == 0 and found.whole >= 29  # the pauses within it are learnt from the first cycle


@pytest.mark.parametrize("again", [False, True], ids=["opened", "opened again"])
@pytest.mark.parametrize("reader", [STAMPED, STAMPED_BURSTS, USB], ids=str)
@pytest.mark.parametrize("lost", [0, 1, 3, 5])
def test_a_link_whose_first_cycles_are_lost_mixes_none_later(lost, reader, again):
    before, frames = 16 * 20 * again, bus(40)
    del frames[before + 16 * 2 : before + 16 * (2 + lost)]
    del frames[before + 16 * 3 + 8 : before + 16 * 4 + 8]  # as many as make the halves of two cycles fit
    found = read(frames, reader, broken_s=0.199 * again)
    assert found.mixed == 0 and found.counters["torn_wire"] == 2
    assert found.whole >= 40 - lost - 2 - 2 * again


@pytest.mark.parametrize("reader", [PLAIN, STAMPED, USB], ids=str)
@pytest.mark.parametrize(("order", "first_frame"), list(zip(ORDERS, (0, 7, 0, 7), strict=True)))
def test_another_order_is_learnt_and_nothing_mixed_meanwhile(reader, order, first_frame):
    ids = {IDS[place]: IDS[other] for place, other in enumerate(ORDERS[order])}
    usual = bus(300, first_frame=first_frame)
    frames = [(time_s, frame._replace(can_id=ids[frame.can_id])) for time_s, frame in usual]
    found = read(losing(frames, 0.005), reader)
    # Without stamps a pause counts only once the period is measured: until then the order of the ids is all there is.
    assert found.mixed <= (2 if reader is PLAIN and order == "begun elsewhere" else 0) and found.whole > 250
    assert found.numbers["4"][0] < FIRST + 12 and found.numbers["4"][-1] == FIRST + 299


SLOW_OR_FAST = [name for name in STAMPS if "%" in name]
NO_CLOCK = [name for name in STAMPS if name not in ("good", *SLOW_OR_FAST)]
OF_EACH_SORT = (None, "good", "jitter of 10 ms", "standing still", "1 % slow")
BY_DAY = [name if name in OF_EACH_SORT else pytest.param(name, marks=pytest.mark.night) for name in (None, *STAMPS)]


@pytest.mark.parametrize("reader", LINE_READERS)
@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", BY_DAY, ids=str)
def test_no_scan_of_a_faulty_wire_is_of_two_cycles(stamps, lost, reader):
    found = play(Case(stamps, lost, reader), 400)
    assert found.mixed == 0 and found.scans == found.whole + found.torn
    assert found.whole > (350 if lost == "nothing" else 250)
    assert found.late <= 1 and found.lag_ms < 60
    if lost == "nothing" and reader != "each 16 ms" and stamps in (None, "good", *SLOW_OR_FAST):
        assert found.missed == 0 and found.torn == 0


@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, "good"], ids=str)
@pytest.mark.parametrize(("sensors", "rate_hz"), [(2, 100), (4, 100), (1, 10), (1, 400)])
def test_nor_is_one_of_several_sensors_or_of_another_rate(sensors, rate_hz, stamps, lost):
    found = play(Case(stamps, lost, "each ms", sensors, rate_hz), 400 // sensors)
    assert found.mixed == 0 and found.whole > 250
    assert lost != "nothing" or found.missed == found.torn == 0


@pytest.mark.parametrize("stamps", [*SLOW_OR_FAST, *NO_CLOCK])
def test_a_clock_is_followed_or_dropped(stamps):
    found = play(Case(stamps, "nothing"), 600)
    assert found.late <= 1 and found.missed <= 20
    assert found.lag_ms < 5 or stamps not in SLOW_OR_FAST
