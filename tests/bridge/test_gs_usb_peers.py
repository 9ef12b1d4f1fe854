"""Public packages read the emulated gs_usb adapter, which shows that it is like a real one."""

import pytest
from gs_usb_emulator import GsUsbBackend
from gs_usb_samples import frames_of
from usb.backend import libusb1

from firmware_bridge.can.slcan import CanFrame


@pytest.fixture
def public_port(monkeypatch):
    backend = GsUsbBackend()
    monkeypatch.setattr(libusb1, "get_backend", lambda **_: backend)
    return backend.ports[0]


def test_the_public_package_reads_it_and_never_sees_the_unplugging(public_port):
    from gs_usb.gs_usb import GsUsb
    from gs_usb.gs_usb_frame import GsUsbFrame

    (device,) = GsUsb.scan()
    assert device.serial_number == public_port.serial_number and device.device_info.icount == 0
    assert device.set_bitrate(1_000_000)
    device.start()
    public_port.adapter.hear(CanFrame(0x334, b"abcdefgh"), stamp_us=77)
    frame = GsUsbFrame()
    assert device.read(frame, 100)
    assert (frame.can_id, bytes(frame.data), frame.timestamp_us) == (0x334, b"abcdefgh", 77)
    public_port.adapter.unplug()
    assert device.read(frame, 100) is False


def test_the_public_package_finds_it_mute_on_the_second_run(public_port):
    """gs_usb issue 20: it resets the device while a frame waits to be fetched."""
    from gs_usb.gs_usb import GsUsb
    from gs_usb.gs_usb_frame import GsUsbFrame

    for run in range(2):
        device = GsUsb.scan()[0]
        device.set_bitrate(1_000_000)
        device.start()
        public_port.adapter.hear(*frames_of(1))
        assert device.read(GsUsbFrame(), 10) is (run == 0)
        device.stop()


def test_python_can_reads_it(public_port):
    import can

    with can.Bus(interface="gs_usb", channel=0, bitrate=1_000_000) as bus:
        public_port.adapter.hear(CanFrame(0x114, b"\1\2"), stamp_us=5_000_000)
        message = bus.recv(1.0)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data), message.timestamp) == (0x114, b"\1\2", 5.0)
        bus.send(can.Message(arbitration_id=0x201, data=b"\7\0", is_extended_id=False))
        assert public_port.adapter.sent == [CanFrame(0x201, b"\7\0")]
