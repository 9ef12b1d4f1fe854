"""The python-can link: its clocks, its bus errors, and what is refused at its opening."""

import itertools
import sys
import threading
from functools import partial
from math import inf

import can
import pytest
from bridge_samples import frames_of
from can.interfaces.virtual import VirtualBus
from link_rigs import PulledBus, make_network, message_of

from firmware_bridge.errors import DeviceError, SourceError
from firmware_bridge.links import can_bus
from firmware_bridge.links.base import LinkReader
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.discovery import can_interfaces, can_networks


@pytest.fixture
def bus(tmp_path):
    """Somebody else on the virtual network of this test."""
    with VirtualBus(channel=tmp_path.name, preserve_timestamps=True) as bus:
        yield bus


def link_to(bus, **settings):
    return CanBusLink("virtual", bus.channel_id, **settings)


def error_message(classes, *data):
    return can.Message(arbitration_id=classes, data=bytes(data), is_error_frame=True, is_extended_id=False)


BUS_OFF, PASSIVE = error_message(0x40), error_message(4, 0, 0x10)
FRAME = message_of(frames_of(1)[0])


def test_frames_without_stamps_frames_of_fd_and_unknown_errors(bus):
    now_ns = itertools.count(5 * 10**12, 1_000_000)  # a machine that pauses here must make no pause on the bus
    with link_to(bus, clock_ns=now_ns.__next__) as link:
        for message in (message_of(frames_of(1)[0], is_fd=True), BUS_OFF, *map(message_of, frames_of(1))):
            bus.send(message)
        (scan,) = (scan for _ in range(18) for scan in link.read(0.0))
        assert scan.complete and scan.device_ns is None
        counters = link.counters()
        assert (counters["fd_frames"], counters["readings"]) == (1, 16)
        assert (counters["error_frames"], counters["bus_off"]) == (1, 0)


def test_stamps_that_count_from_the_opening_make_nothing_old(bus):
    """Those after an outage may lie ahead of the earlier ones by any time."""
    now_ns = [5 * 10**12]
    link = link_to(bus, clock_ns=lambda: now_ns[0])
    for opened_us in (1000, 2_000_000, 10**9):
        with link:
            for frame in frames_of(1, seed=opened_us):
                bus.send(message_of(frame, timestamp=opened_us / 1e6))
            (scan,) = (scan for _ in range(16) for scan in link.read(0.0))
            assert scan.not_before_ns == scan.time_ns
        now_ns[0] += 9 * 10**9


@pytest.fixture
def opens(monkeypatch):
    return partial(monkeypatch.setattr, can, "Bus")


@pytest.fixture
def networks(monkeypatch, tmp_path):
    monkeypatch.setattr(can_bus, "can_networks", partial(can_networks, tmp_path))
    return tmp_path


@pytest.fixture
def lasting(bus, networks, opens):
    """Link of socketcan that is opened again when it is silent, over the virtual bus, on a clock of its own."""
    now_ns, plugged = [10**12], threading.Event()
    plugged.set()
    make_network(networks, "can0", up=True)
    opens(lambda **_: PulledBus(plugged, channel=bus.channel_id))
    inner = CanBusLink("socketcan", "can0", clock_ns=lambda: now_ns[0])
    with LinkReader(inner, inf, clock_ns=lambda: now_ns[0], sleep=lambda _: None) as link:

        def read(*messages, cable=True):
            """Read messages, then let a second pass without any, and read again."""
            plugged.set() if cable else plugged.clear()
            for message in messages:
                bus.send(message)
                link.read(0.0)
            now_ns[0] += 10**9
            for _ in range(2):
                link.read(0.0)
            return link

        yield read


@pytest.mark.parametrize(("told", "words"), [([BUS_OFF], "bus-off"), ([PASSIVE, FRAME], "passive")])
def test_a_bus_that_is_off_stays_so_however_often_it_is_opened(lasting, told, words):
    """The kernel reports it once, to the sockets that are open then. A passive controller still hears frames."""
    link = lasting(*told)
    for _ in range(3):
        assert words in (lasting().link.trouble or "")
    counters = link.counters()
    assert counters["reopenings"] >= 3 and counters["bus_off"] + counters["error_passive"] == 1
    assert lasting(FRAME).link.trouble is None, "what told that it is over may have come meanwhile"
    assert words in (lasting(*told).link.trouble or "")
    for _ in range(3):
        lasting(cable=False)
    lasting()
    assert lasting().link.trouble is None, "a network that was down begins anew"


def test_a_bus_that_says_it_is_off(bus, monkeypatch):
    monkeypatch.setattr(VirtualBus, "state", can.BusState.ERROR)
    link = link_to(bus)
    with link:
        for _ in range(3):
            link.read(0.001)
        assert link.counters()["bus_off"] == 1 and "bus-off" in (link.trouble or "")
    monkeypatch.undo()
    with link:
        link.read(0.0)
        assert link.trouble is None, "it began anew"


FILTERS = {"can_filters": [{"can_id": 0, "can_mask": 0, "extended": False}]}


@pytest.mark.parametrize(
    ("interface", "channel", "kind", "settings"),
    [
        ("kvaser", "0", "device", {"channel": 0, "bitrate": 1_000_000}),
        ("pcan", "PCAN_USBBUS1", "device", {"channel": "PCAN_USBBUS1", "bitrate": 1_000_000}),
        ("udp_multicast", "239.74.163.2", "emulated", {"channel": "239.74.163.2"}),
        ("socketcan", "can0", "device", {"channel": "can0"} | FILTERS),
        ("socketcan", "vcan0", "emulated", {"channel": "vcan0"} | FILTERS),
    ],
)
def test_what_python_can_is_asked_for_and_what_is_emulated(opens, networks, interface, channel, kind, settings):
    asked = []
    for name in ("can0", "vcan0"):
        make_network(networks, name, up=True)
    opens(lambda **settings: asked.append(settings))
    link = CanBusLink(interface, channel)
    link.__enter__()
    assert link.kind == kind and asked == [{"interface": interface, "ignore_config": True} | settings]


def test_interfaces_that_are_refused(monkeypatch):
    for interface, words in {
        "slcan": "use slcan:",
        "gs_usb": "use gs_usb:",
        "socketcam": r"expected can:INTERFACE:CHANNEL of (?!.*(slcan|gs_usb)).*kvaser.*pcan.*socketcan.*virtual",
    }.items():
        with pytest.raises(SourceError, match=words):
            CanBusLink(interface, "0")
    for interface in ("pcan", "kvaser", "neovi", "socketcand", "vector"):  # their drivers are not there
        with pytest.raises(DeviceError, match=rf"^can:{interface}:0: cannot be opened"):
            CanBusLink(interface, "0").__enter__()
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(DeviceError, match=r"pip install '.+\[can\]'"):
        CanBusLink("virtual", "x")


def test_a_network_that_is_not_there_or_down(networks):
    make_network(networks, "can0", up=False, driver="gs_usb")
    make_network(networks, "eth0", up=True, kind="1")
    listed = can_interfaces(networks)[0]  # `edge-sr devices` advises the same
    for channel, words in {
        "can0": rf"can0 is down: sudo ip link set can0 up .*{listed.problems[0][-10:]}$",
        "can2": "no CAN network can2: .*seen: can0$",
        "eth0": "no CAN network eth0: .*seen: can0$",
    }.items():
        with pytest.raises(DeviceError, match=words):
            CanBusLink("socketcan", channel).__enter__()
