"""Frames of several sensors that mix on a bus, read in pieces of any length."""

import random

import pytest

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans

ORDERS = {name: [can_id for can_id, _ in USPA44_MAP.wire_order(name)] for name in ("4", "6", "8", "10")}
FRAME_MS = 0.52


def on_the_bus(rng, cycles, *, stamped, faults):
    """Lines with the time of each in ms: four sensors whose cycles take most of the time, and one foreign frame."""
    sent = []
    for lane, order in enumerate(ORDERS.values()):
        for cycle in range(cycles):
            begun_ms = 10 * cycle + 2 * lane + rng.random()
            for place, can_id in enumerate(order):
                if rng.random() >= faults:
                    data = bytes([rng.randrange(256) for _ in range(8)])
                    sent += [(begun_ms + FRAME_MS * place, CanFrame(can_id, data))] * (1 + (rng.random() < faults))
    sent += [(10.0 * cycle + 3, CanFrame(0x7F0, bytes(8))) for cycle in range(0, cycles, 7)]
    sent.sort(key=lambda timed: timed[0])
    return [
        (time_ms, encode_frame(frame._replace(timestamp_ms=int(time_ms + 59_900) % 60_000) if stamped else frame))
        for time_ms, frame in sent
    ]


def fed(scans, lines, rng, longest_ms):
    """Feed the lines in reads of random length, which may end within a line; return the scans."""
    came, waiting, due_ms = [], b"", 0.0
    for time_ms, line in [*lines, (lines[-1][0] + 1000, b"")]:
        if time_ms >= due_ms:
            kept = rng.randrange(20) if line else 0
            data, waiting = waiting[: len(waiting) - kept], waiting[max(len(waiting) - kept, 0) :]
            came += scans.feed(data, int(due_ms * 1e6))
            due_ms = time_ms + rng.uniform(0, longest_ms)
        waiting += line
    return came


@pytest.mark.parametrize("faults", [0.0, 0.002, 0.05])
@pytest.mark.parametrize("longest_ms", [6.0, 60.0])
def test_mixed_cycles_give_the_scans_that_their_frames_give_one_by_one(longest_ms, faults):
    for seed in range(2):
        lines = on_the_bus(random.Random(seed), 60, stamped=True, faults=faults)
        mixed, one_by_one = SlcanScans(), SlcanScans()
        got = fed(mixed, lines, random.Random(seed), longest_ms)
        expected = [scan for ms, line in lines for scan in one_by_one.feed(line, int(ms * 1e6))]
        for name in ORDERS:
            mine, theirs = ([scan for scan in some if scan.sensor == name] for some in (got, expected))
            assert len(theirs) > 40
            for scan, other in zip(mine, theirs, strict=True):
                assert (scan.number, scan.counts.tolist()) == (other.number, other.counts.tolist())
                assert (scan.renewed == other.renewed).all()
        assert mixed.can_ids == one_by_one.can_ids
        counts = mixed.counters()
        assert counts == one_by_one.counters() and counts["frames"] == counts["readings"] + counts["foreign"]


def test_no_scan_closes_when_a_link_breaks():
    """Frames wait for the end of their cycle, with a pause among them; a break of the link closes no scan."""
    abandoned = 0
    for seed in range(12):
        rng = random.Random(seed)
        scans, got, text, late_ms = SlcanScans(), 0, b"", 0
        for time_ms, line in on_the_bus(rng, 30, stamped=False, faults=0.02):
            late_ms += rng.choice([5, 30, 200]) if rng.random() < 0.01 else 0
            stamp_ms = int(time_ms + late_ms)
            text += line[:-1] + b"%04X\r" % stamp_ms
            if rng.random() < 0.05:
                got, text = got + len(scans.feed(text, stamp_ms * 1_000_000)), b""
                if rng.random() < 0.2:
                    scans.begin_anew()
        counts = scans.counters()
        assert counts["scans"] == got > 0
        abandoned += counts["abandoned"]
        assert counts["frames"] == counts["readings"] + counts["foreign"]
    assert abandoned > 300


def test_without_stamps_nothing_waits_and_a_broken_link_leaves_nothing():
    scans = SlcanScans()
    for stamped in (False, True, False, True):
        lines = [line for _, line in on_the_bus(random.Random(2), 3, stamped=stamped, faults=0.0)]
        scans.feed(b"".join(lines[:150]), 0)
        counts = scans.counters()
        assert counts["frames"] == counts["readings"] + counts["foreign"]
        if stamped:
            assert scans.bytes_until_scan() < 16 * 26
        scans.begin_anew()
    counts = scans.counters()
    assert (
        counts["readings"]
        == 16 * counts["scans"] + counts["abandoned"] + counts["unconfirmed"] + (counts["resynchronised"])
    )
