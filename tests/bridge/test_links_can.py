"""The python-can link: the real library, its virtual bus, and what its other interfaces do."""

import errno
import itertools
import random
import threading
import time
from functools import partial

import can
import pytest
from bridge_samples import make_counts, read_scans

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.xela_controller import scan_frames
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links import can_bus
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP, trigger_frame, trigger_frames
from firmware_bridge.scans.slcan_scans import SlcanScans


def frames_of(scans, controller=4, seed=0):
    noise = random.Random(seed)
    return [frame for counts in make_counts(scans, seed) for frame in scan_frames(counts, controller, noise)]


def message_of(frame, **settings):
    settings = {"is_extended_id": frame.extended, "is_remote_frame": frame.remote} | settings
    return can.Message(arbitration_id=frame.can_id, data=frame.data, **settings)


@pytest.fixture
def bus(request):
    """Somebody else on the virtual network of this test."""
    with can.Bus(interface="virtual", channel=request.node.name, ignore_config=True, preserve_timestamps=True) as bus:
        yield bus


def link_to(bus, **settings):
    return CanBusLink("virtual", bus.channel_id, **settings)


def test_the_same_scans_as_over_slcan(bus):
    frames = [frame for pair in zip(frames_of(50), frames_of(50, controller=6, seed=1), strict=True) for frame in pair]
    del frames[700:703], frames[100]
    frames.insert(40, frames[39])
    frames.insert(300, CanFrame(0x004, bytes(8), extended=True))
    frames.insert(301, CanFrame(0x004, b"", remote=True))
    expected = SlcanScans().feed(b"".join(map(encode_frame, frames)), 0)
    with link_to(bus) as link:
        for number, frame in enumerate(frames):  # a machine that pauses here must make no pause on the bus
            bus.send(message_of(frame, timestamp=1.8e9 + number * 130e-6))
        scans = read_scans(link, len(expected))
        assert link.read(0.01) == []
        counters = link.counters()
    assert len(scans) == len(expected) >= 95
    for scan, other in zip(scans, expected, strict=True):
        assert (scan.sensor, scan.number) == (other.sensor, other.number)
        assert (scan.counts == other.counts).all() and (scan.renewed == other.renewed).all()
        # What lay there for long, on a busy machine, sets no clock.
        assert scan.device_ns <= scan.time_ns if not scan.unread_ns else scan.device_ns is None
    assert (counters["frames"], counters["foreign"], counters["duplicates"]) == (len(frames), 2, 1)


def test_a_scan_comes_with_its_last_frame(bus):
    now_ns = itertools.count(5 * 10**12, 1_000_000)  # a machine that pauses here must make no pause on the bus
    with link_to(bus, clock_ns=now_ns.__next__) as link:
        for frame in frames_of(1)[:15]:
            bus.send(message_of(frame))
        assert [link.read(0.0) for _ in range(15)] == [[]] * 15 and link.read(0.01) == []
        bus.send(message_of(frames_of(1)[15]))
        (scan,) = link.read(100.0)
        assert scan.complete and scan.device_ns is None  # it carries no time


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_step_of_the_wall_clock_does_not_hurt(bus, step_s):
    now_ns = [5 * 10**12]
    with link_to(bus, clock_ns=lambda: now_ns[0]) as link:
        for cycle in range(6):
            for frame in frames_of(1, seed=cycle):
                wall_s = 1.8e9 + cycle * 0.01 + step_s * (cycle >= 3)
                bus.send(message_of(frame, timestamp=wall_s))
            (scan,) = [scan for _ in range(16) for scan in link.read(0.0)]
            assert scan.device_ns is not None and 0 <= scan.time_ns - scan.device_ns < 1_000_000
            now_ns[0] += 10_000_000
        assert link.counters()["clock_restarts"] == (step_s < 0)


@pytest.mark.parametrize("begun_us", [0, 10**9])
def test_a_driver_that_counts_from_its_opening_makes_no_reading_old(bus, begun_us):
    """Count stamps from each opening: those after an outage may lie ahead of the earlier ones by any time."""
    now_ns, delays_ns = [5 * 10**12], []
    link = link_to(bus, clock_ns=lambda: now_ns[0])
    for opened_us in (1000, 2_000_000 + begun_us):
        with link:
            for frame in frames_of(1, seed=opened_us):
                bus.send(message_of(frame, timestamp=opened_us / 1e6))
            (scan,) = [scan for _ in range(16) for scan in link.read(0.0)]
            delays_ns.append(scan.time_ns - scan.not_before_ns)
        now_ns[0] += 9 * 10**9
    assert delays_ns == [0, 0] and link.counters()["clock_restarts"] == 0


def test_the_interface_gone_is_told_at_once_and_every_time(bus):
    with link_to(bus) as link:
        bus.send(message_of(frames_of(1)[0]))
        link.read(0.0)
        link._bus.shutdown()
        for _ in range(2):
            with pytest.raises(LinkLostError, match=r"can:virtual:\S+: link lost, .*closed bus"):
                link.read(100.0)


def test_a_network_that_goes_down_is_told(bus, monkeypatch):
    def recv(timeout):
        raise can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)

    with link_to(bus) as link:
        monkeypatch.setattr(link._bus, "recv", recv)
        with pytest.raises(LinkLostError, match="Network is down"):
            link.read(1.0)


def test_any_number_of_times(bus):
    link = link_to(bus)
    frames = frames_of(3)
    for _ in range(3):
        with link:
            for frame in frames[:8]:
                bus.send(message_of(frame))
            assert [link.read(0.0) for _ in range(8)] == [[]] * 8
        with link:
            for frame in frames[24:]:
                bus.send(message_of(frame))
            (scan,) = read_scans(link, 1)
            assert (scan.counts == make_counts(3)[2]).all()
    link.__exit__(None, None, None)


def test_silence_is_only_silence(bus):
    with link_to(bus) as link:
        assert [link.read(0.001) for _ in range(20)] == [[]] * 20
        assert link.trouble is None


def test_errors_are_counted_and_told(bus):
    with link_to(bus) as link:
        error = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False)
        bus.send(error)
        link.read(0.0)
        counters = link.counters()
        # What another interface than socketcan means by its bits, nobody knows.
        assert (counters["error_frames"], counters["other_errors"], counters["bus_off"]) == (1, 1, 0)
        link._interface = "socketcan"
        bus.send(error)
        link.read(0.0)
        assert link.counters()["bus_off"] == 1 and "bus-off" in (link.trouble or "")
        bus.send(message_of(frames_of(1)[0]))
        link.read(0.0)
        assert link.trouble is None
        bus.send(error)
        link.read(0.0)
    link._interface = "virtual"
    with link:
        link.read(0.0)
        assert link.trouble is None, "it began anew"


def test_a_bus_that_says_it_is_off(bus, monkeypatch):
    with link_to(bus) as link:
        monkeypatch.setattr(type(link._bus), "state", can.BusState.ERROR)
        for _ in range(3):
            link.read(0.001)
        assert link.counters()["bus_off"] == 1 and "bus-off" in (link.trouble or "")


def test_fd_frames_are_none_of_ours(bus):
    with link_to(bus) as link:
        bus.send(message_of(frames_of(1)[0], is_fd=True))
        link.read(0.0)
        assert (link.counters()["fd_frames"], link.counters()["readings"]) == (1, 0)


def test_triggers_wake_older_controllers(bus):
    with link_to(bus, model=LAYOUT_A_MAP, triggers=trigger_frames(LAYOUT_A_MAP)) as link:
        heard = [bus.recv(1.0) for _ in range(7)]
        assert [CanFrame(one.arbitration_id, bytes(one.data), one.is_extended_id) for one in heard if one] == [
            trigger_frame(board) for board in range(1, 8)
        ]
        for taxel in range(16):
            bus.send(message_of(CanFrame(0x710 + taxel, bytes((0, 0, 1, 0, 2, 0, 3, 0)))))
        (scan,) = read_scans(link, 1)
        assert scan.sensor == "1" and scan.complete


def test_triggers_that_do_not_go_out(bus, monkeypatch):
    from can.interfaces.virtual import VirtualBus

    def send(bus, message, timeout=None):
        raise can.CanOperationError("Transmit buffer full")

    monkeypatch.setattr(VirtualBus, "send", send)
    link = link_to(bus, triggers=[trigger_frame(1)])
    with pytest.raises(DeviceError, match="does not send frames: Transmit buffer full"):
        link.__enter__()
    assert len(bus.channel) == 1, "it has left"


def test_a_link_that_is_not_open():
    link = CanBusLink("virtual", "x")
    with pytest.raises(ValueError, match="with statement"):
        link.read(0.1)
    link.__exit__(None, None, None)


@pytest.mark.parametrize(
    ("interface", "channel", "kind"),
    [
        ("virtual", "x", "emulated"),
        ("udp_multicast", "239.74.163.2", "emulated"),
        ("socketcan", "vcan0", "emulated"),
        ("socketcan", "can0", "device"),
        ("pcan", "PCAN_USBBUS1", "device"),
        ("kvaser", "0", "device"),
    ],
)
def test_what_it_says_about_itself(interface, channel, kind):
    link = CanBusLink(interface, channel)
    assert (link.name, link.kind, link.ended) == (f"can:{interface}:{channel}", kind, False)


def error_message(classes, *data):
    return can.Message(arbitration_id=classes, data=bytes(data), is_error_frame=True, is_extended_id=False)


@pytest.fixture
def lasting(bus, monkeypatch):
    """Link of socketcan that is opened again when it is silent, over the virtual bus, on a clock of its own."""
    now_ns = [10**12]
    monkeypatch.setattr(can_bus, "_check_network", lambda name: None)
    link = link_to(bus, clock_ns=lambda: now_ns[0])
    link._interface = "socketcan"
    virtual = partial(can.Bus, interface="virtual", channel=bus.channel_id, ignore_config=True)
    monkeypatch.setattr(link, "_open", virtual)
    with LastingLink(link, clock_ns=lambda: now_ns[0]) as lasting:

        def read(*messages):
            """Read messages, then let a second pass without any, and read again."""
            for message in messages:
                bus.send(message)
                lasting.read(0.0)
            now_ns[0] += 10**9
            for _ in range(2):
                lasting.read(0.0)
            return lasting

        yield read


@pytest.mark.parametrize(("told", "words"), [(error_message(0x40), "bus-off"), (error_message(4, 0, 0x10), "passive")])
def test_a_bus_that_is_off_stays_so_however_often_a_socket_is_opened(lasting, told, words):
    """The kernel reports it once, to the sockets that are open then."""
    for number in range(4):
        link = lasting(told) if number == 0 else lasting()
        assert words in (link.trouble or ""), number
    counters = link.counters()
    assert counters["reopenings"] >= 3 and counters["bus_off"] + counters["error_passive"] == 1
    assert lasting(message_of(frames_of(1)[0])).trouble is None, "what told that it is over may have come meanwhile"


def test_error_passive_goes_on_though_frames_come(lasting):
    link = lasting(error_message(4, 0, 0x10), message_of(frames_of(1)[0]))
    assert "passive" in (link.trouble or "")


def test_a_network_that_was_down_begins_anew(lasting, monkeypatch):
    def recv(timeout):
        raise can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)

    link = lasting(error_message(0x40))
    monkeypatch.setattr(link._link._bus, "recv", recv)
    lasting()
    assert not link._open
    lasting()
    assert lasting().trouble is None and link._open


def test_read_ends_with_the_scan_though_more_time_is_left(bus):
    with link_to(bus) as link:
        frames = frames_of(1)
        sender = threading.Timer(0.02, lambda: [bus.send(message_of(frame)) for frame in frames])
        sender.start()
        (scan,) = link.read(100.0)
        sender.join()
        assert scan.complete


def test_what_came_while_the_reader_stood_still_after_a_wait_is_marked_old(bus, monkeypatch):
    with link_to(bus) as link:
        receive = link._bus.recv

        def stands_still(timeout_s):
            message = receive(timeout_s)
            for frame in frames_of(1):
                bus.send(message_of(frame))
            time.sleep(0.1)
            return message

        with monkeypatch.context() as patched:
            patched.setattr(link._bus, "recv", stands_still)
            assert link.read(0.0) == []
        (scan,) = read_scans(link, 1)
        assert scan.unread_ns > 80_000_000


def test_what_lay_there_because_nobody_read_is_marked_old(bus):
    with link_to(bus) as link:
        for frame in frames_of(2):
            bus.send(message_of(frame))
        time.sleep(0.6)
        first, second = read_scans(link, 2)
        assert first.unread_ns > 500_000_000 < second.unread_ns
        assert link.read(0.0) == []
        for frame in frames_of(1, seed=1):
            bus.send(message_of(frame))
        assert [scan.unread_ns for scan in read_scans(link, 1)] == [0]
