"""slcan text to scans in one go: cycles read late, mixed or in pieces of any length, and the CAN ids that came."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.scan_assembler import ScanAssembler
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
def test_mixed_cycles_give_the_scans_of_their_frames(longest_ms, faults):
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


def test_a_cycle_read_in_one_piece_with_a_pause_in_it_is_two():
    """As after the host stood still: the bus was off between half of one press and half of another."""
    scans, places = SlcanScans(), USPA44_MAP.wire_order("4")

    def lines(stamps_ms):
        return b"".join(
            encode_frame(CanFrame(can_id, bytes([stamp % 251] * 8), timestamp_ms=stamp))
            for (can_id, _), stamp in zip(places, stamps_ms, strict=True)
        )

    whole = [*range(100, 116), *range(110, 126)]
    assert [scan.complete for scan in scans.feed(lines(whole[:16]) + lines(whole[16:]), 0)] == [True, True]
    broken = lines([*range(59_990, 59_999), *(n % 60_000 for n in range(60_340, 60_347))])
    assert [int(scan.fresh.sum()) for scan in scans.feed(broken, 10**9)] == [9]


def test_every_standard_id_that_came_is_known_whoever_it_is_of():
    """Whole cycles, half ones, other devices, remote and short frames; extended ids are too many to be kept."""
    whole = [CanFrame(can_id, bytes(range(8))) for can_id, _ in USPA44_MAP.wire_order("4")]
    half = [CanFrame(can_id, bytes(range(8))) for can_id, _ in USPA44_MAP.wire_order("6")][:8]
    others = [CanFrame(0x7F0, bytes(8)), CanFrame(0x123, b"ab"), CanFrame(0x456, b"", remote=True)]
    frames = [*whole, *whole, *others, CanFrame(0x12345, bytes(8), extended=True), *half]
    expected = {frame.can_id for frame in (*whole, *others, *half)}
    text, by_frame = SlcanScans(), ScanAssembler()
    text.feed(b"".join(map(encode_frame, frames)), 1)
    for frame in frames:
        by_frame.feed_frame(frame, 1)
    assert text.can_ids == by_frame.can_ids == expected
    assert text.counters()["foreign"] == by_frame.counters()["foreign"] == len(others) + 1
    for known in ([frames[:0], half], [half[:3], *[whole] * 5], [whole[10:], *[whole] * 5]):
        alone = SlcanScans()
        for number, piece in enumerate(known):
            alone.feed(b"".join(map(encode_frame, piece)), 10_000_000 * number)
        assert alone.can_ids == {frame.can_id for piece in known for frame in piece}


def test_the_head_of_a_line_with_a_later_tail_is_no_reading():
    """It came before the time of its stamp; one whose tail was only read late did not."""
    places, ms = USPA44_MAP.wire_order("4"), 1_000_000

    def text(cycle):
        frames = [CanFrame(can_id, bytes([cycle] * 8), timestamp_ms=10 * cycle) for can_id, _ in places]
        return b"".join(map(encode_frame, frames))

    for lost, complete in ((False, True), (True, False)):
        scans = SlcanScans()
        for cycle in range(3):
            scans.feed(text(cycle), (10 * cycle + 1) * ms)
        scans.feed(text(3)[:23], 31 * ms)
        (scan,) = scans.feed(text(7 if lost else 3)[23:], 71 * ms)
        assert scan.complete == complete and scans.counters()["foreign"] == lost
    scans.feed(text(8)[:20], 81 * ms)
    (scan,) = scans.feed(text(12)[24:] + text(13), 131 * ms)[-1:]
    assert scan.complete and scans.counters()["foreign"] == 1, "a damaged line is none, and the next is whole"


def text_of(numbers: range) -> bytes:
    lines = []
    for number in numbers:
        for can_id, taxel in USPA44_MAP.wire_order("4"):
            words = b"".join(value.to_bytes(2, "big") for value in (taxel, number, 1000 * taxel + number))
            lines.append(encode_frame(CanFrame(can_id, b"\x93" + words + b"\x0f")))
    return b"".join(lines)


@given(st.integers(0, 2**32))
@settings(deadline=None, max_examples=60)
def test_any_chunking_gives_the_same_scans_and_counters(seed):
    noise = random.Random(seed)
    stream = bytearray(text_of(range(6)))
    for _ in range(noise.randrange(30)):
        place = noise.randrange(len(stream))
        match noise.randrange(4):
            case 0:
                del stream[place : place + noise.randrange(60)]
            case 1:
                stream[place:place] = noise.randbytes(noise.randrange(60))
            case 2:
                stream[place] = noise.randrange(256)
            case 3:
                stream[place:place] = stream[place : place + noise.randrange(60)]
    whole = SlcanScans()
    expected = whole.feed(bytes(stream), 0)
    cuts = sorted(noise.randrange(len(stream) + 1) for _ in range(noise.randrange(40)))
    chunked = SlcanScans()
    got = [
        scan
        for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)
        for scan in chunked.feed(bytes(stream[a:b]), 0)
    ]
    assert chunked.counters() == whole.counters()
    assert [scan.number for scan in got] == [scan.number for scan in expected]
    for one, other in zip(got, expected, strict=True):
        assert (one.counts == other.counts).all() and (one.renewed == other.renewed).all()
