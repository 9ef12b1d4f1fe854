"""Counters of a link that another thread asks for while a piece is decoded."""

import threading
from contextlib import contextmanager

import can
import pytest
from bridge_samples import make_recording
from gs_usb_samples import frames_of, opened
from xela_server_emulator import ServerEmulator
from xela_server_model import VendorServer

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.links.xela_server import XelaServerLink


@contextmanager
def serial():
    with Emulator([make_recording(20)]) as emulator, SlcanSerialLink(emulator.port) as link:
        yield link


@contextmanager
def gs_usb():
    port, link = opened()
    with link:
        for number, frame in enumerate(frames_of(2)):
            port.adapter.hear(frame, stamp_us=130 * number)
        yield link


@contextmanager
def python_can():
    with (
        can.Bus(interface="virtual", channel="counted", ignore_config=True, preserve_timestamps=True) as bus,
        CanBusLink("virtual", "counted") as link,
    ):
        for frame in frames_of(2):
            bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))
        yield link


@contextmanager
def server():
    with ServerEmulator(VendorServer([make_recording(20)])) as emulator, XelaServerLink(emulator.url) as link:
        yield link


@pytest.mark.parametrize("opening", [serial, gs_usb, python_can, server])
def test_they_are_of_whole_pieces(opening):
    """Else what a reader of the counters adds up would not fit together, though nothing was lost."""
    asked = []
    with opening() as link:
        feed, whole = link._scans.feed, {}

        def feed_and_be_asked(*piece):
            other = threading.Thread(target=lambda: asked.append(link.counters()))
            other.start()
            other.join(0.1)  # a thread that need not wait for the piece is done by then
            scans = feed(*piece)
            whole[other] = len(asked)
            link._scans.feed = feed
            return scans

        link._scans.feed = feed_and_be_asked
        while not whole:
            link.read(1.0)
        (other,) = whole
        other.join()
        assert whole[other] == 0, "it was answered in the middle of a piece"


@pytest.mark.parametrize("opening", [serial, gs_usb, python_can])
def test_they_wait_while_a_link_begins_anew(opening):
    """It moves readings from those that wait to those that are abandoned."""
    asked = []
    with opening() as link:
        begin_anew, early = link._scans.begin_anew, []

        def begin_and_be_asked():
            other = threading.Thread(target=lambda: asked.append(link.counters()))
            other.start()
            other.join(0.1)  # a thread that need not wait is done by then
            early.append(len(asked))
            begin_anew()

        link.__exit__(None, None, None)
        link._scans.begin_anew = begin_and_be_asked
        link.__enter__()
        link._scans.begin_anew = begin_anew
    assert early == [0], "it was answered in the middle"
