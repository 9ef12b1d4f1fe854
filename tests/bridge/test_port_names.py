"""Serial port under another name, identified by its serial number or path."""

import pytest
from bridge_samples import make_recording, read_scans
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import DeviceError, LinkLostError, NoDeviceError
from firmware_bridge.links.serial_ports import PluggedAdapter, Port
from firmware_bridge.links.slcan_serial import SlcanSerialLink

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus")
GRIPPER = Port("/dev/ttyUSB0", (0x0403, 0x6015), "GRIP1", "gripper")


def test_an_adapter_is_found_again_by_its_serial_number():
    adapter = PluggedAdapter("/dev/ttyUSB0")
    assert adapter.find([VSCOM]) == "/dev/ttyUSB0"
    # Another has its name now, and it has the next.
    assert adapter.find([GRIPPER, VSCOM._replace(path="/dev/ttyUSB1")]) == "/dev/ttyUSB1"
    with pytest.raises(NoDeviceError, match=r"no adapter with serial number D30BL366, .* seen: /dev/ttyUSB0"):
        adapter.find([GRIPPER])
    assert adapter.find([VSCOM]) == "/dev/ttyUSB0"


def test_an_adapter_without_a_serial_number_is_its_path():
    adapter = PluggedAdapter("/dev/ttyACM0")
    nameless = Port("/dev/ttyACM0", (0xAD50, 0x60C4), None, "CANtact")
    assert adapter.find([nameless]) == adapter.find([]) == adapter.find([VSCOM]) == "/dev/ttyACM0"
    # And what comes there later with one is learnt then.
    assert adapter.find([VSCOM._replace(path="/dev/ttyACM0")]) == "/dev/ttyACM0"
    assert adapter.find([VSCOM]) == "/dev/ttyUSB0"


def test_of_a_device_with_several_ports_it_is_the_same_one():
    first, second = (VSCOM._replace(path=f"/dev/ttyUSB{n}", interface=f"1.{n}") for n in range(2))
    adapter = PluggedAdapter("/dev/ttyUSB1")
    assert adapter.find([first, second]) == "/dev/ttyUSB1"
    moved = [first._replace(path="/dev/ttyUSB4"), second._replace(path="/dev/ttyUSB5")]
    assert adapter.find(moved) == "/dev/ttyUSB5"
    with pytest.raises(NoDeviceError, match="no adapter"):
        adapter.find(moved[:1])


def test_two_devices_with_one_serial_number_are_not_guessed_between():
    """Cheap adapters all have the same."""
    one, other = (Port(f"/dev/ttyACM{n}", (0xAD50, 0x60C4), "00001", "CANtact", interface="1.0") for n in range(2))
    adapter = PluggedAdapter(one.path)
    assert adapter.find([one, other]) == adapter.find([other, one]) == one.path
    with pytest.raises(NoDeviceError, match="2 adapters with serial number 00001"):
        adapter.find([other, one._replace(path="/dev/ttyACM2")])
    assert adapter.find([other]) == other.path  # alone it may be the same, plugged in elsewhere
    assert adapter.find([one, other]) == other.path  # and is it from then on


def test_a_link_through_a_name_for_the_port(tmp_path):
    (tmp_path / "skin").symlink_to("/dev/ttyUSB0")
    adapter = PluggedAdapter(str(tmp_path / "skin"))
    assert adapter.find([VSCOM]) == "/dev/ttyUSB0"
    assert adapter.find([VSCOM._replace(path="/dev/ttyUSB3")]) == "/dev/ttyUSB3"


def test_the_cable_out_and_in_again_under_another_name(monkeypatch):
    """The ports are real pseudo-terminals, which only the listing takes for USB."""
    plugged: list[ListPortInfo] = []
    monkeypatch.setattr(list_ports, "comports", lambda: list(plugged))

    def plug(port: str) -> None:
        info = ListPortInfo(port)
        info.vid, info.pid, info.serial_number, info.product = 0x0403, 0x6015, "D30BL366", "USB-CAN Plus"
        plugged[:] = [info]

    with Emulator([make_recording(10)], loop=True) as first, Emulator([make_recording(10)], loop=True) as second:
        plug(first.port)
        link = SlcanSerialLink(first.port)
        link.name = "slcan:serial=D30BL366"
        with link:
            before = read_scans(link, 3)
            first.hang_up()
            with pytest.raises(LinkLostError):
                read_scans(link, 10_000)
        plugged.clear()
        for _ in range(2):
            with pytest.raises(DeviceError, match="no adapter with serial number D30BL366"):
                link.__enter__()
        plug(second.port)
        with link:
            after = read_scans(link, 3)
            assert (link.port, link.name) == (second.port, "slcan:serial=D30BL366")
        assert {scan.sensor for scan in before + after} == {"4"}
        assert after[0].number > before[-1].number, "one series of numbers"
        assert after[0].device_ns is not None and 0 <= after[0].time_ns - after[0].device_ns < 10**9
