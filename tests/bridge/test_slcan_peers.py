"""The same line, spoken by python-can: it reads our emulator, and we read what it writes."""

import time

import can
import pytest
from bridge_samples import frames_of, make_recording
from can.interfaces.slcan import slcanBus
from link_rigs import message_of
from serial_samples import SilentDevice

from firmware_bridge.can.slcan import SlcanDecoder
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.scans.can_id_maps import USPA44_MAP


def open_peer(port: str) -> slcanBus:
    """Open it as its users do, without the two seconds that it sleeps."""
    return slcanBus(f"{port}@3000000", bitrate=1_000_000, rtscts=True, sleep_after_open=0)


@pytest.mark.parametrize(
    ("options", "stamps"), [({}, b"Z1\r"), ({"acknowledges": False}, b""), ({"old_canable": True}, b"")], ids=str
)
def test_it_reads_our_emulator(options, stamps):
    recording = make_recording(20)
    received: list[can.Message] = []
    with Emulator([recording], loop=True, **options) as emulator:
        emulator.adapter.feed(stamps)
        with open_peer(emulator.port) as bus:
            end_s = time.monotonic() + 60
            while len(received) < 20 * 16 and time.monotonic() < end_s:
                received += filter(None, [bus.recv(0.1)])
    order = [can_id for can_id, _ in USPA44_MAP.wire_order("4")]
    assert [message.arbitration_id for message in received] == order * 20
    assert all(message.dlc == len(message.data) == 8 and not message.is_extended_id for message in received)
    values = [int.from_bytes(message.data[5:7], "big") for message in received]
    taxels = [taxel for _, taxel in USPA44_MAP.wire_order("4")]
    assert values == [int(scan.reshape(3, 16)[2, taxel]) for scan in recording.tracks[0].counts for taxel in taxels]


def test_we_read_what_it_writes():
    """The package takes the place of the adapter: what it sends is put on our line."""
    frames = frames_of(3)
    with SilentDevice() as far_end, slcanBus(f"{far_end.port}@3000000", sleep_after_open=0) as bus:
        assert far_end.received(2) == b"O\r"
        for frame in frames:
            bus.send(message_of(frame))
        decoder = SlcanDecoder()
        assert decoder.feed(far_end.received(len(frames) * 22)) == frames and decoder.counters()["bad_lines"] == 0
