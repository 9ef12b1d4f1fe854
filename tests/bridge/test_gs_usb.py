"""gs_usb's requests, bit timing and frames: the pure part."""

import struct

import pytest
from bridge_samples import frames_of
from gs_usb_emulator import CANDLELIGHT
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.can import gs_usb
from firmware_bridge.can.bus_errors import LOST_RECENTLY_NS, BusErrors
from firmware_bridge.can.gs_usb import BitTimingLimits, GsUsbDecoder, HostFrame, bit_timing
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.frame_scans import GsUsbScans

SCAN = frames_of(1)


def host_frame(frame, *, echo_id=0xFFFFFFFF, channel=0, flags=0, more_id=0, stamp_us=None, fd=False, dlc=None):
    data = frame.data.ljust(64 if fd else 8, b"\0")
    dlc = len(frame.data) if dlc is None else dlc
    stamp = b"" if stamp_us is None else struct.pack("<I", stamp_us)
    return struct.pack("<IIBBBB", echo_id, frame.can_id | more_id, dlc, channel, flags | 2 * fd, 0) + data + stamp


WIDE = {"tseg1_max": 256, "tseg2_max": 128}


@pytest.mark.parametrize(
    ("limits", "timing"),
    [
        ({}, (6, 7, 2, 1, 3)),
        ({"clock_hz": 8_000_000, "tseg2_min": 2, "tseg2_max": 2}, (2, 3, 2, 1, 1)),  # sampled at 0.75
        ({"clock_hz": 10_000_000, "tseg2_max": 1}, (4, 4, 1, 1, 1)),  # and at 0.9
        ({"clock_hz": 8_000_000, "tseg2_min": 0, "tseg2_max": 1}, (3, 3, 1, 1, 1)),
        ({"clock_hz": 80_000_000, **WIDE}, (34, 35, 10, 4, 1)),
        ({"clock_hz": 170_000_000, **WIDE}, (73, 74, 22, 4, 1)),
        ({"clock_hz": 36_000_000}, (7, 7, 3, 1, 2)),
        ({"clock_hz": 80_000_000, "brp_min": 0, "brp_inc": 0}, (8, 8, 3, 1, 4)),
        ({"clock_hz": 80_000_000, "brp_min": 2, "brp_inc": 3}, (6, 7, 2, 1, 5)),
        ({"clock_hz": 16_000_000, "sjw_max": 0, "tseg1_min": 13}, (6, 7, 2, 1, 1)),
        ({"clock_hz": 16_000_000, "tseg1_min": 14}, None),
        ({"clock_hz": 48_000_000, "brp_min": 4}, (4, 5, 2, 1, 4)),
        ({"clock_hz": 48_500_000}, None),
        ({"tseg1_max": 3, "tseg2_min": 2}, None),
        ({"brp_max": 2}, None),
        ({"clock_hz": 0}, None),
        ({"clock_hz": 16_000_000, "brp_max": 1, "tseg2_max": 1}, None),
    ],
)
def test_the_timing_belongs_to_what_the_controller_can_do(limits, timing):
    if timing is None:
        with pytest.raises(ValueError, match="cannot do 1 Mbit/s"):
            bit_timing(CANDLELIGHT._replace(**limits))
    else:
        found = bit_timing(CANDLELIGHT._replace(**limits))
        assert found == timing and found.to_bytes() == struct.pack("<5I", *timing)
        assert found.sample_point == 1 - timing[2] / found.quanta and found.quanta == 1 + sum(timing[:3])


def test_requests_and_answers():
    """Source: Linux, drivers/net/can/usb/gs_usb.c."""
    assert (gs_usb.REQUEST_OUT, gs_usb.REQUEST_IN) == (0x41, 0xC1)
    assert [*gs_usb.Request] == [0, 1, 2, 4]
    assert (gs_usb.HARDWARE_STAMPS, gs_usb.OVERFLOW_FLAG) == (0x10, 1)
    assert gs_usb.mode(started=True, features=16) == struct.pack("<II", 1, 16)
    assert gs_usb.mode(started=False, features=16) == bytes(8)
    assert gs_usb.host_format() == b"\xef\xbe\0\0"
    with pytest.raises(ValueError, match="39 bytes, expected 40"):
        BitTimingLimits.from_bytes(bytes(39))
    assert BitTimingLimits.from_bytes(struct.pack("<10I", *CANDLELIGHT)) == CANDLELIGHT
    sent = gs_usb.encode_frame(CanFrame(0x201, b"\x07\0"), 3)
    assert sent == struct.pack("<IIBBBB8s", 3, 0x201, 2, 0, 0, 0, b"\x07")


@given(st.binary(max_size=99), st.sampled_from([0xFFFFFFFF, 0, 9]), st.integers(0, 1), st.integers(0, 9), st.booleans())
def test_whatever_comes_any_cut_gives_the_same(noise, echo_id, channel, flags, stamped):
    stream = host_frame(SCAN[0], echo_id=echo_id, channel=channel, flags=flags, stamp_us=7) * 3 + noise
    told = []
    for size in (1, 7, 32, 1000):
        decoder = GsUsbDecoder(stamped=stamped)
        pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
        told.append(([frame for piece in pieces for frame in decoder.feed(piece)], decoder.counters()))
    assert told == told[:1] * 4


@pytest.mark.parametrize("stamp_us", [None, 0xFFFFFFF0])
def test_what_is_in_a_frame(stamp_us):
    decoder = GsUsbDecoder(stamped=stamp_us is not None)
    standard, short = CanFrame(0x334, bytes(range(8))), CanFrame(0x7FF, b"")
    extended, remote = CanFrame(0x12345, b"\1", extended=True), CanFrame(0x7, b"", remote=True)
    sent = [
        (standard, {"flags": 1}),
        (extended, {"more_id": gs_usb.EXTENDED}),
        (remote, {"more_id": gs_usb.REMOTE, "dlc": 8}),
        (short, {}),
        (standard, {"dlc": 15}),
    ]
    got = decoder.feed(b"".join(host_frame(frame, stamp_us=stamp_us, **more) for frame, more in sent))
    assert got == [HostFrame(frame, None, stamp_us, "flags" in more) for frame, more in sent]
    (error,) = decoder.feed(host_frame(CanFrame(0x40, bytes(8)), more_id=gs_usb.ERROR, stamp_us=stamp_us))
    assert error.error == 0x40 and decoder.counters()["error_frames"] == 1
    assert decoder.feed(bytes(13)) == []
    decoder.start(stamped=False)
    assert decoder.feed(host_frame(standard)) == [HostFrame(standard, None, None, False)], "what it began is over"
    assert decoder.counters()["skipped_bytes"] == 13


ONE, TWO = host_frame(SCAN[1], stamp_us=1), host_frame(SCAN[2], stamp_us=1)


@pytest.mark.parametrize(
    ("counted", "kind"),
    [("echoes", {"echo_id": 3}), ("other_channels", {"channel": 1}), ("fd_frames", {"fd": True, "flags": 9})],
)
def test_what_is_left_out_is_counted_and_takes_nothing_along(counted, kind):
    decoder = GsUsbDecoder(stamped=True)
    assert [one.frame for one in decoder.feed(host_frame(SCAN[0], stamp_us=1, **kind) + ONE + TWO)] == SCAN[1:3]
    assert {name: count for name, count in decoder.counters().items() if count} == {"frames": 2, counted: 1}


@pytest.mark.parametrize(("classes", "data"), [(0x100, bytes(8)), (0x04, bytes((0, 0x40))), (0x204, bytes((0, 0x08)))])
def test_passive_ends_with_what_the_controller_says(classes, data):
    """Classes and data are as in Linux's error.h."""
    errors = BusErrors()
    errors.error_frame(0x04, bytes((0, 0x20)), 0)
    errors.frame_heard()
    errors.error_frame(0x80, bytes(8), 0)
    assert "error-passive" in (errors.trouble(0) or "")
    errors.error_frame(classes, data, 0)
    assert errors.trouble(0) is None


def test_errors_by_sort_and_how_long_they_are_trouble():
    errors = BusErrors()
    errors.error_frame(0x04 | 0x200, bytes((0, 0x04)) + bytes(6), 0)
    assert errors.trouble(0) is None
    errors.error_frame(0x04 | 0x200, bytes((0, 0x10)) + bytes(6), 0)
    assert "error-passive" in (errors.trouble(0) or "")
    for end in (errors.frame_heard, errors.restarted):
        for _ in range(3):
            errors.error_frame(0x40, bytes(8), 0)
        assert "bus-off" in (errors.trouble(0) or "")
        end()
        assert errors.trouble(0) is None
    errors.error_frame(0x88, bytes(8), 0)
    errors.error_frame(0x04, bytes((0, 0x01)) + bytes(6), 0)
    errors.overflow(1_000)
    assert "lost frames" in (errors.trouble(1_000 + LOST_RECENTLY_NS - 1) or "")
    assert errors.trouble(1_000 + LOST_RECENTLY_NS) is None
    assert errors.counters() == {"bus_off": 2, "error_passive": 1, "overflows": 2}


def test_device_time_goes_on_over_its_wrap_after_71_minutes():
    scans = GsUsbScans()
    scans.start(stamped=True)
    host_ns, delay_ns = 5_000_000_000_000, 300_000
    got = []
    for cycle in range(40):  # 0x1000000 us are 16.8 s: number 17 is the first after the wrap, and comes late
        for index, frame in enumerate(SCAN):
            at_us = cycle * 1_000_000 + index * 130
            data = host_frame(frame, stamp_us=(0xFF000000 + at_us) & 0xFFFFFFFF)
            got += scans.feed(data, host_ns + at_us * 1_000 + delay_ns * (cycle % 2))
    assert [scan.time_ns - (scan.device_ns or 0) for scan in got] == [0, delay_ns] * 20
