"""The serial ports of this machine, the links that a user names, and a port that comes back under another name."""

import pytest
from bridge_samples import make_counts, write_recording
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from firmware_bridge.errors import NoDeviceError, SourceError
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.links.registry import FORMS, open_sources
from firmware_bridge.links.serial_ports import PluggedAdapter, Port, find_adapter, serial_ports
from firmware_bridge.links.slcan_serial import SlcanSerialLink

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus")
SECOND_VSCOM = Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30XXXXX", "USB-CAN Plus")
CANABLE = Port("/dev/ttyACM0", (0xAD50, 0x60C4), "00001", "CANtact")
CANABLE_2 = Port("/dev/ttyACM1", (0x16D0, 0x117E), None, "CANable2")
OTHER = Port("/dev/ttyUSB7", (0x0403, 0x6001), "A1", "FT232R")
BUILT_IN = Port("/dev/ttyS0", None, None, "n/a")


def test_the_ports_of_this_machine(monkeypatch):
    """pyserial raises a TypeError where a device goes while ports are listed: int(None, 16)."""
    usb, fails = ListPortInfo("/dev/ttyUSB1"), [TypeError("int()"), TypeError("int()")]
    usb.vid, usb.pid, usb.serial_number, usb.description = 0x0403, 0x6015, "D30BL366", "x"
    usb.product, usb.manufacturer, usb.location = "USB-CAN Plus", "VScom", "1-2.1:1.0"

    def comports():
        if fails:
            raise fails.pop()
        return [usb, ListPortInfo("/dev/ttyS0")]

    monkeypatch.setattr(list_ports, "comports", comports)
    expected = Port("/dev/ttyUSB1", (0x0403, 0x6015), "D30BL366", "x", "USB-CAN Plus", "VScom", "1.0", "1-2.1")
    assert serial_ports() == [BUILT_IN, expected]
    usb.location = "1-2.1"
    assert serial_ports()[1].interface is None


@pytest.mark.parametrize(
    ("words", "adapter"),
    [
        *((words, True) for words in (("USB-CAN Plus", None), (None, None), ("CANUSB", "LAWICEL"))),
        *((words, False) for words in (("3D SCANNER", "CANON"), (None, "Robotiq"))),
    ],
)
def test_of_a_chip_that_many_devices_have_the_words_decide(words, adapter):
    named = dict(zip(("product", "manufacturer"), words, strict=True))
    assert VSCOM._replace(**named).adapter == ("VScom USB-CAN Plus" if adapter else None)
    # Others have ids of their own.
    assert CANABLE._replace(**named).adapter == "CANable, slcan firmware"


@pytest.mark.parametrize(
    ("ports", "found"),
    [
        ([OTHER, VSCOM, BUILT_IN], VSCOM),
        ([CANABLE], CANABLE),
        ([CANABLE_2, CANABLE_2], r"--source slcan:/dev/ttyACM1"),
        ([VSCOM, CANABLE], r"2 adapters found.* --source slcan:serial=D30BL366.* seen: /dev/ttyUSB0"),
        ([], r"no known adapter.*--source slcan:PORT.*seen: none"),
    ],
)
def test_the_one_known_adapter(ports, found):
    if isinstance(found, Port):
        assert find_adapter(ports) == found
        return
    with pytest.raises(NoDeviceError, match=found) as refused:
        find_adapter(ports)
    assert all(str(port) in str(refused.value) for port in ports) and "--source demo" in str(refused.value)


@pytest.mark.parametrize(
    ("text", "kind", "device", "line"),
    [
        ("slcan:/dev/by-id/usb@1@9600", SlcanSerialLink, "device", ("/dev/by-id/usb@1", 9600)),
        ("slcan:/dev/my=port", SlcanSerialLink, "device", ("/dev/my=port", 3_000_000)),
        ("slcan:serial=D30BL366@1000000", SlcanSerialLink, "device", ("/dev/ttyUSB0", 1_000_000)),
        ("gs_usb:0039", GsUsbLink, "device", None),
        ("can:virtual:a:b", CanBusLink, "emulated", None),
        ("demo", DemoLink, "emulated", ("", 3_000_000)),
    ],
)
def test_sources(plugged, text, kind, device, line):
    plugged += [BUILT_IN, VSCOM, SECOND_VSCOM]
    (link,) = open_sources([text], demo_recording="demo.npz")
    assert isinstance(link, kind) and (link.name, link.kind, link.serial_line()) == (text, device, line)


def test_no_source_is_the_one_adapter_and_never_a_pretended_one(plugged):
    plugged += [BUILT_IN, VSCOM, SECOND_VSCOM]
    with pytest.raises(NoDeviceError, match="--source demo"):
        open_sources([], demo_recording="demo.npz")
    plugged[1:] = [VSCOM, VSCOM]
    for serial_number in ("D30BL366", "D30XXXXX"):  # which two have, and none
        with pytest.raises(NoDeviceError, match=rf"port with serial number {serial_number}, .*seen: /dev/ttyS"):
            open_sources([f"slcan:serial={serial_number}"])
    plugged[1:] = [VSCOM]
    (link,) = open_sources([])
    assert isinstance(link, SlcanSerialLink) and (link.port, link.name) == ("/dev/ttyUSB0", "slcan:/dev/ttyUSB0")


def test_texts_that_are_no_source():
    no_form = [
        "",
        "slcan",
        "slcan:@9600",
        "slcan:serial=@9600",
        "replay:",
        "demo:",
        "Demo",
        "gs_usb:",
        "can:socketcan:",
    ]
    for text in no_form:
        with pytest.raises(SourceError) as refused:
            open_sources([text], demo_recording="demo.npz")
        assert repr(text) in str(refused.value) and all(form in str(refused.value) for form in FORMS)
    for text, form in {
        "/dev/ttyUSB0": "slcan:",
        "can0": "can:socketcan:",
        "ws://10.0.0.5:5000": "xela-server:",
        "press.mcap": "replay:",
    }.items():
        with pytest.raises(SourceError, match=rf"^source is '{text}': did you mean {form}{text}\?$"):
            open_sources([text])


@pytest.mark.parametrize("baud", ["", "fast", "0", "-1", "²", "0115200", "99999999999", "9" * 5000])
def test_a_baud_that_is_none_is_refused(baud):
    with pytest.raises(SourceError, match=rf"^baud is '{baud[:20]}', expected .*slcan:/dev/ttyUSB0@115200$") as refused:
        open_sources([f"slcan:/dev/ttyUSB0@{baud}"])
    assert len(str(refused.value)) < 120


def test_replay_sources(tmp_path):
    first, second, comma = (write_recording(tmp_path / f"{name}.csv", make_counts(2)) for name in ("a", "b", "a,b"))
    for text, sensors in ((f"{first},{second}", {"a", "b"}), (str(comma), {"a,b"})):
        (opened,) = open_sources([f"replay:{text}"], 1000.0)
        with opened as link:
            assert {scan.sensor for _ in range(2) for scan in link.read(1.0)} == sensors


GRIPPER = Port("/dev/ttyUSB0", (0x0403, 0x6015), "GRIP1", "gripper")
NAMELESS = Port("/dev/ttyACM0", (0xAD50, 0x60C4), None, "CANtact")
DOUBLE = [VSCOM._replace(path=f"/dev/ttyUSB{n}", interface=f"1.{n}") for n in range(2)]
MOVED = [one._replace(path=f"/dev/ttyUSB{n}") for n, one in enumerate(DOUBLE, 4)]
ONE, OTHER_ONE = (Port(f"/dev/ttyACM{n}", (0xAD50, 0x60C4), "00001", "CANtact", interface="1.0") for n in range(2))
LEFT, RIGHT = (Port(f"/dev/ttyUSB{n}", (0x0403, 0x6001), "0001", "USB CAN", location=f"1-{n + 2}") for n in range(2))
CROSSED = [LEFT._replace(path=RIGHT.path), RIGHT._replace(path=LEFT.path)]
NEITHER = r"no adapter that is surely the one with serial number 00001 .*ttyACM0"


@pytest.mark.parametrize(
    ("path", "looks"),
    [
        (
            "/dev/ttyUSB0",
            [
                ([VSCOM], "/dev/ttyUSB0"),
                ([GRIPPER, VSCOM._replace(path="/dev/ttyUSB1")], "/dev/ttyUSB1"),  # another has its name now
                ([GRIPPER], r"no adapter .* serial number D30BL366 .* seen: /dev/ttyUSB0"),
                ([VSCOM], "/dev/ttyUSB0"),
            ],
        ),
        # Without a serial number it is its path; what comes there later with one is learnt then.
        (
            "/dev/ttyACM0",
            [
                *(
                    (ports, "/dev/ttyACM0")
                    for ports in ([NAMELESS], [], [VSCOM], [VSCOM._replace(path="/dev/ttyACM0")])
                ),
                ([VSCOM], "/dev/ttyUSB0"),
            ],
        ),
        # Of a device with several ports it is the same one.
        ("/dev/ttyUSB1", [(DOUBLE, "/dev/ttyUSB1"), (MOVED, "/dev/ttyUSB5"), (MOVED[:1], "no adapter")]),
        # Cheap adapters all have the same number: the one that is left must not be taken for the other.
        (
            ONE.path,
            [
                *((ports, ONE.path) for ports in ([ONE, OTHER_ONE], [OTHER_ONE, ONE])),
                *((ports, NEITHER) for ports in ([OTHER_ONE], [OTHER_ONE, ONE._replace(path="/dev/ttyACM2")])),
                ([ONE], ONE.path),
            ],
        ),
        # Names of the kernel change, and sockets do not.
        (LEFT.path, [([LEFT, RIGHT], LEFT.path), (CROSSED, RIGHT.path), (CROSSED[1:], "surely")]),
        (RIGHT.path, [([LEFT, RIGHT], RIGHT.path), (CROSSED, LEFT.path)]),
    ],
)
def test_an_adapter_is_found_again_under_any_name(path, looks):
    adapter = PluggedAdapter(path)
    for ports, found in looks:
        if found.startswith("/"):
            assert adapter.find(ports) == found
        else:
            with pytest.raises(NoDeviceError, match=found):
                adapter.find(ports)


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
