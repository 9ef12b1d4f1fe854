"""Serial port under another name, identified by its serial number or path."""

import pytest
from bridge_samples import make_recording, read_scans
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import NoDeviceError
from firmware_bridge.links.registry import open_source
from firmware_bridge.links.serial_ports import PluggedAdapter, Port

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus")
GRIPPER = Port("/dev/ttyUSB0", (0x0403, 0x6015), "GRIP1", "gripper")


def test_an_adapter_is_found_again_by_its_serial_number():
    adapter = PluggedAdapter("/dev/ttyUSB0")
    assert adapter.find([VSCOM]) == "/dev/ttyUSB0"
    # Another has its name now, and it has the next.
    assert adapter.find([GRIPPER, VSCOM._replace(path="/dev/ttyUSB1")]) == "/dev/ttyUSB1"
    with pytest.raises(NoDeviceError, match=r"no adapter .* serial number D30BL366 .* seen: /dev/ttyUSB0"):
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


def test_a_serial_number_of_two_identifies_neither():
    """Cheap adapters all have the same: the one that is left must not be taken for the other."""
    one, other = (Port(f"/dev/ttyACM{n}", (0xAD50, 0x60C4), "00001", "CANtact", interface="1.0") for n in range(2))
    adapter = PluggedAdapter(one.path)
    assert adapter.find([one, other]) == adapter.find([other, one]) == one.path
    for present in ([other], [other, one._replace(path="/dev/ttyACM2")]):
        with pytest.raises(
            NoDeviceError, match=r"no adapter that is surely the one with serial number 00001 .*ttyACM0"
        ):
            adapter.find(present)
    assert adapter.find([one]) == one.path


def test_of_two_with_one_serial_number_each_has_its_socket():
    """Names of the kernel change, and sockets do not."""
    left, right = (
        Port(f"/dev/ttyUSB{n}", (0x0403, 0x6001), "0001", "USB CAN", location=f"1-{n + 2}") for n in range(2)
    )
    adapters = [PluggedAdapter(port.path) for port in (left, right)]
    assert [adapter.find([left, right]) for adapter in adapters] == [left.path, right.path]
    crossed = [left._replace(path=right.path), right._replace(path=left.path)]
    assert [adapter.find(crossed) for adapter in adapters] == [right.path, left.path]
    with pytest.raises(NoDeviceError, match="surely"):
        adapters[0].find([right._replace(path=left.path)])


def test_a_link_that_the_user_named_by_place_is_followed(tmp_path):
    ports = [VSCOM._replace(path=str(tmp_path / name), serial_number=name) for name in ("one", "two")]
    place = tmp_path / "left"
    adapter = PluggedAdapter(str(place))
    assert adapter.find(ports) == str(place), "a port that is not listed"
    for port in (*ports, ports[0]):
        place.unlink(missing_ok=True)
        place.symlink_to(port.path)
        assert adapter.find(ports) == port.path
    with pytest.raises(NoDeviceError, match=r"no adapter at .*left"):
        adapter.find(ports[1:])


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
        link = open_source("slcan:serial=D30BL366")
        with link:
            before = read_scans(link, 3)
            first.hang_up()
        plugged.clear()
        with pytest.raises(NoDeviceError, match=r"no adapter .* with serial number D30BL366"):
            link.__enter__()
        plug(second.port)
        with link:
            after = read_scans(link, 3)
    assert link.name == "slcan:serial=D30BL366"
    assert after[0].number > before[-1].number, "one series of numbers"
    assert after[0].device_ns is not None and 0 <= after[0].time_ns - after[0].device_ns < 10**9
