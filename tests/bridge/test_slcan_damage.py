"""Damaged slcan lines: bytes that are changed, cut, lost or of noise."""

import random
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slcan_samples import GOLDEN, GOLDEN_FRAME, OTHER, OTHER_FRAME, STAMPED, decode, plain_frames

from firmware_bridge.can.slcan import (
    LINES_TO_LEARN,
    LONGEST_LINE,
    CanFrame,
    SlcanDecoder,
    encode_frame,
)


@given(
    st.lists(st.tuples(st.text("0123456789ABCDEFabcdef \0zx", max_size=60).map(str.encode), plain_frames), max_size=10)
)
@settings(deadline=None)
def test_noise_without_frame_letters_costs_nothing(noisy):
    stream = b"".join(noise + encode_frame(frame) for noise, frame in noisy)
    sent, counters = decode(stream)
    assert sent == [frame for _, frame in noisy]
    assert counters.get("skipped_bytes", 0) == sum(len(noise) for noise, _ in noisy)
    assert counters.get("bad_lines", 0) == 0


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


def test_every_cut_of_a_line():
    for start in range(len(GOLDEN)):
        for end in range(start, len(GOLDEN)):
            got, _ = decode(GOLDEN[:start] + GOLDEN[end:] + OTHER)
            assert got == ([GOLDEN_FRAME, OTHER_FRAME] if start == end else [OTHER_FRAME]), (start, end)


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
    assert decode(b"A" * 10_000)[1] == {"skipped_bytes": 10_000 - LONGEST_LINE}


def test_a_million_random_bytes():
    noise = random.Random(7)
    decoder = SlcanDecoder()
    decoder.feed(b"\r")
    tracemalloc.start()
    for _ in range(1000):
        for frame in decoder.feed(noise.randbytes(1000)):
            assert len(frame.data) < 8
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10_000
    assert decoder.counters()["skipped_bytes"] > 900_000
    assert decoder.feed(b"\r" + GOLDEN) == [GOLDEN_FRAME]


@given(st.lists(st.sampled_from([GOLDEN, OTHER[:9], b"\xff", b"z\r", b"\r", b"\a", b"junk"]), max_size=60))
@settings(deadline=None)
def test_every_byte_is_a_frame_a_reply_or_skipped(pieces):
    stream = b"".join(pieces) + b"\r"
    got, counters = decode(stream)
    ends, lone_z = stream.count(b"\r") + stream.count(b"\a"), stream.replace(b"\a", b"\r").split(b"\r").count(b"z")
    assert counters.get("frames", 0) == len(got)
    assert len(stream) == counters.get("skipped_bytes", 0) + 21 * len(got) + ends + lone_z


def test_no_loss_makes_a_frame_once_stamps_are_learnt():
    line = STAMPED[2]
    for start in range(len(line)):
        for end in range(start + 1, len(line)):
            decoder = SlcanDecoder()
            decoder.feed(line * LINES_TO_LEARN)
            assert decoder.feed(line[:start] + line[end:] + line) == [GOLDEN_FRAME._replace(timestamp_ms=0x1234)]


@pytest.mark.parametrize(("stamp", "learnt", "places"), [(b"", 0, set()), (b"1234", 0, {4}), (b"1234", 4, set())])
def test_where_a_letter_in_mid_line_makes_a_whole_frame(stamp, learnt, places):
    noise = random.Random(5)
    made_up = set()
    for _ in range(300):
        line = encode_frame(CanFrame(0x004, noise.randbytes(8)))[:-1] + stamp + b"\r"
        for place in range(1, len(line) - 1):
            got, _ = decode(STAMPED[2] * learnt + line[:place] + b"t" + line[place + 1 :])
            made_up |= {place for frame in got[learnt:] if len(frame.data) == 8}
    assert made_up == places


def test_what_a_broken_link_left_unfinished_is_skipped():
    decoder = SlcanDecoder()
    line = encode_frame(CanFrame(0x004, bytes(8)))
    decoder.feed(line[:9])
    decoder.begin_anew()
    assert decoder.pending_bytes == 0
    assert decoder.feed(line[9:]) == [] and decoder.feed(line) == [CanFrame(0x004, bytes(8))]
    assert decoder.counters()["skipped_bytes"] == len(line) - 1
