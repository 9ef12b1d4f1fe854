"""Opening and closing of serial links: commands, devices that take nothing, and ports that cannot be opened."""

import contextlib
import errno
import os
import threading
import time

import pytest
import serial
from bridge_samples import make_recording
from serial_samples import SilentDevice

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import BridgeError, DeviceError
from firmware_bridge.links import slcan_serial
from firmware_bridge.links.slcan_serial import SlcanSerialLink


def test_commands_on_opening_and_closing():
    with SilentDevice() as device:
        with SlcanSerialLink(device.port) as link:
            assert link.read(0.0) == []
        # Nothing before, nothing between and nothing after: an empty command is refused by some adapters.
        assert device.received(15) == b"C\rS8\rZ1\rO\rC\rZ0\r"


def test_no_time_stamps_where_the_line_carries_none():
    with SilentDevice() as device:
        with SlcanSerialLink(device.port, 921_600) as link:
            assert link.read(0.0) == []
        assert device.received(9) == b"C\rS8\rO\rC\r"


def fill(port_fd: int) -> None:
    os.set_blocking(port_fd, False)
    for _ in range(5):  # the kernel moves bytes on to a second buffer, with a delay
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(port_fd, b"xxxx")
        time.sleep(0.01)


def test_a_device_that_takes_nothing_does_not_hold_up_closing(monkeypatch):
    monkeypatch.setattr(slcan_serial, "WRITE_TIMEOUT_S", 0.05)
    with SilentDevice() as device:
        with SlcanSerialLink(device.port):
            fill(device.client_fd)
        serial.Serial(device.port, exclusive=True).close()  # the port is free again


def test_a_device_that_takes_nothing_does_not_hold_up_opening(monkeypatch):
    monkeypatch.setattr(slcan_serial, "WRITE_TIMEOUT_S", 0.05)
    with SilentDevice() as device:
        fill(device.client_fd)
        with pytest.raises(DeviceError, match="does not take commands"):
            SlcanSerialLink(device.port).__enter__()
        serial.Serial(device.port, exclusive=True).close()


@pytest.mark.parametrize("unsent", [0, 5])
def test_commands_are_thrown_away_only_if_the_device_does_not_take_them(monkeypatch, unsent):
    """Throwing them away always would throw away the closing as well."""
    thrown = []
    with SilentDevice() as device:
        with SlcanSerialLink(device.port):
            monkeypatch.setattr(slcan_serial, "WRITE_TIMEOUT_S", 0.02)
            # A pseudo-terminal never reports unsent bytes.
            monkeypatch.setattr(serial.Serial, "out_waiting", unsent)
            monkeypatch.setattr(serial.Serial, "reset_output_buffer", lambda port: thrown.append(port))
        assert bool(thrown) == bool(unsent)


def test_a_stream_that_will_not_stop_does_not_hold_up_opening(monkeypatch):
    monkeypatch.setattr(slcan_serial, "LONGEST_SETTLE_S", 0.1)
    stop = threading.Event()
    with SilentDevice() as device:
        os.set_blocking(device.device_fd, False)

        def chatter():
            while not stop.wait(0.001):
                with contextlib.suppress(BlockingIOError):
                    os.write(device.device_fd, b"t0048937E317E1593120F\r")

        thread = threading.Thread(target=chatter)
        thread.start()
        try:
            with SlcanSerialLink(device.port) as link:
                while not link.counters()["frames"]:
                    link.read(1.0)
        finally:
            stop.set()
            thread.join()


def test_flow_control_is_asked_for():
    with SilentDevice() as device:
        for rtscts in (True, False):
            with SlcanSerialLink(device.port, rtscts=rtscts):
                assert (
                    bool(slcan_serial.termios.tcgetattr(device.client_fd)[2] & slcan_serial.termios.CRTSCTS) == rtscts
                )


# What goes wrong before anything is open.


def test_no_such_port():
    with pytest.raises(DeviceError, match=r"/dev/ttyNONE: no such port\. Serial ports seen: "):
        SlcanSerialLink("/dev/ttyNONE").__enter__()


def test_something_that_is_no_serial_port(tmp_path):
    path = tmp_path / "file"
    path.write_text("")
    for port in (str(path), str(tmp_path), "/dev/null"):
        with pytest.raises(DeviceError, match="cannot be used as a serial port"):
            SlcanSerialLink(port).__enter__()


@pytest.mark.parametrize(
    ("code", "words"),
    [(errno.EACCES, "dialout"), (errno.EPERM, "dialout"), (errno.EBUSY, "slcand"), (errno.EIO, "Input/output error")],
)
def test_why_a_port_cannot_be_opened(monkeypatch, code, words):
    def refuse(*args, **kwargs):
        raise serial.SerialException(code, f"could not open port: [Errno {code}]")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=words) as refused:
        SlcanSerialLink("/dev/ttyUSB0").__enter__()
    assert isinstance(refused.value, BridgeError) and isinstance(refused.value, OSError)


def test_an_adapter_that_goes_while_it_is_opened(monkeypatch):
    with Emulator([make_recording(1)]) as emulator:
        link = SlcanSerialLink(emulator.port)
        opened = link._open_port

        def open_and_pull():
            port = opened()
            emulator.hang_up()
            return port

        monkeypatch.setattr(link, "_open_port", open_and_pull)
        with pytest.raises(DeviceError):
            link.__enter__()


def test_terminal_errors_are_link_errors(monkeypatch):
    """pyserial lets them through from some calls, and they are no OSError."""

    def fail(*args, **kwargs):
        raise slcan_serial.termios.error(errno.EIO, "Input/output error")

    with SilentDevice() as device:
        with SlcanSerialLink(device.port) as link:
            monkeypatch.setattr(serial.Serial, "write", fail)
        with pytest.raises(DeviceError):
            link.__enter__()
        monkeypatch.setattr(serial, "Serial", fail)
        with pytest.raises(DeviceError):
            link.__enter__()


def test_low_latency_where_the_driver_has_it(monkeypatch):
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda port, on: asked.append(on))
    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        assert asked == [True] and link.low_latency
