import os
import threading
import time
import tty
from contextlib import suppress

import pytest
from bridge_samples import make_counts, write_recording
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.errors import NoDeviceError, RecordingError, SourceError
from firmware_bridge.links import registry as source
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.links.registry import FORMS, open_source
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.links.serial_ports import Port, find_adapter, find_by_serial, serial_ports
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.can_id_maps import ID_MAPS

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus")
SECOND_VSCOM = Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30XXXXX", "USB-CAN Plus")
CANABLE = Port("/dev/ttyACM0", (0xAD50, 0x60C4), "00001", "CANtact")
CANABLE_2 = Port("/dev/ttyACM1", (0x16D0, 0x117E), None, "CANable2")
OTHER = Port("/dev/ttyUSB7", (0x0403, 0x6001), "A1", "FT232R")
BUILT_IN = Port("/dev/ttyS0", None, None, "n/a")


def test_the_ports_of_this_machine(monkeypatch):
    usb, none = ListPortInfo("/dev/ttyUSB1"), ListPortInfo("/dev/ttyS0")
    usb.vid, usb.pid, usb.serial_number, usb.description = 0x0403, 0x6015, "D30BL366", "x"
    usb.product, usb.manufacturer, usb.location = "USB-CAN Plus", "VScom", "1-2.1:1.0"
    monkeypatch.setattr(list_ports, "comports", lambda: [usb, none])
    expected = Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30BL366", "x", "USB-CAN Plus", "VScom", "1.0", "1-2.1")
    assert serial_ports() == [BUILT_IN, expected]
    usb.location = "1-2.1"
    assert serial_ports()[1].interface is None


def test_a_device_that_goes_while_ports_are_listed(monkeypatch):
    """pyserial: int(None, 16)."""
    looks = []

    def comports():
        looks.append(None)
        if len(looks) < 3:
            raise TypeError("int() can't convert non-string with explicit base")
        return [ListPortInfo("/dev/ttyS0")]

    monkeypatch.setattr(list_ports, "comports", comports)
    assert serial_ports() == [BUILT_IN]


def test_what_a_port_says():
    assert str(VSCOM) == "/dev/ttyUSB0 0403:6015 serial=D30BL366 (VScom USB-CAN Plus)"
    assert str(BUILT_IN) == "/dev/ttyS0 (n/a)"
    assert OTHER.adapter is None and CANABLE.adapter == "CANable, slcan firmware"


@pytest.mark.parametrize(
    ("product", "manufacturer", "adapter"),
    [
        ("USB-CAN Plus", "VScom", True),
        ("USB-CAN Plus", None, True),
        (None, None, True),
        ("CANUSB", "LAWICEL", True),
        ("Serial to CAN", None, True),
        ("BARCODE SCANNER", None, False),
        ("3D SCANNER", "CANON", False),
        ("FT231X USB UART", "FTDI", False),
        ("Robotiq gripper", None, False),
        (None, "Robotiq", False),
    ],
)
def test_of_a_chip_that_many_devices_have_the_words_decide(product, manufacturer, adapter):
    port = VSCOM._replace(product=product, manufacturer=manufacturer)
    assert port.adapter == ("VScom USB-CAN Plus" if adapter else None)
    # Others have ids of their own.
    assert CANABLE._replace(product=product, manufacturer=manufacturer).adapter == "CANable, slcan firmware"
    if not adapter:
        with pytest.raises(NoDeviceError, match="no known adapter"):
            find_adapter([port])


@pytest.mark.parametrize(
    ("ports", "found"),
    [
        ([OTHER, VSCOM, BUILT_IN], VSCOM),
        ([CANABLE], CANABLE),
        ([CANABLE_2], CANABLE_2),
        ([CANABLE, VSCOM], None),
        ([CANABLE_2, CANABLE, CANABLE], None),
        ([VSCOM, SECOND_VSCOM], None),
        ([VSCOM, SECOND_VSCOM, CANABLE], None),
        ([OTHER, BUILT_IN], None),
        ([], None),
    ],
)
def test_the_one_known_adapter(ports, found):
    if found:
        assert find_adapter(ports) == found
        return
    with pytest.raises(NoDeviceError, match="--source demo") as refused:
        find_adapter(ports)
    assert all(str(port) in str(refused.value) for port in ports)


def test_the_messages_say_what_to_do():
    with pytest.raises(NoDeviceError, match=r"2 adapters found.* --source slcan:serial=D30BL366.* seen: /dev/ttyUSB0"):
        find_adapter([VSCOM, SECOND_VSCOM])
    with pytest.raises(NoDeviceError, match=r"--source slcan:/dev/ttyACM1"):
        find_adapter([CANABLE_2, CANABLE_2])
    with pytest.raises(NoDeviceError, match=r"found, CANable, .* at /dev/ttyACM0, VScom USB-CAN Plus at /dev/ttyUSB0:"):
        find_adapter([CANABLE, VSCOM])
    with pytest.raises(NoDeviceError, match=r"no known adapter.*--source slcan:PORT.*seen: none"):
        find_adapter([])


def test_by_serial_number():
    assert find_by_serial("D30XXXXX", [VSCOM, SECOND_VSCOM, BUILT_IN]) == SECOND_VSCOM
    with pytest.raises(NoDeviceError, match=r"no port with serial number D3, .*D30BL366"):
        find_by_serial("D3", [VSCOM])
    with pytest.raises(NoDeviceError, match=r"2 port .* expected one: name one by its path"):
        find_by_serial("D30BL366", [VSCOM, VSCOM])


@pytest.fixture
def two_vscom(monkeypatch):
    monkeypatch.setattr(source, "serial_ports", lambda: [BUILT_IN, VSCOM, SECOND_VSCOM])


@pytest.mark.parametrize(
    ("text", "port", "baudrate"),
    [
        ("slcan:/dev/ttyUSB0", "/dev/ttyUSB0", 3_000_000),
        ("slcan:/dev/ttyUSB0@115200", "/dev/ttyUSB0", 115_200),
        ("slcan:/dev/by-id/usb@1@9600", "/dev/by-id/usb@1", 9600),
        ("slcan:COM3", "COM3", 3_000_000),
        ("slcan:/dev/my=port", "/dev/my=port", 3_000_000),
        ("slcan:serial=D30XXXXX", "/dev/ttyUSB1", 3_000_000),
        ("slcan:serial=D30BL366@1000000", "/dev/ttyUSB0", 1_000_000),
    ],
)
def test_slcan_sources(two_vscom, text, port, baudrate):
    link = open_source(text)
    assert isinstance(link, SlcanSerialLink)
    assert (link.port, link.baudrate, link.name, link.kind) == (port, baudrate, text, "device")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "slcan",
        "slcan:",
        "slcan:@9600",
        "slcan:serial=",
        "slcan:serial=@9600",
        "replay",
        "replay:",
        "demo:",
        "demo",
        "Demo",
        "gs_usb:",
        "gs_usb0",
        "can",
        "can:",
        "can:socketcan",
        "can:socketcan:",
    ],
)
def test_other_sources_are_refused(two_vscom, text):
    with pytest.raises(SourceError) as refused:
        open_source(text)
    assert repr(text) in str(refused.value) and all(form in str(refused.value) for form in FORMS)


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("/dev/ttyUSB0", "slcan:/dev/ttyUSB0"),
        ("/dev/ttyACM0@115200", "slcan:/dev/ttyACM0@115200"),
        ("can0", "can:socketcan:can0"),
        ("slcan1", "can:socketcan:slcan1"),
        ("ws://10.0.0.5:5000", "xela-server:ws://10.0.0.5:5000"),
        ("press.mcap", "replay:press.mcap"),
    ],
)
def test_a_source_without_its_form_is_refused_with_what_was_meant(two_vscom, text, meant):
    with pytest.raises(SourceError) as refused:
        open_source(text)
    assert str(refused.value) == f"source is {text!r}: did you mean {meant}?"


@pytest.mark.parametrize("baud", ["", "fast", "0", "-1", "²", "0115200", "99999999999", "9" * 5000])
def test_a_baud_that_is_none_is_refused(two_vscom, baud):
    with pytest.raises(SourceError, match=rf"^baud is '{baud[:20]}', expected .*slcan:/dev/ttyUSB0@115200$") as refused:
        open_source(f"slcan:/dev/ttyUSB0@{baud}")
    assert len(str(refused.value)) < 120


def test_gs_usb_sources():
    for text, serial_number in (("gs_usb", None), ("gs_usb:0039", "0039")):
        link = open_source(text, model=ID_MAPS["A"])
        assert isinstance(link, GsUsbLink)
        assert (link.serial_number, link.name, link.kind, len(link._triggers)) == (serial_number, text, "device", 7)


def test_can_sources():
    link = open_source("can:virtual:a:b", model=ID_MAPS["A"])
    assert isinstance(link, CanBusLink)
    assert (link._interface, link._channel, link.name, len(link._triggers)) == ("virtual", "a:b", "can:virtual:a:b", 7)


def test_no_source_is_the_one_adapter(monkeypatch):
    monkeypatch.setattr(source, "serial_ports", lambda: [BUILT_IN, VSCOM])
    link = open_source(None)
    assert isinstance(link, SlcanSerialLink) and (link.port, link.name) == ("/dev/ttyUSB0", "slcan:/dev/ttyUSB0")


def test_no_source_is_never_a_pretended_one(two_vscom, tmp_path):
    with pytest.raises(NoDeviceError, match="--source demo"):
        open_source(None, demo_recording=tmp_path)


def test_replay_sources(tmp_path):
    first = write_recording(tmp_path / "a.csv", make_counts(2))
    second = write_recording(tmp_path / "b.csv", make_counts(2))
    both = open_source(f"replay:{first},{second}", 1000.0)
    assert isinstance(both, ReplayLink) and both.kind == "replay"
    with both:
        assert {scan.sensor for _ in range(2) for scan in both.read(1.0)} == {"a", "b"}
    comma = write_recording(tmp_path / "a,b.csv", make_counts(2))
    with open_source(f"replay:{comma}", 1000.0) as link:
        assert {scan.sensor for scan in link.read(1.0)} == {"a,b"}
    with pytest.raises(RecordingError, match="gone"):
        open_source(f"replay:{tmp_path / 'gone.csv'}")


def test_nothing_but_demo_is_the_demo(tmp_path):
    for text in ("", "demo:", "gs_usb:", "/dev/ttyUSB0"):
        with pytest.raises(SourceError):
            open_source(text, demo_recording=tmp_path)


def test_the_demo_source(tmp_path):
    link = open_source("demo", 50.0, tmp_path / "demo.npz")
    assert isinstance(link, DemoLink) and link.kind == "emulated"


def read_one_scan(model, ids, cycles=1):
    """Return the scan of so many frames of each id, on a line that `open_source` reads, and the commands it sent."""
    master, slave = os.openpty()
    tty.setraw(slave)
    sent = bytearray()

    def take():
        """Take commands as an adapter does; without one the link waits a second for each of them."""
        with suppress(OSError):  # the terminal is closed
            while True:
                sent.extend(os.read(master, 4096))

    adapter = threading.Thread(target=take, daemon=True)
    adapter.start()
    try:
        with open_source(f"slcan:{os.ttyname(slave)}", model=model) as link:
            for can_id in [*ids * cycles, ids[0]]:
                os.write(master, encode_frame(CanFrame(can_id, bytes((1, 2, 3, 4, 5, can_id >> 8, can_id & 0xF0, 7)))))
            scans, end_s = [], time.monotonic() + 60
            while not scans and time.monotonic() < end_s:
                scans = link.read(0.05)
            scans += link.read(0.05)
    finally:
        os.close(slave)
        adapter.join()
        os.close(master)
    return scans, bytes(sent)


def test_the_id_map_is_the_one_asked_for():
    ids = [sda << 8 | taxel << 4 | 4 for sda in range(2) for taxel in range(8)]
    (scan,), _ = read_one_scan(ID_MAPS["XR1944"], ids)
    assert scan.complete
    # Half of the taxels make a sensor where they come twice in a row.
    (half,), _ = read_one_scan(ID_MAPS["uSPa44"], ids, cycles=2)
    assert half.fresh.sum() == 8


def test_older_controllers_are_woken_and_others_are_not():
    ids = [0x710 | taxel for taxel in range(16)]
    (scan,), sent = read_one_scan(ID_MAPS["A"], ids)
    assert scan.complete and scan.sensor == "1"
    assert all(b"t20%d20700\r" % board in sent for board in range(1, 8))
    ids = [sda << 8 | taxel << 4 | 4 for sda in range(4) for taxel in range(4)]
    (scan,), sent = read_one_scan(ID_MAPS["uSPa44"], ids)
    assert scan.complete and scan.sensor == "4"
    assert b"t2" not in sent
