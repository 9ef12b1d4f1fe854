"""Wire of an slcan adapter besides frames: time stamps and status."""

import os

import pytest
from bridge_samples import SilentDevice, make_recording, read_scans
from edge_samples import wait_for

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links import slcan_serial
from firmware_bridge.links.slcan_serial import BUS_ERRORS, BUS_OFF, SlcanSerialLink
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans

MS = 1_000_000


def cycle_lines(number: int, stamp_ms: int | None = None) -> list[bytes]:
    """The lines of one scan; of stamped ones every eighth frame has the next millisecond."""
    return [
        encode_frame(
            CanFrame(
                can_id,
                bytes([9, 1, number % 256, 2, number % 256, taxel, 3, 9]),
                timestamp_ms=None if stamp_ms is None else (stamp_ms + place // 8) % 60_000,
            )
        )
        for place, (can_id, taxel) in enumerate(USPA44_MAP.wire_order("4"))
    ]


# Time stamps.


@pytest.mark.parametrize("cut", [1, 100, 1000])
def test_any_chunking_gives_the_same_times(cut):
    """The frames of two sensors mix, so that no cycle is whole; frames that came in time set the clock first."""
    lines = [line for n in range(9) for line in cycle_lines(n, 110 + 10 * n)]
    mixed = [one for line in lines for one in (line, line[:3] + b"6" + line[4:])]
    for text in (b"".join(lines), b"".join(mixed)):
        whole, pieces = SlcanScans(), SlcanScans()
        for scans in (whole, pieces):
            scans.feed(b"".join(cycle_lines(0, 100)), 10**12 - 10**9)
        expected = whole.feed(text, 10**12)
        got = [scan for at in range(0, len(text), cut) for scan in pieces.feed(text[at : at + cut], 10**12)]
        assert [scan.device_ns for scan in got] == [scan.device_ns for scan in expected]
        assert {scan.device_ns for scan in got} == {10**12 - 10**9 + (10 + 10 * n) * MS for n in range(9)}
        assert whole.counters() == pieces.counters()


def test_the_same_stamp_again_is_a_minute_later():
    scans = SlcanScans()
    scans.feed(b"".join(cycle_lines(0, 100)), 10**12)  # learns the form
    first, second = (scans.feed(b"".join(cycle_lines(n, 200)), 10**12 + (100 + n * 60_000) * MS)[0] for n in range(2))
    assert first.device_ns is not None and second.device_ns == first.device_ns + 60_000 * MS
    scans.begin_anew()
    (scan,) = scans.feed(b"".join(cycle_lines(1, 20)), second.time_ns + 30 * MS)
    assert scan.device_ns is not None and 0 <= scan.time_ns - scan.device_ns <= MS


LATE = cycle_lines(0, 0)[0][:-5] + b"FA00\r"  # no milliseconds of a minute


@pytest.mark.parametrize("text", [LATE * 16, b"".join(cycle_lines(0, 0))], ids=["beyond a minute", "within it"])
def test_stamps_that_stand_still_are_left_out(text, limits):
    limits(slcan_serial, ADAPTER_ASKED_NS=10**12)
    with SilentDevice() as device:
        with SlcanSerialLink(device.port) as link:

            def dropped():
                os.write(device.device_fd, text)
                link.read(0)
                return link.stamps_dropped

            wait_for(dropped)
            assert device.received(17) == b"C\rS8\rZ1\rO\rC\rZ0\rO\r"
            os.write(device.device_fd, LATE + b"".join(cycle_lines(1) + cycle_lines(2)))
            scan, *_ = read_scans(link, 1)
            assert scan.complete and scan.device_ns is None
        assert device.received(2) == b"C\r"
        with link:
            pass
        assert device.received(9) == b"C\rS8\rO\rC\r"


# Status.


@pytest.fixture
def impatient(limits):
    """Asks a silent adapter every 50 ms instead of 5 s."""
    limits(slcan_serial, ASKED_AGAIN_NS=50 * MS, ADAPTER_ASKED_NS=40 * MS)


def read_until(link: SlcanSerialLink, condition) -> None:
    wait_for(lambda: link.read(0.01) is not None and condition())


def test_a_silent_bus_with_errors_is_trouble(impatient):
    """The bitrate or the wiring is wrong: the adapter hears noise, and a frame never."""
    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        of_flags = ((b"F00\r", None), (b"F5F\r", None), (b"F80\r", BUS_ERRORS), (b"F20\r", BUS_ERRORS))
        for answered, (answer, trouble) in enumerate((*of_flags, (b"sb256256\r", BUS_OFF))):
            wait_for(lambda: link.read(0.01) == [] and b"F\r" in read_now(device))
            os.write(device.device_fd, answer)
            wait_for(lambda n=answered: link.read(0.01) == [] and status_lines(link) > n)
            assert link.trouble == trouble
        os.write(device.device_fd, b"".join(cycle_lines(0)))
        read_scans(link, 1)
        assert link.trouble is None


def status_lines(link: SlcanSerialLink) -> int:
    counted = link.counters()
    return counted["status_lines"] + counted["status_answers"]


def read_now(device: SilentDevice) -> bytes:
    os.set_blocking(device.device_fd, False)
    try:
        return os.read(device.device_fd, 1000)
    except BlockingIOError:
        return b""


def test_opening_again_does_not_unsay_what_was_said(impatient):
    """A link that lasts opens a silent adapter again and again: its trouble must not come and go with that."""
    with Emulator([make_recording(10)], loop=True) as emulator:
        link = SlcanSerialLink(emulator.port)
        with link:
            read_scans(link, 1)
            emulator.adapter.bus_off = True
            emulator.line.write(b"sb256256\r")
            read_until(link, lambda: link.trouble == BUS_OFF)
        for _ in range(2):
            with link:
                assert (link.read(0.01), link.trouble) == ([], BUS_OFF)
        answers = link.counters()["status_answers"]
        with link:
            read_until(link, lambda: link.counters()["status_answers"] > answers)
            emulator.adapter.bus_off = False
            read_until(link, lambda: link.trouble is None)


def test_stamps_are_not_asked_for_for_ever_where_nothing_comes(limits):
    """Some adapters write the setting to an EEPROM each time."""
    limits(slcan_serial, MOST_SILENT_OPENINGS=2, QUIET_S=0.001)
    stamped, plain = b"C\rS8\rZ1\rO\rC\rZ0\r", b"C\rS8\rO\rC\r"
    with SilentDevice() as device:
        link = SlcanSerialLink(device.port)
        for expected in (stamped, stamped, plain, plain):
            with link:
                pass
            assert device.received(len(expected)) == expected
        with link:
            assert device.received(7) == b"C\rS8\rO\r"
            os.write(device.device_fd, b"".join(cycle_lines(0)))
            read_scans(link, 1)
            assert device.received(7) == b"C\rZ1\rO\r"
            wait_for(lambda: link.read(0.0) == [])
            os.write(device.device_fd, b"".join(line for n in range(1, 9) for line in cycle_lines(n, 10 * n)))
            scans = read_scans(link, 8)
            assert all(scan.whole and scan.device_ns is not None for scan in scans), "no line of the new form is lost"
        assert device.received(5) == b"C\rZ0\r", "asked for once"
        with link:
            pass
        assert device.received(len(stamped)) == stamped
