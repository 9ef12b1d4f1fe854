"""The gs_usb link: the real pyusb above pretended USB, which public packages read as well."""

import errno
import sys
from functools import partial
from itertools import count

import pytest
import usb.core
from bridge_samples import frames_of
from gs_usb_emulator import CANDLELIGHT, QUEUE_FRAMES, GsUsbAdapter, GsUsbBackend, GsUsbPort, libusb_error
from usb.backend import libusb1

from firmware_bridge.errors import DeviceError, LinkLostError, NoDeviceError
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.links.gs_usb_link import gs_usb_devices as list_devices
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP


def opened(port=None, **settings):
    backend = GsUsbBackend(port or GsUsbPort())
    return backend.ports[0], GsUsbLink(backend=backend, **settings)


@pytest.mark.parametrize("packet_bytes", [24, 64, 512])
def test_an_adapter_without_time_stamps_and_with_two_channels(packet_bytes):
    limits, now_ns = CANDLELIGHT._replace(features=0x03), [10**12]
    port = GsUsbPort(lambda: GsUsbAdapter(limits), packet_bytes=packet_bytes)
    port, link = opened(port, clock_ns=lambda: now_ns[0])
    with link:
        port.adapter.hear(*frames_of(1), channel=1)
        port.adapter.hear(*frames_of(1, seed=5))
        (scan,) = link.read(10.0)
        assert scan.whole and scan.device_ns is None
        assert (link.counters()["received_bytes"], link.counters()["other_channels"]) == (20 * 32, 16)


class Watched(GsUsbAdapter):
    """Adapter that hands on what `then` makes of each transfer."""

    then = staticmethod(lambda data: data)

    def fetch(self, timeout_s):
        return self.then(super().fetch(timeout_s))


@pytest.mark.parametrize("code", [errno.EIO, errno.EPIPE])
def test_an_unplugging_may_be_another_error_and_a_signal_is_none(code):
    def interrupt(data):
        if signals:
            raise signals.pop()
        return data

    (port, link), signals = opened(GsUsbPort(Watched)), [usb.core.USBError("interrupted", -10, errno.EINTR)]
    port.gone_as = code
    with link:
        port.adapter.then = interrupt
        port.adapter.hear(*frames_of(1)[:1], *frames_of(1), stamp_us=1000)  # the signal takes the first
        assert len(link.read(10.0)) == 1 and not signals
        port.adapter.unplug()
        with pytest.raises(LinkLostError, match="gs_usb: link lost"):
            link.read(100.0)


def test_lost_frames_and_the_state_of_the_controller_are_told():
    port, link = opened()
    frames = frames_of(6)
    with link:
        port.adapter.hear(*frames[:80])
        assert port.adapter.lost_frames == 80 - QUEUE_FRAMES
        while link.counters()["frames"] < QUEUE_FRAMES:
            link.read(0.0)
        assert link.trouble is None, "the flag is on the next frame"
        port.adapter.hear(frames[80])
        link.read(0.0)
        assert link.counters()["overflows"] == 1 and "lost frames" in (link.trouble or "")
        port.adapter.report(0x40)
        link.read(0.0)
        assert link.counters()["bus_off"] == 1 and "bus-off" in (link.trouble or "")
    with link:
        link.read(0.0)
        assert "bus-off" not in (link.trouble or ""), "it began anew"


def test_a_short_packet_ends_a_transfer():
    port, link = opened(GsUsbPort(Watched))
    with link:
        transfers = count(1)
        port.adapter.then = lambda data: data[:13] if data and next(transfers) == 21 else data
        for number, frame in enumerate(frames_of(3)):
            port.adapter.hear(frame, stamp_us=10_000 * (number // 16) + 130 * (number % 16))
        scans = [scan for _ in range(48) for scan in link.read(0.0)]
        assert [int(scan.fresh.sum()) for scan in scans] == [16, 15, 16]
        assert link.counters()["skipped_bytes"] == 13 and link.counters()["bus_off"] == 0


def test_it_stops_what_it_started_and_gives_everything_back():
    port, link = opened()
    for kernel_driver in (True, False):
        port.kernel_driver = kernel_driver
        with link:
            assert port.adapter.started and port.adapter.right_bitrate and port.claimed and not port.kernel_driver
        assert not port.adapter.started and port.kernel_driver == kernel_driver
        assert port.claimed is None and port.handles == 0


def test_what_is_older_than_the_opening_is_dropped():
    """An earlier client died: the channel runs, and the queue is full. A reset while frames wait makes it mute."""
    port, link = opened()
    with link:
        pass
    port.adapter.started = True
    port.adapter.hear(*frames_of(5, seed=9))
    with link:
        port.adapter.hear(*frames_of(1), stamp_us=1000)
        assert len(link.read(10.0)) == 1 and link.counters()["frames"] == 16
        port.adapter.hear(*frames_of(2))
    assert not port.adapter.queue, "the next client may reset it"


def test_the_adapters_of_this_machine():
    foreign = GsUsbPort(usb_id=(0x0403, 0x6015))
    nameless = GsUsbPort(serial_number=None, product=None, usb_id=(0x1209, 0x2323))
    backend = GsUsbBackend(GsUsbPort(serial_number="AB"), foreign, nameless)
    nameless.address = 9
    named, unnamed = list_devices(backend)
    assert str(named) == "bus 1 device 5 at 1-1 1d50:606f serial=AB (candleLight USB to CAN adapter)"
    assert str(unnamed) == "bus 1 device 9 at 1-1 1209:2323 (candleLight)"
    assert list_devices(GsUsbBackend(foreign)) == []
    assert [port.handles for port in backend.ports] == [0, 0, 0]
    assert isinstance(list_devices(), list), "the real libusb"


@pytest.mark.parametrize(
    ("ports", "wanted", "words"),
    [
        ([], None, r"no gs_usb adapter: plug it in, .* seen: none"),
        (["AB"], "XY", r"no gs_usb adapter with serial number XY: .*serial=AB"),
        (["AB", "CD"], None, r"2 gs_usb adapters: .*--source gs_usb:AB.*serial=CD"),
        (["AB", "AB"], None, r"2 gs_usb adapter.*--source gs_usb:1-2\b"),
        (["AB", "AB"], "AB", r"2 gs_usb adapter.*--source gs_usb:1-2\b"),
        (["AB"], "1-5", r"no gs_usb adapter at 1-5: .* at 1-2"),
    ],
)
def test_none_another_or_several(ports, wanted, words):
    plugged = [GsUsbPort(serial_number=name, sockets=(place,)) for place, name in enumerate(ports, 2)]
    with pytest.raises(NoDeviceError, match=words):
        GsUsbLink(wanted, backend=GsUsbBackend(*plugged or [GsUsbPort(usb_id=(1, 1))])).__enter__()


@pytest.mark.parametrize(
    ("wanted", "serial_number", "words"),
    [(None, "OTHER", "no gs_usb adapter with serial number AB: "), ("AB", "AB", "surely the one: .* was, at 1-2")],
)
def test_one_that_was_unplugged_is_told_from_others(wanted, serial_number, words):
    """A serial number that was seen twice identifies nothing."""
    known, other = GsUsbPort(serial_number="AB", sockets=(2,)), GsUsbPort(serial_number=serial_number, sockets=(3,))
    backend = GsUsbBackend(known)
    link = GsUsbLink(wanted, backend=backend)
    with link:
        backend.ports = [other, known]
    with link:
        known.adapter.unplug()
    with pytest.raises(NoDeviceError, match=words):
        link.__enter__()
    known.plug()
    with link:
        assert known.adapter.started and not other.adapter.started


class Deaf(GsUsbAdapter):
    def request_out(self, number, payload):
        raise libusb_error(errno.ETIMEDOUT)


def test_adapters_that_cannot_be_used_are_given_back():
    slow = partial(GsUsbAdapter, CANDLELIGHT._replace(clock_hz=8_500_000))
    for adapter, words in ((slow, "cannot do 1 Mbit/s"), (Deaf, "does not answer: unplug it")):
        port, link = opened(GsUsbPort(adapter), model=LAYOUT_A_MAP)
        port.kernel_driver = True
        with pytest.raises(DeviceError, match=words):
            link.__enter__()
        assert port.kernel_driver and not port.claimed


def test_one_without_permission_or_in_use():
    port, link = opened()
    with link, pytest.raises(DeviceError, match=r"in use: .*can0 down"):
        GsUsbLink(backend=GsUsbBackend(port)).__enter__()
    port.permitted = False
    for wanted in (None, port.serial_number):
        with pytest.raises(DeviceError, match=r'idVendor}=="1d50".*udev/rules.d'):
            GsUsbLink(wanted, backend=GsUsbBackend(port)).__enter__()


@pytest.fixture
def get_backend(monkeypatch):
    return partial(monkeypatch.setattr, libusb1, "get_backend")


def test_usb_that_cannot_be_read_or_without_libusb(get_backend, monkeypatch):
    class Closed(GsUsbBackend):
        def enumerate_devices(self):
            raise libusb_error(errno.EACCES)

    with pytest.raises(DeviceError, match="USB cannot be read"):
        list_devices(Closed())
    backend = GsUsbBackend()
    get_backend(lambda: backend)
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    assert len(list_devices()) == 1, "by the system's"
    get_backend(lambda: None)
    with pytest.raises(DeviceError, match="libusb cannot be loaded: pip install libusb-package"):
        list_devices()
