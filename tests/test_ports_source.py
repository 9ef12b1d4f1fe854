import os
import select
import tty
from types import SimpleNamespace

import pytest
from bridge_samples import make_counts, write_recording
from serial.tools import list_ports

from firmware_bridge.errors import NoDeviceError, RecordingError, SourceError
from firmware_bridge.links import source
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.ports import Port, find_adapter, find_by_serial, serial_ports
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.links.source import FORMS, open_source
from firmware_bridge.slcan import CLOSE, CanFrame, encode_frame
from firmware_bridge.xela import ID_MAPS

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus")
SECOND_VSCOM = Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30XXXXX", "USB-CAN Plus")
CANABLE = Port("/dev/ttyACM0", (0xAD50, 0x60C4), "00001", "CANtact")
CANABLE_2 = Port("/dev/ttyACM1", (0x16D0, 0x117E), None, "CANable2")
OTHER = Port("/dev/ttyUSB7", (0x0403, 0x6001), "A1", "FT232R")
BUILT_IN = Port("/dev/ttyS0", None, None, "n/a")


def test_the_ports_of_this_machine(monkeypatch):
    found = [
        SimpleNamespace(device="/dev/ttyUSB1", vid=0x0403, pid=0x6015, serial_number="D30BL366", description="x"),
        SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None, description="n/a"),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: found)
    assert serial_ports() == [BUILT_IN, Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30BL366", "x")]


def test_what_a_port_says():
    assert str(VSCOM) == "/dev/ttyUSB0 0403:6015 serial=D30BL366 (VScom USB-CAN Plus)"
    assert str(BUILT_IN) == "/dev/ttyS0 (n/a)"
    assert OTHER.adapter is None and CANABLE.adapter == "CANable, slcan firmware"


@pytest.mark.parametrize(
    ("ports", "found"),
    [
        ([OTHER, VSCOM, BUILT_IN], VSCOM),
        ([CANABLE], CANABLE),
        ([CANABLE_2], CANABLE_2),
        ([CANABLE, VSCOM], VSCOM),
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
    with pytest.raises(NoDeviceError, match=r"no known adapter.*--source slcan:PORT.*seen: none"):
        find_adapter([])


def test_by_serial_number():
    assert find_by_serial("D30XXXXX", [VSCOM, SECOND_VSCOM, BUILT_IN]) == SECOND_VSCOM
    with pytest.raises(NoDeviceError, match=r"no port with serial number D3, .*D30BL366"):
        find_by_serial("D3", [VSCOM])
    with pytest.raises(NoDeviceError, match="2 port"):
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
    assert (link.port, link._baudrate, link.name, link.kind) == (port, baudrate, text, "device")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "slcan",
        "slcan:",
        "slcan:@9600",
        "slcan:/dev/ttyUSB0@",
        "slcan:/dev/ttyUSB0@fast",
        "slcan:/dev/ttyUSB0@0",
        "slcan:/dev/ttyUSB0@-1",
        "slcan:/dev/ttyUSB0@²",
        "slcan:serial=",
        "slcan:serial=@9600",
        "replay",
        "replay:",
        "demo:",
        "demo",
        "Demo",
        "/dev/ttyUSB0",
        "gs_usb:0",
    ],
)
def test_other_sources_are_refused(two_vscom, text):
    with pytest.raises(SourceError) as refused:
        open_source(text)
    assert repr(text) in str(refused.value) and all(form in str(refused.value) for form in FORMS)


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
    for text in ("", "demo:", "gs_usb:0", "/dev/ttyUSB0"):
        with pytest.raises(SourceError):
            open_source(text, demo_recording=tmp_path)


def test_the_demo_source(tmp_path):
    link = open_source("demo", 50.0, tmp_path / "demo.npz")
    assert isinstance(link, DemoLink) and link.kind == "emulated"


def read_one_scan(model, ids):
    """What comes of one frame of each id, put on a line that `open_source` reads, and what it sent."""
    master, slave = os.openpty()
    tty.setraw(slave)
    sent = b""
    try:
        with open_source(f"slcan:{os.ttyname(slave)}", model=model) as link:
            for can_id in [*ids, ids[0]]:
                os.write(master, encode_frame(CanFrame(can_id, bytes((1, 2, 3, 4, 5, can_id >> 8, can_id & 0xF0, 7)))))
            scans = [scan for _ in range(20) for scan in link.read(0.05)]
        # The kernel passes it on in pieces, in its own time: all is there with the closing command.
        while not sent.endswith(b"\r" + CLOSE) and select.select([master], [], [], 5)[0]:
            sent += os.read(master, 4096)
    finally:
        os.close(master)
        os.close(slave)
    return scans, sent


def test_the_id_map_is_the_one_asked_for():
    ids = [sda << 8 | taxel << 4 | 4 for sda in range(2) for taxel in range(8)]
    (scan,), _ = read_one_scan(ID_MAPS["XR1944"], ids)
    assert scan.complete
    (half,), _ = read_one_scan(ID_MAPS["uSPa44"], ids)
    assert half.fresh.sum() == 8


def test_older_controllers_are_woken_and_others_are_not():
    ids = [0x710 | taxel for taxel in range(16)]
    (scan,), sent = read_one_scan(ID_MAPS["A"], ids)
    assert scan.complete and scan.sensor == "1"
    assert all(b"t20%d20700\r" % board in sent for board in range(1, 8))
    _, sent = read_one_scan(ID_MAPS["uSPa44"], [0x004])
    assert b"t2" not in sent
