"""Lines of slcan and their frames, whole and damaged."""

import pytest
from bridge_samples import decoded
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.slcan import LINES_TO_LEARN, LONGEST_LINE, CanFrame, SlcanDecoder, encode_frame

# Two frames as a sensor sent them.
GOLDEN = b"t0048937E317E1593120F\r"
GOLDEN_FRAME = CanFrame(0x004, bytes.fromhex("937E317E1593120F"))
OTHER = b"t1048938406805591BB0C\r"
OTHER_FRAME = CanFrame(0x104, bytes.fromhex("938406805591BB0C"))
STAMPED = [GOLDEN[:-1] + b"%04X\r" % stamp_ms for stamp_ms in (0, 1, 0x1234, 59_999)]


def decode(*chunks: bytes) -> tuple[list[CanFrame], dict[str, int]]:
    """Return the frames, and the counters that are not zero."""
    decoder = SlcanDecoder()
    frames = [frame for chunk in chunks for frame in decoded(decoder, chunk)]
    return frames, {name: count for name, count in decoder.counters().items() if count}


LINES = (GOLDEN * 5, OTHER, *STAMPED, b"".join(STAMPED), STAMPED[0] * 3, b"\r", b"\a", b"z\r", b"V1013\r", b"F04\r")
a_line, a_place = st.sampled_from(LINES), st.integers(0, 30)
pieces = a_line | st.builds(lambda line, start, end: line[start:end], a_line, a_place, a_place) | st.binary(max_size=40)


@given(st.lists(pieces, max_size=30).map(b"".join), st.integers(1, 50))
@settings(deadline=None, max_examples=300)
def test_any_chunking_gives_the_same(stream, size):
    whole = decode(stream)
    for step in (1, size):
        assert decode(*(stream[at : at + step] for at in range(0, len(stream), step))) == whole


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (GOLDEN, GOLDEN_FRAME),
        (OTHER, OTHER_FRAME),
        (b"t0048937e317e1593120f\r", GOLDEN_FRAME),
        (GOLDEN[:-1] + b"Ea5f\r", GOLDEN_FRAME._replace(timestamp_ms=59_999)),
        (GOLDEN[:-1] + b"FFFF\r", GOLDEN_FRAME._replace(timestamp_ms=65_535)),
        (GOLDEN[:-1] + b"0000\r", GOLDEN_FRAME._replace(timestamp_ms=0)),
        (b"T1FFFFFFF2ABCD\r", CanFrame(0x1FFFFFFF, b"\xab\xcd", extended=True)),
        (b"t7FF0\r", CanFrame(0x7FF, b"")),
        (b"r1238\r", CanFrame(0x123, b"", remote=True)),
        (b"R000001231\r", CanFrame(0x123, b"", extended=True, remote=True)),
    ],
)
def test_lines_of_frames(line, frame):
    for one in (line, encode_frame(frame)):
        assert decode(one) == ([frame], {"frames": 1})


@pytest.mark.parametrize(
    ("line", "counted"),
    [
        *[(reply, {"replies": 1}) for reply in (b"\r", b"z\r", b"Z\r", b"V1013\r", b"N12ab\r", b"Vrt12\r")],
        (b"F04\r", {"status_answers": 1}),
        (b"\a", {"refusals": 1}),
        (b"z\a", {"refusals": 1}),
        (GOLDEN[:-1] + b"\a", {"refusals": 1, "bad_lines": 1, "skipped_bytes": 21}),  # the adapter reports an error
    ],
)
def test_other_lines_are_counted(line, counted):
    assert decode(GOLDEN + line + OTHER) == ([GOLDEN_FRAME, OTHER_FRAME], {"frames": 2} | counted)
    decoder = SlcanDecoder()
    decoder.cut(line + b"F08\rF5a\r")
    assert (decoder.flags, decoder.status_answers) == (0x5A, 2 + (line[:1] == b"F"))


BAD = {
    "cut off": (b"t0048937E31", b"t", b"V10"),
    "too long": (b"t0048937E317E1593120F0", b"t0048937E317E1593120F00", b"t0048937E317E1593120F\n"),
    "nine bytes, and a length of seven": (b"t0049937E317E1593120F00", b"t0047937E317E1593120F"),
    "ids of twelve and of thirty bits": (b"t8008937E317E1593120F", b"T200000008937E317E1593120F"),
    "no digits": (b"t0048937E317E15931 0F", b"t0_48937E317E1593120F", b"t+048937E317E1593120F", b"F0G"),
    "a remote frame with data, flags of EasySYNC, nothing": (b"r0048937E317E1593120F", b"04", b"x"),
}


@pytest.mark.parametrize("lines", BAD.values(), ids=BAD)
def test_bad_lines(lines):
    for line in lines:
        counted = {"frames": 1, "bad_lines": 1, "skipped_bytes": len(line)}
        assert decode(line + b"\r" + GOLDEN) == ([GOLDEN_FRAME], counted), line


@pytest.mark.parametrize(
    ("usual", "other"), [([GOLDEN] * 4, STAMPED), (STAMPED, [GOLDEN] * 4)], ids=["plain", "stamped"]
)
def test_the_form_of_lines_is_learnt_from_four_in_a_row(usual, other):
    few = LINES_TO_LEARN - 1
    decoder = SlcanDecoder()
    assert decoder.usual_line_bytes == len(GOLDEN)
    decoder.cut(b"".join(usual))
    assert decoder.usual_line_bytes == len(usual[0])
    decoder.begin_anew()
    assert decoder.usual_line_bytes == len(GOLDEN), "an adapter that was opened again may send another form"
    # Before that both are taken, in any order.
    assert len(decode(b"".join((usual[:few] + other[:few]) * 3))[0]) == 6 * few
    # Then those of the other form are bad lines: damage, such as four lost digits.
    taught = b"".join(usual)
    got, counters = decode(taught + b"".join(other[:few] + usual[:1] + other[:few]))
    assert (len(got), counters["bad_lines"]) == (5, 2 * few)
    assert counters["skipped_bytes"] == sum(map(len, other[:few])) * 2 - 2 * few
    # Unless the adapter has changed its mind, and with it we ours.
    got, counters = decode(taught + b"".join([*other, other[0], usual[0]]))
    assert (len(got), counters["bad_lines"]) == (4 + 2, few + 1)


def test_every_byte_at_every_place_of_a_line():
    """One corrupted byte has no effect, loses the frame, or puts another digit in its place."""
    digits = b"0123456789ABCDEFabcdef"
    for place in range(len(GOLDEN)):
        for byte in range(256):  # of a stream that has taught no form yet
            line = bytearray(GOLDEN)
            line[place] = byte
            got, counters = decode(bytes(line) + OTHER)
            assert got[-1:] == [OTHER_FRAME], (place, byte)
            where_digits_are = 1 <= place < len(GOLDEN) - 1 and place != 4
            if line == GOLDEN or (place > 0 and line.upper() == GOLDEN.upper()):
                assert got[:-1] == [GOLDEN_FRAME] and counters == {"frames": 2}, (place, byte)
            elif where_digits_are and byte in (digits if place > 1 else b"01234567"):
                assert len(got) == 2 and counters == {"frames": 2}, (place, byte)
                assert bin(_bits(got[0]) ^ _bits(GOLDEN_FRAME)).count("1") <= 4, (place, byte)
            else:
                # A letter in mid-line may start a shorter frame, a length of 6 leaves four digits for a time
                # stamp; but eight bytes of data come of nothing, and every loss is counted.
                assert all(len(frame.data) < 8 or frame.extended for frame in got[:-1]), (place, byte)
                assert len(got) == 2 or {"bad_lines", "non_ascii_lines", "skipped_bytes"} & counters.keys()
            if byte >= 0x80:
                assert got == [OTHER_FRAME], (place, byte)


def _bits(frame: CanFrame) -> int:
    return frame.can_id << 64 | int.from_bytes(frame.data, "big")


@pytest.mark.parametrize(
    ("stream", "frames", "counted"),
    [
        (GOLDEN[:12] + OTHER, 1, {"skipped_bytes": 12}),
        (GOLDEN[:-1] + OTHER, 1, {"skipped_bytes": 21}),
        (OTHER + GOLDEN[:9] + b"\xb1" + GOLDEN[10:] + OTHER, 2, {"non_ascii_lines": 1, "skipped_bytes": 21}),
        (b"\xff\xfe" + OTHER, 1, {"skipped_bytes": 2}),
        (b"A" * 10_000 + OTHER, 1, {"skipped_bytes": 10_000}),
        (b"A" * 10_000 + b"\r" + OTHER, 1, {"bad_lines": 1, "skipped_bytes": 10_000}),
    ],
)
def test_damage_spoils_the_frame_it_falls_into_and_no_other(stream, frames, counted):
    assert decode(stream) == ([OTHER_FRAME] * frames, {"frames": frames} | counted)


def test_a_line_without_end_is_counted_while_it_goes_on():
    """A line at the wrong speed may never end."""
    decoder = SlcanDecoder()
    decoder.cut(b"A" * 10_000)
    assert decoder.counters()["skipped_bytes"] == 10_000 - LONGEST_LINE and decoder.pending_bytes == LONGEST_LINE
    decoder.begin_anew()
    assert decoder.counters()["skipped_bytes"] == 10_000 and decoder.pending_bytes == 0


@pytest.mark.parametrize(
    ("line", "frame", "taught"),
    [(GOLDEN, GOLDEN_FRAME, 0), (STAMPED[2], GOLDEN_FRAME._replace(timestamp_ms=0x1234), LINES_TO_LEARN)],
)
def test_no_loss_within_a_line_makes_another_frame(line, frame, taught):
    for start in range(len(line)):
        for end in range(start + 1, len(line)):
            decoder = SlcanDecoder()
            decoder.cut(line * taught)
            assert decoded(decoder, line[:start] + line[end:] + line) == [frame], (start, end)
