"""Opening of python-can buses: what is passed on, refused and advised."""

import builtins
import errno
from functools import partial
from pathlib import Path

import can
import pytest

from firmware_bridge.errors import DeviceError, SourceError
from firmware_bridge.links import can_bus
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.can_networks import can_networks
from firmware_bridge.links.discovery import can_interfaces


def open_recorded(monkeypatch, interface, channel):
    asked = []
    monkeypatch.setattr(can, "Bus", lambda **settings: asked.append(settings))
    monkeypatch.setattr(can_bus, "_check_network", lambda name: None)
    CanBusLink(interface, channel).__enter__()
    return asked[0]


def test_the_bitrate_is_given_where_it_is_taken(monkeypatch):
    common = {"ignore_config": True}
    assert open_recorded(monkeypatch, "kvaser", "0") == common | {
        "interface": "kvaser",
        "channel": 0,
        "bitrate": 1_000_000,
    }
    assert open_recorded(monkeypatch, "pcan", "PCAN_USBBUS1")["channel"] == "PCAN_USBBUS1"
    assert open_recorded(monkeypatch, "virtual", "0") == common | {"interface": "virtual", "channel": "0"}
    socketcan = open_recorded(monkeypatch, "socketcan", "can0")
    assert "bitrate" not in socketcan
    assert socketcan["can_filters"] == [{"can_id": 0, "can_mask": 0, "extended": False}]


@pytest.mark.parametrize("interface", ["slcan", "gs_usb"])
def test_what_we_read_better_ourselves_is_refused(interface):
    with pytest.raises(SourceError, match=rf"use {interface}:"):
        CanBusLink(interface, "0")


def test_an_unknown_interface_gives_those_there_are():
    with pytest.raises(
        SourceError, match=r"expected can:INTERFACE:CHANNEL of .*kvaser.*pcan.*socketcan.*virtual"
    ) as no:
        CanBusLink("socketcam", "can0")
    assert "slcan" not in str(no.value) and "gs_usb" not in str(no.value)


def test_python_can_is_not_installed(monkeypatch):
    real = builtins.__import__

    def no_can(name, *arguments, **settings):
        if name == "can":
            raise ImportError(name)
        return real(name, *arguments, **settings)

    monkeypatch.setattr(builtins, "__import__", no_can)
    with pytest.raises(DeviceError, match=r"pip install '.+\[can\]'"):
        CanBusLink("virtual", "x")


@pytest.mark.parametrize("interface", ["pcan", "kvaser", "neovi", "socketcand", "vector"])
def test_a_driver_that_is_not_there(interface):
    with pytest.raises(DeviceError, match=rf"^can:{interface}:0: cannot be opened"):
        CanBusLink(interface, "0").__enter__()


def make_network(root: Path, name: str, *, up: bool, kind: str = "280", driver: str | None = None) -> None:
    network = root / "class/net" / name
    network.mkdir(parents=True)
    (network / "flags").write_text("0x40081\n" if up else "0x40080\n")
    (network / "type").write_text(f"{kind}\n")
    if driver:
        (root / driver).mkdir()
        (network / "device").mkdir()
        (network / "device/driver").symlink_to(root / driver)


@pytest.fixture
def sys_root(monkeypatch, tmp_path):
    monkeypatch.setattr(can_bus, "can_networks", partial(can_networks, tmp_path))
    return tmp_path


def test_a_network_that_is_not_there_or_down(sys_root):
    make_network(sys_root, "can1", up=True)
    make_network(sys_root, "eth0", up=True, kind="1")
    with pytest.raises(DeviceError, match=r"no CAN network can0: .*seen: can1$"):
        CanBusLink("socketcan", "can0").__enter__()
    with pytest.raises(DeviceError, match=r"no CAN network eth0: .*seen: can1$"):
        CanBusLink("socketcan", "eth0").__enter__()
    make_network(sys_root, "can0", up=False, driver="peak_usb")
    up = "sudo ip link set can0 up type can bitrate 1000000 restart-ms 100"
    with pytest.raises(DeviceError, match=rf"can0 is down: {up}$"):
        CanBusLink("socketcan", "can0").__enter__()
    make_network(sys_root, "vcan0", up=False)
    with pytest.raises(DeviceError, match=r"vcan0 is down: sudo ip link set vcan0 up$"):
        CanBusLink("socketcan", "vcan0").__enter__()


def test_what_the_list_of_devices_advises_is_what_opening_does(sys_root):
    make_network(sys_root, "can0", up=False, driver="gs_usb")
    (listed,) = can_interfaces(sys_root, lambda name: None)
    with pytest.raises(DeviceError) as refused:
        CanBusLink("socketcan", "can0").__enter__()
    assert str(refused.value) == f"CAN network can0 {listed.problems[0]}"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EAFNOSUPPORT, "Address family not supported"), "modprobe can_raw"),
        (PermissionError(errno.EPERM, "Operation not permitted"), "no permission"),
        (can.CanInitializationError("no such channel"), "cannot be opened: no such channel"),
    ],
)
def test_why_a_network_cannot_be_opened(monkeypatch, sys_root, error, words):
    def refuse(**settings):
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    make_network(sys_root, "can0", up=True)
    with pytest.raises(DeviceError, match=words):
        CanBusLink("socketcan", "can0").__enter__()
