"""Opening of gs_usb adapters: listing, choosing, refusals and errors of USB."""

import sys

import gs_usb_emulator
import pytest
from gs_usb_adapter import CANDLELIGHT, GsUsbAdapter
from gs_usb_emulator import GsUsbBackend, GsUsbPort
from gs_usb_samples import opened
from usb.backend import libusb1

from firmware_bridge.errors import DeviceError, NoDeviceError
from firmware_bridge.links import gs_usb_devices
from firmware_bridge.links.gs_usb_devices import gs_usb_devices as list_devices
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.scans.can_id_maps import trigger_frame


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


def test_only_one_may_go_unnamed():
    backend = GsUsbBackend(GsUsbPort(serial_number="AB"), GsUsbPort(serial_number="CD"))
    with pytest.raises(NoDeviceError, match=r"2 gs_usb adapters found: .*--source gs_usb:AB.*serial=CD"):
        GsUsbLink(backend=backend).__enter__()
    with GsUsbLink("CD", backend=backend):
        assert [port.adapter.started for port in backend.ports] == [False, True]


def test_of_two_with_one_serial_number_each_is_named_by_its_place():
    """And the one that is left is not taken for the other, whichever way they are plugged in again."""
    left, right = (GsUsbPort(serial_number="AB", sockets=sockets) for sockets in ((2,), (1, 3)))
    backend = GsUsbBackend(left, right)
    for wanted in (None, "AB"):
        with pytest.raises(NoDeviceError, match=r"2 gs_usb adapter.*--source gs_usb:1-2\b"):
            GsUsbLink(wanted, backend=backend).__enter__()
    links = [GsUsbLink(place, backend=backend) for place in ("1-2", "1-1.3")]
    for link, port, other in ((links[0], left, right), (links[1], right, left)):
        with link:
            assert link.name in ("gs_usb:1-2", "gs_usb:1-1.3")
            assert port.adapter.started and not other.adapter.started
    left.adapter.unplug()
    with pytest.raises(NoDeviceError, match=r"no gs_usb adapter at 1-2: .* at 1-1\.3"):
        links[0].__enter__()


def test_a_serial_number_that_was_seen_twice_identifies_nothing_any_more():
    known, other = (GsUsbPort(serial_number="AB", sockets=(socket,)) for socket in (2, 3))
    backend = GsUsbBackend(known)
    link = GsUsbLink("AB", backend=backend)
    with link:
        pass
    backend.ports.append(other)
    with link:
        assert known.adapter.started
    known.adapter.unplug()
    with pytest.raises(NoDeviceError, match="others have the same: plug it in where it was, at 1-2"):
        link.__enter__()
    known.plug()
    with link:
        assert known.adapter.started and not other.adapter.started


def test_none_or_another():
    backend = GsUsbBackend(GsUsbPort(usb_id=(1, 1)))
    with pytest.raises(NoDeviceError, match=r"no gs_usb adapter found: .* seen: none"):
        GsUsbLink(backend=backend).__enter__()
    with pytest.raises(NoDeviceError, match=r"no gs_usb adapter with serial number XY, .*serial=0039"):
        GsUsbLink("XY", backend=GsUsbBackend()).__enter__()


@pytest.mark.parametrize("serial_number", [None, "AB"])
def test_no_permission_gives_the_rule_to_write(serial_number):
    port, _ = opened(GsUsbPort(serial_number="AB"))
    port.permitted = False
    with pytest.raises(DeviceError, match=r'idVendor}=="1d50".*udev/rules.d'):
        GsUsbLink(serial_number, backend=GsUsbBackend(port)).__enter__()


def test_in_use():
    port, link = opened()
    with link, pytest.raises(DeviceError, match=r"in use: .*can0 down"):
        GsUsbLink(backend=GsUsbBackend(port)).__enter__()


def test_a_controller_that_cannot_do_1_mbit():
    limits = CANDLELIGHT._replace(clock_hz=8_500_000)
    port, link = opened(GsUsbPort(lambda: GsUsbAdapter(limits)))
    port.kernel_driver = True
    with pytest.raises(DeviceError, match="cannot do 1 Mbit/s"):
        link.__enter__()
    assert port.kernel_driver and not port.claimed


def test_an_adapter_that_does_not_answer(monkeypatch):
    def request_out(adapter, number, payload):
        raise gs_usb_emulator._error(gs_usb_emulator.TIMEOUT)

    monkeypatch.setattr(GsUsbAdapter, "request_out", request_out)
    with pytest.raises(DeviceError, match="does not answer: unplug it"):
        opened()[1].__enter__()


def test_a_device_that_answers_something_else(monkeypatch):
    monkeypatch.setattr(GsUsbAdapter, "request_in", lambda adapter, number: b"no")
    with pytest.raises(DeviceError, match="2 bytes, expected 12"):
        opened()[1].__enter__()


def test_a_trigger_that_does_not_go_out(monkeypatch):
    monkeypatch.setattr(GsUsbAdapter, "take", lambda adapter, data: False)
    with pytest.raises(DeviceError, match="does not answer"):
        opened(triggers=[trigger_frame(1)])[1].__enter__()


def test_usb_that_cannot_be_read(monkeypatch):
    def enumerate_devices(backend):
        raise gs_usb_emulator._error(gs_usb_emulator.ACCESS)

    monkeypatch.setattr(GsUsbBackend, "enumerate_devices", enumerate_devices)
    with pytest.raises(DeviceError, match="USB cannot be read"):
        list_devices(GsUsbBackend())


def test_no_libusb(monkeypatch):
    import libusb_package

    monkeypatch.setattr(libusb_package, "get_libusb1_backend", lambda: None)
    with pytest.raises(DeviceError, match="libusb cannot be loaded: pip install libusb-package"):
        gs_usb_devices.usb_backend()


def test_without_the_package_the_systems_libusb_is_taken(monkeypatch):
    backend = GsUsbBackend()
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    monkeypatch.setattr(libusb1, "get_backend", lambda: backend)
    assert gs_usb_devices.usb_backend() is backend


def test_the_libusb_of_the_package_works_here():
    assert isinstance(list_devices(), list)
