"""Devices that are plugged in, and advice for a port that gives no scan: real ports on which something else speaks."""

import os
import re
import subprocess
from functools import partial
from unittest.mock import Mock

import pytest
from link_rigs import make_network

from edge.cli import main as cli
from edge.pipeline.run_statistics import silence_hint
from firmware_bridge.errors import DeviceError
from firmware_bridge.links import discovery as devices
from firmware_bridge.links import gs_usb_link
from firmware_bridge.links.discovery import can_interfaces
from firmware_bridge.links.gs_usb_link import GsUsbDevice
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.scans.slcan_scans import SlcanScans

HINT = "The vendor's server, where one runs, is not searched for: --source xela-server:ws://HOST:5000"

VSCOM = Port("/dev/ttyUSB0", (0x0403, 0x6015), "D30BL366", "USB-CAN Plus", "USB-CAN Plus", "VScom")
GRIPPER = Port("/dev/ttyUSB71", (0x0403, 0x6015), "GRIP1", "FT231X USB UART", "FT231X USB UART", "FTDI")
BUILT_IN = Port("/dev/ttyS0", None, None, "n/a")


@pytest.fixture
def gs_usb(plugged, monkeypatch, tmp_path):
    """Adapters on USB, to be filled by a test, on a machine whose CAN networks are those of a folder."""
    there: list[GsUsbDevice] = []
    monkeypatch.setattr(devices, "can_interfaces", partial(can_interfaces, tmp_path))
    monkeypatch.setattr(gs_usb_link, "gs_usb_devices", lambda: there)
    monkeypatch.setenv("COLUMNS", "200")
    return there


def test_everything_is_listed_adapters_first(plugged, gs_usb, capsys, tmp_path, monkeypatch):
    plugged[:] = [BUILT_IN]
    assert cli.main(["devices"]) == 3
    out, err = capsys.readouterr()
    assert err.startswith("edge-sr: no adapter found") and "both plugs" in err and "dmesg" in err and "dialout" in err
    assert out.splitlines()[0] == "/dev/ttyS0" and out.splitlines()[-1] == HINT
    twin = GRIPPER._replace(path="/dev/ttyUSB72", interface="1.1")
    master, slave = os.openpty()
    held = BUILT_IN._replace(path=os.ttyname(slave))
    plugged[:] = [held, GRIPPER, twin, VSCOM._replace(path="/dev/ttyUSB9")]
    gs_usb[:] = [
        GsUsbDevice(1, 4, (0x1D50, 0x606F), "004B", "candleLight"),
        GsUsbDevice(1, 5, (0x1D50, 0x606F), None, None),
        GsUsbDevice(2, 4, (0x1D50, 0x606F), "0001", "candleLight", "2-1.4"),
        GsUsbDevice(2, 5, (0x1D50, 0x606F), "0001", "candleLight", "2-3"),
    ]
    make_network(tmp_path, "can0", up=False, driver="gs_usb")
    make_network(tmp_path, "can1", up=True, driver="peak_usb")
    make_network(tmp_path, "slcan0", up=False)
    make_network(tmp_path, "eth0", up=True, kind="1")
    with subprocess.Popen(["sleep", "60"], stdin=slave) as holder:
        assert cli.main(["devices"]) == 0
        holder.kill()
    out, err = capsys.readouterr()
    blocks = [line for line in out.splitlines() if not line.startswith(" ")]
    assert blocks == [
        *("/dev/ttyUSB9  0403:6015  serial D30BL366", "bus 1 device 4  1d50:606f  serial 004B"),
        *("bus 1 device 5  1d50:606f", "bus 2 device 4 at 2-1.4  1d50:606f  serial 0001"),
        *("bus 2 device 5 at 2-3  1d50:606f  serial 0001", "can0", "can1", "slcan0", held.path),
        *("/dev/ttyUSB71  0403:6015  serial GRIP1", "/dev/ttyUSB72  0403:6015  serial GRIP1", HINT),
    ]
    assert "  looks like VScom USB-CAN Plus\n  --source slcan:serial=D30BL366\n" in out
    shared = "  FT231X USB UART by FTDI: no known adapter\n  --source slcan:{}\n  ! no permission: "
    assert shared.format(GRIPPER.path) in out and shared.format(twin.path) in out and "dialout" in out
    down = "  ! is down: sudo ip link set"
    assert f"gs_usb\n  --source can:socketcan:can0\n{down} can0 up type can bitrate 1000000 restart-ms 100\n" in out
    assert "  --source can:socketcan:can1\nslcan0\n" in out
    assert f"slcand\n  --source can:socketcan:slcan0\n{down} slcan0 up\n" in out
    alone = f"  n/a: no known adapter\n  --source slcan:{held.path}\n"
    assert f"{alone}  ! held by sleep ({holder.pid}): end it first\n/dev/ttyUSB71" in out
    assert "  looks like candleLight\n  --source gs_usb:004B\n" in out
    assert "  --source gs_usb:2-1.4\n" in out and "  --source gs_usb:2-3\n" in out
    assert "  --source gs_usb\n  ! no permission: " in out and "udev" in out and err == ""
    fail = Mock(side_effect=DeviceError(why := "libusb cannot be loaded: pip install libusb-package"))
    monkeypatch.setattr(gs_usb_link, "gs_usb_devices", fail)
    assert cli.main(["devices"]) == 0
    hidden = capsys.readouterr().out
    assert f"{alone}/dev/ttyUSB71" in hidden and hidden.splitlines()[-2:] == [why, HINT]
    os.close(master), os.close(slave)


def counted(said):
    """Return what a link counts of the lines that another device sends over and over."""
    stages = SlcanScans()
    for time_ns in range(0, 100_000_000, 1_000_000):
        assert stages.feed(said, time_ns) == []
    return stages.counters() | {"received_bytes": 100 * len(said)}


@pytest.mark.parametrize(
    ("counters", "words"),
    [
        (counted(b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,*47\n"), r"only .*skipped_bytes \d+.* line speed"),
        (counted(b"t1238AABBCCDDEEFF0011\r"), r"only .*frames 100.*--id-map"),
        ({"messages": 5, "welcomes": 1, "without_readings": 4}, "without_readings 4 came: .* name no sensor"),
        ({"messages": 9, "without_readings": 1, "bad_json": 8}, "came: messages are no JSON"),
        ({"received_bytes": 240, "status_answers": 60}, "only received_bytes 240 came: .* powered .*edge-sr doctor"),
        ({"frames": 0, "error_frames": 7}, "only error_frames 7 came: .* 1 Mbit/s"),
        ({"frames": 0, "error_frames": 0, "fd_frames": 7}, "only fd_frames 7 came: another device, of CAN FD"),
    ],
)
def test_what_came_goes_before_advice(counters, words):
    hint = silence_hint(["xela-server:robot"], lambda: counters)
    assert re.search(words, hint)
