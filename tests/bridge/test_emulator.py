"""The controller and the adapter that are emulated: their frames, times and answers."""

import random
from itertools import islice

import numpy as np
import pytest
from bridge_samples import make_counts, make_recording

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.emulation.xela_controller import FRAME_S, Controller, SlcanAdapter, bus_timeline, scan_frames
from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.tracks import Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP, decode
from firmware_bridge.scans.scan import ABSENT

# Frames of the controller.


def test_a_scan_is_sixteen_frames_in_the_order_of_sda_and_taxel():
    counts = make_counts(1)[0]
    frames = scan_frames(counts, 4, random.Random(0))
    seen = "004 014 024 034 104 114 124 134 204 214 224 234 304 314 324 334"
    assert [f"{frame.can_id:03X}" for frame in frames] == seen.split()
    # Columns run backwards: the first frame is the right end of the top row.
    assert decode(frames[0], USPA44_MAP) == ("4", 3, *counts[:, 0, 3])
    for frame in frames:
        reading = decode(frame, USPA44_MAP)
        assert reading is not None
        assert reading[2:] == tuple(counts[:, reading.taxel // 4, reading.taxel % 4])
        assert frame.data[0] != 0 and frame.data[7] != 0
    assert len({frame.data[0] for frame in frames}) > 4 and len({frame.data[7] for frame in frames}) > 4


def test_the_ends_of_the_range_and_absent_taxels():
    counts = make_counts(1)[0]
    counts[:, 0, 3] = [0, 65_535, 256]
    counts[:, 1, 1] = ABSENT
    frames = scan_frames(counts, 15, random.Random(0))
    assert frames[0].data[1:7] == bytes.fromhex("0000 FFFF 0100")
    assert len(frames) == 15 and 0x12F not in {frame.can_id for frame in frames}


def timeline(tracks: int = 1, scans: int = 50, rate_hz: float = 100.0, **options):
    controllers = [Controller(Track("x", make_counts(scans, n), None), 4 + 2 * n, rate_hz) for n in range(tracks)]
    return list(islice(bus_timeline(controllers, **({"jitter_s": 0.0, "seed": 0, "loop": False} | options)), 5000))


def test_scans_lie_on_the_grid_and_jitter_does_not_add_up():
    starts = [time_s for time_s, _ in timeline()[::16]]
    assert starts == pytest.approx([n / 100 for n in range(50)])
    times = [time_s for time_s, _ in timeline(jitter_s=0.003)]
    assert times == sorted(times)
    off = np.array(times[::16]) - np.arange(50) / 100
    assert abs(off).max() <= 0.003 and abs(off[1:]).max() > 0.002 and off.min() < 0 < off.max()
    gaps = np.diff(times).reshape(-1)[:15]
    assert gaps == pytest.approx([FRAME_S] * 15)


def test_a_controller_that_falls_behind_sends_no_two_at_once():
    times = [time_s for time_s, _ in timeline(rate_hz=1000.0)]
    assert np.diff(times) == pytest.approx([FRAME_S] * (len(times) - 1))


def test_looping_goes_on_in_time():
    frames = timeline(scans=2, loop=True)
    assert len(frames) == 5000
    assert frames[5 * 16][0] == pytest.approx(0.05)
    assert decode(frames[32][1], USPA44_MAP) == decode(frames[0][1], USPA44_MAP)


# Answers of the adapter.

FRAME = CanFrame(0x004, bytes.fromhex("937E317E1593120F"))


@pytest.mark.parametrize(
    ("options", "talk", "hears", "refused"),
    [  # it opens after bitrate and open alone, and what is open is not opened again
        (
            {},
            [(b"O\r", b"\a"), (b"S8\r", b"\r"), (b"O\r", b"\r"), (b"O\rS8\rZ1\r", b"\a\a\a"), (b"C\rO\r", b"\r\r")],
            True,
            4,
        ),
        ({}, [(b"S6\rO\r", b"\r\r")], False, 0),  # at another bitrate it hears nothing
        ({}, [(b"S", b""), (b"8\rO", b"\r"), (b"\r", b"\r"), (b"x" * 100_000, b""), (b"\rC\r", b"\a\r")], False, 1),
        ({}, [(b"V\r", b"V1013\r"), (b"S8\rO\rt20120700\r", b"\r\rz\r")], True, 0),
        ({}, [(b"\rC\rS9\rS\rS88\rOO\rx\rt0010\rV1\r", b"\a" * 9)], False, 9),
        ({"acknowledges": False}, [(b"O\rS8\rO\rO\rV\r", b"")], True, 2),
        ({"old_canable": True}, [(b"C\rS8\rZ1\rO\rF\rV\rN\r", b"")], True, 1),
        ({"left_open": True}, [(b"F\rF1\rC\rF\r", b"F00\r\a\r\a")], False, 2),
    ],
)
def test_an_adapter_obeys_and_refuses_as_a_strict_one(options, talk, hears, refused):
    adapter = SlcanAdapter(**options)
    for commands, answers in talk:
        assert adapter.feed(commands) == answers
    assert (adapter.hears_the_bus, adapter.refused) == (hears, refused)
    assert adapter.sent == ([b"t20120700"] if b"t201" in talk[-1][0] else [])


def test_time_stamps_are_on_request_and_wrap_each_minute():
    old, adapter = SlcanAdapter(old_canable=True), SlcanAdapter()
    old.feed(b"Z1\r")
    assert old.encode(FRAME, 1.0) == b"t0048937E317E1593120F\r"
    assert adapter.encode(FRAME, 59.9999) == b"t0048937E317E1593120F\r"
    adapter.feed(b"Z1\r")
    assert adapter.encode(FRAME, 59.9999) == b"t0048937E317E1593120FEA5F\r"
    assert adapter.encode(FRAME, 60.0) == b"t0048937E317E1593120F0000\r"
    adapter.feed(b"Z0\r")
    assert adapter.encode(FRAME, 60.0) == b"t0048937E317E1593120F\r"


def test_flags_are_cleared_by_telling():
    adapter = SlcanAdapter(left_open=True)
    adapter.flags = 0x8A
    assert adapter.feed(b"F\r") + adapter.feed(b"F\r") == b"F8A\rF00\r"


def test_the_state_is_told_and_bus_off_hears_nothing():
    adapter = SlcanAdapter(left_open=True)
    assert adapter.state_line("w", 96, 0) == b"sw096000\r" and adapter.hears_the_bus
    assert adapter.state_line("b", 256, 256) == b"sb256256\r" and not adapter.hears_the_bus
    adapter.feed(b"C\r")
    assert adapter.state_line("a", 0, 0) == b"", "who is closed tells nothing"


@pytest.mark.parametrize(
    ("recordings", "options", "words"),
    [
        (1, {"controllers": [4, 6]}, "expected"),
        (1, {"controllers": [16]}, "expected"),
        (1, {"controllers": [-1]}, "expected"),
        (2, {"controllers": [4, 4]}, "2 different ones"),
        (1, {"rate_hz": 0.0}, "expected"),
        (1, {"rate_hz": float("nan")}, "expected"),
    ],
)
def test_options_out_of_range(recordings, options, words):
    with pytest.raises(ValueError, match=words):
        Emulator([make_recording(1)] * recordings, **options)


def test_recordings_that_no_such_sensor_made():
    other = make_recording(1)
    wide = Track("4", np.zeros((1, 3, 5, 6), dtype=np.int32), None)
    with pytest.raises(RecordingError, match=r"\(3, 5, 6\)"):
        Emulator([type(other)(other.path, (wide,), 100.0)])
    with pytest.raises(RecordingError, match="--rate-hz"):
        Emulator([type(other)(other.path, other.tracks, None)])
