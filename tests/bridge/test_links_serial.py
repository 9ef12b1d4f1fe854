"""The slcan link on a serial port: bursts, opening and closing, time stamps and status."""

import contextlib
import errno
import os
import subprocess
import sys
import termios
import threading
import time

import pytest
import serial
from bridge_samples import SilentDevice, cycle_lines, read_scans
from edge_samples import wait_for

from firmware_bridge.can.slcan import CLOSE, CanFrame, encode_frame
from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links import slcan_serial
from firmware_bridge.links.slcan_serial import BUS_ERRORS, PortReader, SlcanSerialLink

MS = 1_000_000


def test_what_came_before_the_loss_is_not_lost(monkeypatch):
    """The last byte may come alone, and the cable go before the next look: it may close a scan."""
    came = [b"\r"]

    def read(descriptor, most_bytes):
        if came:
            return came.pop()
        raise OSError(errno.EIO, "Input/output error")

    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        os.write(device.device_fd, b"x")  # which shows that there is something to read
        monkeypatch.setattr(slcan_serial.os, "read", read)
        got = link.read(0.0), link.counters()["received_bytes"], link.counters()["replies"]
        with pytest.raises(LinkLostError):
            link.read(0.0)
        came.append(b"")
        with pytest.raises(LinkLostError, match="hung up"):
            link.read(0.0)
        monkeypatch.undo()
    assert got == ([], 1, 1)


def test_who_stands_still_after_a_look_is_not_up_to_date(monkeypatch):
    """Otherwise bytes that arrive meanwhile would look new."""
    now_ns, half_s, read = [0], 500_000_000, os.read

    def stands_still(*arguments):
        try:
            return read(*arguments)
        finally:
            now_ns[0] += half_s

    with SilentDevice() as device, monkeypatch.context() as patched:
        reader = PortReader(device.client_fd, clock_ns=lambda: now_ns[0])
        patched.setattr(slcan_serial.os, "read", stands_still)
        assert reader.take() == (b"", half_s, 0)
        assert reader.take() == (b"", 2 * half_s, half_s)
        os.write(device.device_fd, b"z\r")
        assert reader.read(0, 1) == (b"z\r", 3 * half_s, half_s), "they may have come at once"
        assert reader.read(0, 1) == (b"", 3 * half_s, 3 * half_s)


def test_what_lies_there_at_an_opening_or_at_the_end_is_dropped():
    """A client that was killed leaves the channel open, and the kernel keeps what it did not read."""
    line = encode_frame(CanFrame(0x401, bytes(8)))

    def answer(device):
        while CLOSE not in os.read(device.device_fd, 64):
            pass
        os.write(device.device_fd, 2 * line)

    with SilentDevice() as device:
        os.write(device.device_fd, 7 * line)
        link = SlcanSerialLink(device.port)
        late = threading.Thread(target=answer, args=[device])
        late.start()
        with link:
            late.join()
            os.write(device.device_fd, 3 * line)
        assert link.counters()["dropped_bytes"] == 5 * len(line), "and counted, but for what lay there before"
        assert link.counters()["frames"] == link.counters()["received_bytes"] == 0


def fill(port_fd: int) -> None:
    os.set_blocking(port_fd, False)
    for _ in range(5):  # the kernel moves bytes on to a second buffer, with a delay
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(port_fd, b"xxxx")
        time.sleep(0.01)


def test_a_device_that_takes_nothing_holds_up_nobody(limits):
    limits(slcan_serial, WRITE_TIMEOUT_S=0.05)
    with SilentDevice() as device:
        with SlcanSerialLink(device.port):
            fill(device.client_fd)
        fill(device.client_fd)
        with pytest.raises(DeviceError, match="does not take commands"):
            SlcanSerialLink(device.port).__enter__()
        serial.Serial(device.port, exclusive=True).close()  # the port is free again


def test_a_stream_that_will_not_stop_holds_up_no_opening(limits):
    limits(slcan_serial, LONGEST_SETTLE_S=0.1)
    stop, line = threading.Event(), encode_frame(CanFrame(0x401, bytes(8)))
    with SilentDevice() as device:

        def chatter():
            while not stop.wait(0.001):
                os.write(device.device_fd, line)

        thread = threading.Thread(target=chatter)
        thread.start()
        with SlcanSerialLink(device.port) as link:
            wait_for(lambda: link.read(1.0) or link.counters()["frames"])
            stop.set()
            thread.join()


@pytest.mark.parametrize(
    ("settings", "speed", "commands"),
    [
        ((), termios.B3000000, b"C\rS8\rZ1\rO\rC\rZ0\r"),
        ((921_600,), termios.B921600, b"C\rS8\rO\rC\r"),  # a slow line carries no time stamps
    ],
)
def test_what_is_asked_of_the_port_and_the_adapter(monkeypatch, settings, speed, commands):
    """Nothing before, between and after the commands: an empty one is refused by some adapters."""
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda port, on: asked.append(on))
    with SilentDevice() as device:
        with SlcanSerialLink(device.port, *settings):
            attributes = termios.tcgetattr(device.client_fd)
        assert attributes[2] & termios.CRTSCTS and attributes[4:6] == [speed, speed] and asked == [True]
        assert device.received(len(commands)) == commands


@pytest.mark.parametrize(
    ("code", "words"),
    [(errno.EACCES, "dialout"), (errno.EBUSY, "slcand"), (errno.EIO, "Input/output error")],
)
def test_why_a_port_cannot_be_opened(monkeypatch, code, words):
    with pytest.raises(DeviceError, match=r"no such port\. Serial ports seen: "):
        SlcanSerialLink("/dev/ttyNONE").__enter__()

    def refuse(*args, **kwargs):
        raise serial.SerialException(code, f"could not open port: [Errno {code}]")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=words) as refused:
        SlcanSerialLink("/dev/ttyUSB0").__enter__()
    assert isinstance(refused.value, BridgeError) and isinstance(refused.value, OSError)


def test_who_holds_a_port_is_named():
    held = "import fcntl, sys; f = open(sys.argv[1], 'r+b', 0); fcntl.flock(f, fcntl.LOCK_EX); print(1, flush=True)"
    with SilentDevice() as device:
        with SlcanSerialLink(device.port), pytest.raises(DeviceError, match=r"in use by this program, or .*slcand"):
            SlcanSerialLink(device.port).__enter__()
        command = [sys.executable, "-c", f"{held}; input()", device.port]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout.readline() == b"1\n"
            with pytest.raises(DeviceError, match=rf"in use by \S+ \({process.pid}\): .*ModemManager.*udev rule ATTRS"):
                SlcanSerialLink(device.port).__enter__()
            process.communicate()
        with SlcanSerialLink(device.port):
            pass


@pytest.mark.parametrize("error", [OSError(errno.EIO, "gone"), termios.error(errno.EIO, "gone")])
def test_an_adapter_that_goes_while_it_is_opened_or_closed(monkeypatch, error):
    """pyserial lets errors of the terminal through from some calls, and they are no OSError."""

    def fail(*args, **kwargs):
        raise error

    with SilentDevice() as device:
        with SlcanSerialLink(device.port) as link:
            monkeypatch.setattr(serial.Serial, "write", fail)
        with pytest.raises(DeviceError):
            link.__enter__()


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


def test_a_silent_bus_with_errors_is_trouble(limits):
    """The bitrate or the wiring is wrong: the adapter hears noise, and a frame never."""
    limits(slcan_serial, ASKED_AGAIN_NS=50 * MS, ADAPTER_ASKED_NS=40 * MS)
    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        of_flags = ((b"F00\r", None), (b"F5F\r", None), (b"F80\r", BUS_ERRORS), (b"F20\r", BUS_ERRORS))
        for answered, (answer, trouble) in enumerate(of_flags):
            wait_for(lambda: link.read(0.01) == [] and b"F\r" in device.received(1, within_s=0))
            os.write(device.device_fd, answer)
            wait_for(lambda n=answered: link.read(0.01) == [] and link.counters()["status_answers"] > n)
            assert link.trouble == trouble
        link.__exit__(None, None, None)
        with link:
            assert (link.read(0.01), link.trouble) == ([], BUS_ERRORS), "an opening does not unsay it"
            os.write(device.device_fd, b"".join(cycle_lines(0)))
            read_scans(link, 1)
            assert link.trouble is None


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
