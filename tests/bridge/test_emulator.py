"""The controller and the adapter that are emulated: their frames, times and answers, on a pseudo-terminal as well."""

import time

import can
import numpy as np
import pytest
from bridge_samples import make_counts, make_recording, read_until_lost, stacked
from can.interfaces.slcan import slcanBus

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import FRAME_S, Controller, Emulator, SlcanAdapter, bus_timeline
from firmware_bridge.errors import RecordingError
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.tracks import Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP


def test_scans_lie_on_the_grid_and_jitter_does_not_add_up():
    for rate_hz, jitter_s, period_s in ((100.0, 0.0, 0.01), (1000.0, 0.0, 16 * FRAME_S), (100.0, 0.003, 0.01)):
        controller = Controller(Track("x", make_counts(50, 0), None), 4, rate_hz)
        times_s = [time_s for time_s, _ in bus_timeline([controller], jitter_s=jitter_s, seed=0, loop=False)]
        assert abs(np.array(times_s[::16]) - period_s * np.arange(50)).max() <= jitter_s + 1e-9
        assert np.diff(times_s[:16]) == pytest.approx([FRAME_S] * 15)


# Answers of the adapter.

FRAME = CanFrame(0x004, bytes.fromhex("937E317E1593120F"))


@pytest.mark.parametrize(
    ("talk", "hears"),
    [  # it opens after bitrate and open alone, and what is open is not opened again
        ([(b"O\rS8\r", b"\a\r"), (b"O\r", b"\r"), (b"O\rS8\rZ1\r", b"\a\a\a"), (b"C\rO\r", b"\r\r")], True),
        ([(b"S6\rO\r", b"\r\r")], False),  # at another bitrate it hears nothing
        ([(b"S8\rZ1", b"\r"), (b"\rO\r", b"\r\r"), (b"F\rF1\rt20120700\r", b"F00\r\az\r")], True),
    ],
)
def test_an_adapter_obeys_and_refuses_as_a_strict_one(talk, hears):
    adapter, stamped = SlcanAdapter(), b"Z1" in talk[0][0]
    for commands, answers in talk:
        assert adapter.feed(commands) == answers
    assert adapter.hears_the_bus == hears
    line = encode_frame(FRAME._replace(timestamp_ms=59_999 if stamped else None))
    assert adapter.encode(FRAME, 59.9999) == line and adapter.encode(FRAME, 119.9999) == line


def test_what_no_such_sensors_made_is_refused():
    other = make_recording(1)
    wide = Track("4", np.zeros((1, 3, 5, 6), dtype=np.int32), None)
    with pytest.raises(RecordingError, match=r"\(3, 5, 6\)"):
        Emulator([type(other)(other.path, (wide,), 100.0)])
    with pytest.raises(ValueError, match="7 sensors on one bus, expected at most 6"):
        Emulator([other] * 7)


# The pseudo-terminal.


def test_an_emulator_that_waits_loses_no_frame_by_a_slow_reader():
    with (
        Emulator([make_recording(200, rate_hz=450.0)], jitter_s=0, waits=True) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        time.sleep(0.4)  # the terminal is full after .1 s; nor does it take its lateness for a stop, amid a scan
        scans = read_until_lost(link)
    assert (stacked(scans) == make_counts(200)).all()


def test_python_can_reads_our_emulator():
    recording, received = make_recording(20), list[can.Message]()
    with (
        Emulator([recording], loop=True) as emulator,
        slcanBus(f"{emulator.port}@3000000", bitrate=1_000_000, rtscts=True, sleep_after_open=0) as bus,
    ):
        end_s = time.monotonic() + 60
        while len(received) < 20 * 16 and time.monotonic() < end_s:
            received += filter(None, [bus.recv(0.1)])
    expected = [
        (can_id, int(scan.reshape(3, 16)[2, taxel]))
        for scan in recording.tracks[0].counts
        for can_id, taxel in USPA44_MAP.wire_order("4")
    ]
    assert [(one.arbitration_id, int.from_bytes(one.data[5:7], "big")) for one in received] == expected
