"""slcan text to scans in one go: cycles that mix, in pieces of any length, and the CAN ids that came."""

import random

from bridge_samples import cycle_lines
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_faults import START_S, bus

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans


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
    text = SlcanScans()
    text.feed(b"".join(map(encode_frame, frames)), 1)
    assert text.assembler.can_ids == expected and text.counters()["foreign"] == len(others) + 1
    for known in ([frames[:0], half], [half[:3], *[whole] * 5], [whole[10:], *[whole] * 5]):
        alone = SlcanScans()
        for number, piece in enumerate(known):
            alone.feed(b"".join(map(encode_frame, piece)), 10_000_000 * number)
        assert alone.assembler.can_ids == {frame.can_id for piece in known for frame in piece}


def test_the_head_of_a_line_with_a_later_tail_is_no_reading():
    """It came before the time of its stamp; one whose tail was only read late did not."""
    ms = 1_000_000

    def text(cycle):
        return b"".join(cycle_lines(cycle, 10 * cycle))

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


def text_of(sensors: int, *, stamped: bool) -> bytes:
    """Return the lines of eight cycles of sensors that mix, over a wrap of the stamps."""
    lines = []
    for time_s, frame in bus(8, (100.0,) * sensors):
        stamp_ms = int(59_950 + 1000 * (time_s - START_S)) % 60_000
        lines.append(encode_frame(frame._replace(timestamp_ms=stamp_ms if stamped else None)))
    return b"".join(lines)


OTHER_LINES = (b"\r", b"\a", b"z\r", b"V1013\r", b"F04\r", b"r1238\r", b"T000000010\r")


@given(st.integers(0, 2**32), st.sampled_from((1, 2, 4)), st.booleans(), st.integers(0, 30))
@settings(deadline=None, max_examples=120)
def test_any_chunking_gives_the_same_scans_and_counters(seed, sensors, stamped, faults):
    noise, stream = random.Random(seed), bytearray(text_of(sensors, stamped=stamped))
    for _ in range(faults):
        place = noise.randrange(len(stream))
        match noise.randrange(5):
            case 0:
                del stream[place : place + noise.randrange(60)]
            case 1:
                stream[place:place] = noise.randbytes(noise.randrange(60))
            case 2:
                stream[place] = noise.randrange(256)
            case 3:
                stream[place:place] = stream[place : place + noise.randrange(60)]
            case 4:
                stream[place:place] = noise.choice(OTHER_LINES)
    cuts = sorted(noise.randrange(len(stream) + 1) for _ in range(noise.randrange(40)))
    pieces = [bytes(stream[a:b]) for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    whole, chunked = SlcanScans(), SlcanScans()
    for scans in (whole, chunked):  # frames that come in time set the clock
        scans.feed(b"".join(cycle_lines(0, 59_900)) * stamped, -300_000_000)
    expected, got = whole.feed(bytes(stream), 0), [scan for piece in pieces for scan in chunked.feed(piece, 0)]
    for scans in (whole, chunked):
        assert scans.counters()["frames"] == scans.counters()["readings"] + scans.counters()["foreign"]
        scans.begin_anew()  # frames that wait for the end of their cycle close none when the link breaks
    counts = whole.counters()
    assert chunked.counters() == counts and counts["scans"] == len(expected) + stamped
    assert chunked.assembler.can_ids == whole.assembler.can_ids
    assert faults or len(expected) == 8 * sensors
    if stamped and not faults:
        newest_ms = int(59_950 + 1000 * (bus(8, (100.0,) * sensors)[-1][0] - START_S))
        assert expected[-1].device_ns == (newest_ms - 59_901 - 300) * 1_000_000
    for name in ("4", "6", "8", "10"):
        mine, theirs = ([scan for scan in some if scan.sensor == name] for some in (got, expected))
        for one, other in zip(mine, theirs, strict=True):
            assert one.number == other.number and (faults or one.device_ns == other.device_ns)
            assert (one.counts == other.counts).all() and (one.renewed == other.renewed).all()
