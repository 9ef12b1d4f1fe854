"""The gs_usb link: the real pyusb above pretended USB."""

import errno
import threading
import time

import gs_usb_emulator
import pytest
import usb.core
from bridge_samples import make_counts, read_scans
from gs_usb_adapter import CANDLELIGHT, QUEUE_FRAMES, GsUsbAdapter
from gs_usb_emulator import GsUsbBackend, GsUsbPort
from gs_usb_samples import frames_of, opened

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.errors import LinkLostError, NoDeviceError
from firmware_bridge.links import gs_usb_link
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP, trigger_frame, trigger_frames
from firmware_bridge.scans.slcan_scans import SlcanScans


def feed_slowly(adapter, frames):
    """A bus that waits while the adapter's queue is nearly full, so that nothing is lost on a slow machine."""
    for number, frame in enumerate(frames):
        while adapter.waiting_frames > QUEUE_FRAMES // 2:
            if not adapter.plugged:
                return
            threading.Event().wait(0.0005)
        adapter.bus_ns = 130_000 * number
        adapter.hear(frame, stamp_us=130 * number)  # of a bus that has no pauses, whatever this machine does


def test_the_same_scans_as_over_slcan():
    frames = [frame for pair in zip(frames_of(50), frames_of(50, controller=6, seed=1), strict=True) for frame in pair]
    del frames[700:703], frames[100]
    frames.insert(40, frames[39])
    expected = SlcanScans().feed(b"".join(map(encode_frame, frames)), 0)
    port, link = opened()
    with link:
        bus = threading.Thread(target=feed_slowly, args=(port.adapter, frames), daemon=True)
        bus.start()
        scans = read_scans(link, len(expected))
        bus.join()
        assert link.read(0.01) == []
        counters = link.counters()
    assert len(scans) == len(expected) >= 95
    for scan, other in zip(scans, expected, strict=True):
        assert (scan.sensor, scan.number) == (other.sensor, other.number)
        assert (scan.counts == other.counts).all() and (scan.renewed == other.renewed).all()
        assert scan.device_ns is not None and scan.device_ns <= scan.time_ns
    assert port.adapter.lost_frames == 0
    assert counters["frames"] == counters["transfers"] == len(frames) and counters["duplicates"] == 1
    assert counters["received_bytes"] == 24 * len(frames) and counters["skipped_bytes"] == 0


def test_thousands_of_frames_come_without_loss():
    port = GsUsbPort()
    port.adapter.bus_ns = 0
    _, link = opened(port, clock_ns=lambda: port.adapter.bus_ns)  # as fast as the bus, or its stamps were no clock
    frames = frames_of(400)
    with link:
        bus = threading.Thread(target=feed_slowly, args=(port.adapter, frames), daemon=True)
        bus.start()
        scans = read_scans(link, 400)
        bus.join()
    assert [scan.number for scan in scans] == list(range(400)) and all(scan.complete for scan in scans)


@pytest.mark.parametrize("packet_bytes", [24, 32, 64, 512])
def test_a_scan_comes_with_its_last_frame(packet_bytes):
    port, link = opened(GsUsbPort(packet_bytes=packet_bytes))
    with link:
        port.adapter.hear(*frames_of(1)[:15], stamp_us=1000)
        assert link.read(0.0) == [] == link.read(0.01)
        port.adapter.hear(frames_of(1)[15], stamp_us=2000)
        (scan,) = link.read(10.0)
        assert scan.complete


def test_an_adapter_without_time_stamps():
    limits = CANDLELIGHT._replace(features=0x03)
    port, link = opened(GsUsbPort(lambda: GsUsbAdapter(limits)))
    with link:
        port.adapter.hear(*frames_of(1))
        (scan,) = read_scans(link, 1)
        assert scan.complete and scan.device_ns is None
        assert link.counters()["received_bytes"] == 20 * 16


def test_the_time_of_the_device_is_what_it_says():
    clock_ns = [10**12]
    port, link = opened(clock_ns=lambda: clock_ns[0])
    with link:
        for start_us in (0xFFFFFF00, 0xFFFFFF00 + 10_000):  # the second after the wrap
            for number, frame in enumerate(frames_of(1)):
                port.adapter.hear(frame, stamp_us=start_us + 130 * number)
                clock_ns[0] += 130_000 + 2_000_000 * (number == 15)
                scans = link.read(0.0)
            (scan,) = scans
            assert scan.device_ns is not None
            clock_ns[0] += 10_000_000 - 16 * 130_000 - 2_000_000
        assert scan.time_ns - scan.device_ns == 2_000_000


# What goes wrong while it runs.


@pytest.mark.parametrize("code", [gs_usb_emulator.NO_DEVICE, gs_usb_emulator.IO, gs_usb_emulator.PIPE])
def test_unplugging_is_seen_within_one_read(code):
    port, link = opened()
    port.gone_as = code
    with link:
        puller = threading.Timer(0.05, port.adapter.unplug)
        puller.start()
        with pytest.raises(LinkLostError, match="gs_usb: link lost") as lost:
            link.read(100.0)
        puller.join()
        assert isinstance(lost.value, ConnectionError)
        with pytest.raises(LinkLostError):
            link.read(100.0)


def test_what_came_before_the_unplugging_is_not_lost(monkeypatch):
    port, link = opened()
    with link:
        port.adapter.hear(*frames_of(1))
        fetch = port.adapter.fetch
        fetched = []

        def last_fetch(timeout_s):
            fetched.append(fetch(timeout_s))
            if len(fetched) == 16:
                port.adapter.unplug()
            return fetched[-1]

        monkeypatch.setattr(port.adapter, "fetch", last_fetch)
        (scan,) = link.read(10.0)
        assert scan.complete
        with pytest.raises(LinkLostError):
            link.read(10.0)


def test_a_silent_adapter_is_only_silent():
    _, link = opened()
    with link:
        assert link.read(0.0) == []
        assert [link.read(0.001) for _ in range(20)] == [[]] * 20
        assert link.trouble is None


def test_a_signal_is_not_an_unplugging(monkeypatch):
    port, link = opened()
    with link:
        port.adapter.hear(*frames_of(1))
        read = GsUsbBackend.bulk_read
        interrupted = []

        def bulk_read(*arguments):
            if not interrupted:
                interrupted.append(True)
                raise usb.core.USBError("interrupted", -10, errno.EINTR)
            return read(*arguments)

        monkeypatch.setattr(GsUsbBackend, "bulk_read", bulk_read)
        assert len(link.read(10.0)) == 1


def test_lost_frames_are_counted_and_told():
    port, link = opened()
    frames = frames_of(6)
    with link:
        port.adapter.hear(*frames[:80])
        assert port.adapter.lost_frames == 80 - QUEUE_FRAMES - 1
        assert len(read_scans(link, 4)) == 4
        link.read(0.0)
        assert link.trouble is None, "the flag is on the next frame"
        port.adapter.hear(frames[80])
        link.read(0.0)
        assert link.counters()["overflows"] == 1 and "lost frames" in (link.trouble or "")


def test_what_the_controller_reports():
    port, link = opened()
    with link:
        port.adapter.report(0x40)
        link.read(0.0)
        assert "bus-off" in (link.trouble or "")
        port.adapter.hear(frames_of(1)[0])
        link.read(0.0)
        assert link.trouble is None and link.counters()["bus_off"] == 1
        port.adapter.report(0x40)
        link.read(0.0)
    with link:
        link.read(0.0)
        assert link.trouble is None, "it began anew"


def test_frames_of_another_channel_are_none_of_ours():
    port, link = opened(GsUsbPort(lambda: GsUsbAdapter(channels=2)))
    with link:
        port.adapter.hear(*frames_of(1), channel=1)
        port.adapter.hear(*frames_of(1, seed=5))
        (scan,) = link.read(10.0)
        assert scan.whole
        assert link.counters()["other_channels"] == 16


# Opening and closing.


def test_it_stops_what_it_started_and_gives_everything_back():
    port, link = opened()
    port.kernel_driver = True
    with link as entered:
        assert entered is link
        assert port.adapter.started and port.adapter.right_bitrate and port.claimed and not port.kernel_driver
    assert not port.adapter.started and not port.claimed and port.kernel_driver and port.handles == 0
    link.__exit__(None, None, None)


def test_a_driver_that_was_not_there_is_not_brought_in():
    port, link = opened()
    with link:
        pass
    assert not port.kernel_driver


def test_what_is_older_than_the_opening_is_dropped_and_the_adapter_is_not_mute():
    """An earlier client died: the channel runs, the queue is full, and a frame waits in the endpoint."""
    port, link = opened()
    with link:
        pass
    port.adapter.started = True
    port.adapter.hear(*frames_of(5, seed=9))
    new = frames_of(1)
    with link:
        port.adapter.hear(*new)
        (scan,) = read_scans(link, 1)
        assert (scan.counts == SlcanScans().feed(b"".join(map(encode_frame, new)), 0)[0].counts).all()
        port.adapter.hear(*frames_of(2))
    port.adapter.reset_usb()  # as the next client may do
    assert not port.adapter.mute


def test_an_adapter_that_goes_on_sending_does_not_hold_up_opening(monkeypatch):
    monkeypatch.setattr(gs_usb_link, "MOST_OLD_TRANSFERS", 20)
    monkeypatch.setattr(GsUsbBackend, "bulk_read", lambda *_: 24)
    _, link = opened()
    with link:
        pass


def test_any_number_of_times_and_after_plugging_in_again():
    port, link = opened()
    other = GsUsbPort(serial_number="OTHER")
    assert link._backend is not None
    for round_number in range(4):
        with link:
            port.adapter.hear(*frames_of(1, seed=round_number))
            (scan,) = read_scans(link, 1)
            assert scan.number == round_number
            port.adapter.unplug()
            with pytest.raises(LinkLostError):
                link.read(10.0)
        with pytest.raises(NoDeviceError, match=f"no gs_usb adapter with serial number {port.serial_number}"):
            link.__enter__()
        link._backend.ports = [other, port]  # now there are two: it is the one it knows
        port.plug()
    assert link.serial_number == port.serial_number and not other.adapter.started


def test_it_comes_back_by_itself():
    port, link = opened()
    lasting = LastingLink(link)
    with lasting:
        port.adapter.hear(*frames_of(1))
        read_scans(lasting, 1)
        port.adapter.unplug()
        assert lasting.read(10.0) == []
        port.plug()
        while not port.adapter.started:
            lasting.read(0.05)
        port.adapter.hear(*frames_of(1, seed=3))
        assert read_scans(lasting, 1)[0].number == 1
        assert [notice.kind for notice in lasting.notices()] == ["lost", "back"]


def test_half_a_scan_is_forgotten_with_the_link():
    port, link = opened()
    frames = frames_of(3)
    with link:
        port.adapter.hear(*frames[:8])
        assert [link.read(0.0) for _ in range(8)] == [[]] * 8
    with link:
        port.adapter.hear(*frames[24:])
        (scan,) = link.read(10.0)
        assert (scan.counts == make_counts(3)[2]).all()
        assert link.counters()["abandoned"] == link.counters()["resynchronised"] == 8


def test_triggers_wake_older_controllers():
    port, link = opened(model=LAYOUT_A_MAP, triggers=trigger_frames(LAYOUT_A_MAP))
    with link:
        assert port.adapter.sent == [trigger_frame(board) for board in range(1, 8)]
        port.adapter.hear(*[CanFrame(0x710 + taxel, bytes((0, 0, 1, 0, 2, 0, 3, 0))) for taxel in range(16)])
        (scan,) = read_scans(link, 1)
        assert scan.sensor == "1" and scan.complete
        assert link.counters()["echoes"] == 7 and link.counters()["foreign"] == 0


def test_a_link_that_is_not_open():
    link = GsUsbLink()
    with pytest.raises(ValueError, match="with statement"):
        link.read(0.1)
    link.__exit__(None, None, None)


def test_closing_what_is_gone():
    port, link = opened()
    with link:
        port.adapter.unplug()


def test_what_it_says_about_itself():
    assert (GsUsbLink().name, GsUsbLink("AB").name) == ("gs_usb", "gs_usb:AB")
    assert (GsUsbLink().kind, GsUsbLink().ended) == ("device", False)


def test_a_short_packet_ends_a_transfer():
    port, link = opened()
    frames = frames_of(3)
    with link:
        fetched, cut = port.adapter.fetch, iter(range(48))

        def fetch_cut_short(timeout_s):
            data = fetched(timeout_s)
            return data if data is None or next(cut) != 20 else data[:13]

        port.adapter.fetch = fetch_cut_short
        for number, frame in enumerate(frames):
            port.adapter.hear(frame, stamp_us=10_000 * (number // 16) + 130 * (number % 16))
        scans = read_scans(link, 3)
        assert [int(scan.fresh.sum()) for scan in scans] == [16, 15, 16]
        assert link.counters()["skipped_bytes"] == 13 and link.counters()["bus_off"] == 0


def test_what_came_while_the_reader_stood_still_after_a_wait_is_marked_old():
    port, link = opened()
    with link:
        fetched = port.adapter.fetch

        def fetch_and_stand_still(timeout_s):
            data = fetched(timeout_s)
            port.adapter.hear(*frames_of(1))
            time.sleep(0.1)
            return data

        port.adapter.fetch = fetch_and_stand_still
        assert link.read(0.0) == []
        port.adapter.fetch = fetched
        (scan,) = read_scans(link, 1)
        assert scan.unread_ns > 80_000_000


@pytest.mark.parametrize("features", [0x03, CANDLELIGHT.features])
def test_what_lay_there_because_nobody_read_is_marked_old(features):
    port, link = opened(GsUsbPort(lambda: GsUsbAdapter(CANDLELIGHT._replace(features=features))))
    with link:
        port.adapter.hear(*frames_of(2))
        time.sleep(0.6)
        first, second = read_scans(link, 2)
        assert first.unread_ns > 500_000_000 < second.unread_ns
        assert link.read(0.0) == []
        port.adapter.hear(*frames_of(1, seed=1))
        assert [scan.unread_ns for scan in read_scans(link, 1)] == [0]
