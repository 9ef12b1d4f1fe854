import errno
import os
import pty
import select
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest
import serial
from bridge_samples import REST_COUNTS, make_recording, read_scans, read_until_lost, stacked
from serial_samples import SilentDevice, wait_for

from firmware_bridge.can import slcan_status
from firmware_bridge.can.slcan import CLOSE, CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links import fd_reader as bursts
from firmware_bridge.links import slcan_serial
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP, USPA44_MAP, trigger_frame
from firmware_bridge.scans.scan import Scan


@pytest.mark.parametrize("acknowledges", [True, False])
@pytest.mark.parametrize("latency_s", [0.001, 0.016])
def test_every_scan_comes_once_and_in_order(acknowledges, latency_s, monkeypatch):
    monkeypatch.setattr(slcan_status, "ADAPTER_ASKED_NS", 60 * 10**9)  # a busy machine makes no silence to ask about
    recordings = [make_recording(60, seed=1), make_recording(60, seed=2)]
    with (
        Emulator(recordings, acknowledges=acknowledges, latency_s=latency_s, jitter_s=0.002) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        scans = read_until_lost(link)
        assert (emulator.lost_frames, link.ended) == (0, False)
        counters = {name: count for name, count in link.counters().items() if count}
    for sensor, recording in zip(("4", "6"), recordings, strict=True):
        mine = [scan for scan in scans if scan.sensor == sensor]
        assert [scan.number for scan in mine] == list(range(60))
        assert (stacked(scans, sensor) == recording.tracks[0].counts).all()
        times = [scan.time_ns for scan in mine]
        assert times == sorted(times)
    # The acknowledgement of the opening is seen; those before it are dropped with what is old.
    lines = 2 * 60 * 16
    expected = {"received_bytes": lines * 26 + acknowledges, "frames": lines, "readings": lines, "scans": 120}
    assert counters == expected | ({"replies": 1, "dropped_bytes": 3} if acknowledges else {})


def test_it_opens_as_adapters_want_it():
    with Emulator([make_recording(5)], loop=True) as emulator:
        with SlcanSerialLink(emulator.port) as link:
            read_scans(link, 3)
            # Closing what is not open is the only command that is refused: no empty one, no second O.
            assert emulator.adapter.refused == 1
        wait_for(lambda: not emulator.adapter.channel_open)


def test_what_it_says_about_itself():
    with Emulator([make_recording(1)]) as emulator:
        link = SlcanSerialLink(emulator.port)
        assert (link.kind, link.name, link.ended) == ("emulated", f"slcan:{emulator.port}", False)
        with link as entered:
            assert entered is link
            assert link.low_latency is False  # a pseudo-terminal has no such mode
    assert SlcanSerialLink("/dev/ttyUSB0").kind == "device"


def test_a_pseudo_terminal_is_known_behind_a_link(tmp_path):
    with Emulator([make_recording(1)]) as emulator:
        (tmp_path / "ttyUSB0").symlink_to(emulator.port)
        assert SlcanSerialLink(str(tmp_path / "ttyUSB0")).kind == "emulated"


def test_opening_late_loses_nothing_of_a_recording():
    recording = make_recording(10)
    with Emulator([recording]) as emulator:
        time.sleep(0.3)
        with SlcanSerialLink(emulator.port) as link:
            assert (stacked(read_until_lost(link)) == recording.tracks[0].counts).all()


def counting_recording(scans: int, rate_hz: float) -> Recording:
    """Return a recording whose counts encode their cycle."""
    counts = REST_COUNTS.astype(np.int32) + np.arange(scans, dtype=np.int32)[:, None, None, None]
    return Recording(Path("counting.csv"), (Track("4", counts, None),), rate_hz)


def cycles_in(scan: Scan) -> set[int]:
    cycles = set((scan.counts - REST_COUNTS)[:, scan.fresh].ravel().tolist())
    assert cycles <= set(range(500)), "a value that no cycle had"
    return cycles


def test_what_is_older_than_the_opening_is_dropped():
    """A client that was killed leaves the channel open, and the kernel keeps what it did not read."""
    recording = counting_recording(400, rate_hz=400)
    with Emulator([recording], left_open=True) as emulator:
        serial.Serial(emulator.port, 3_000_000).close()
        wait_for(lambda: emulator.sent_frames >= 40 * 16)
        old = emulator.sent_frames // 16
        with SlcanSerialLink(emulator.port) as link:
            scans = read_scans(link, 10)
            assert link.counters()["frames"] < (400 - 40) * 16
    assert min(int(number) for scan in scans for number in cycles_in(scan)) >= old


def test_a_reader_that_is_too_slow_gets_no_made_up_scans():
    with Emulator([counting_recording(500, rate_hz=480)]) as emulator, SlcanSerialLink(emulator.port) as link:
        wait_for(lambda: emulator.lost_frames >= 100)
        scans = read_until_lost(link)
        assert link.counters()["frames"] == 500 * 16 - emulator.lost_frames
    assert 100 < len(scans) < 500
    last = -1
    for scan in scans:
        # At most two cycles share a scan, where frames between them were lost; and time never goes back.
        cycles = cycles_in(scan)
        assert len(cycles) <= 2 and min(cycles) >= last and max(cycles) < 500
        last = max(cycles)


def test_two_clients_cannot_share_a_port():
    with (
        Emulator([make_recording(1)]) as emulator,
        SlcanSerialLink(emulator.port),
        pytest.raises(DeviceError, match=r"in use by this program, or .*slcand"),
    ):
        SlcanSerialLink(emulator.port).__enter__()


def test_the_program_that_holds_a_port_is_named_and_so_is_the_one_that_tries_each_new_port():
    hold = "import fcntl, sys; f = open(sys.argv[1], 'r+b', 0); fcntl.flock(f, fcntl.LOCK_EX)"
    held = f"{hold}; print(1, flush=True); input()"
    with Emulator([make_recording(1)]) as emulator:
        process = subprocess.Popen(
            [sys.executable, "-c", held, emulator.port], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        with process:
            assert process.stdout is not None and process.stdin is not None and process.stdout.readline() == b"1\n"
            with pytest.raises(DeviceError, match=rf"in use by \S+ \({process.pid}\): .*ModemManager.*udev rule ATTRS"):
                SlcanSerialLink(emulator.port).__enter__()
            process.stdin.close()
        with SlcanSerialLink(emulator.port) as link:
            assert len(read_scans(link, 1)) == 1


def test_the_wrong_line_speed_gives_no_scan():
    recording = make_recording(20)
    with (
        Emulator([recording], left_open=True, loop=True) as emulator,
        SlcanSerialLink(emulator.port, 115_200) as link,
    ):
        assert [scan for _ in range(5) for scan in link.read(0.1)] == []
        assert link.counters()["frames"] == 0 < link.counters()["received_bytes"]
    with (
        Emulator([recording], ignores_line_speed=True, loop=True) as emulator,
        SlcanSerialLink(emulator.port, 115_200) as link,
    ):
        # So slow a line has no stamps: the pause of a busy machine within a cycle costs that scan, rightly.
        assert all(scan.complete for scan in read_scans(link, 20))


def test_what_lies_there_at_the_end_or_at_an_opening_is_dropped_and_counted():
    line = encode_frame(CanFrame(0x401, bytes(8)))

    def answer(device):
        while CLOSE not in os.read(device.device_fd, 64):
            pass
        os.write(device.device_fd, 2 * line)

    with SilentDevice() as device:
        link = SlcanSerialLink(device.port)
        late = threading.Thread(target=answer, args=[device])
        late.start()
        with link:
            late.join()
            os.write(device.device_fd, 3 * line)
        assert link.counters()["dropped_bytes"] == 5 * len(line)
        assert link.counters()["frames"] == link.counters()["received_bytes"] == 0


def test_the_cable_out_is_told_at_once_and_every_time():
    with Emulator([make_recording(10)], loop=True) as emulator, SlcanSerialLink(emulator.port) as link:
        read_scans(link, 5)
        puller = threading.Timer(0.1, emulator.hang_up)
        puller.start()
        with pytest.raises(LinkLostError, match=f"{emulator.port}: link lost") as lost:
            for _ in range(100):
                link.read(10.0)
        puller.join()
        assert isinstance(lost.value, ConnectionError)
        with pytest.raises(LinkLostError):
            link.read(10.0)


def test_what_came_before_the_loss_is_not_lost(monkeypatch):
    """The last byte may come alone, and the cable go before the next look: it may close a scan."""
    came = [b"\r"]

    def read(descriptor, most_bytes):
        if came:
            return came.pop()
        raise OSError(errno.EIO, "Input/output error")

    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        monkeypatch.setattr(bursts.os, "read", read)
        got = link.read(0.0), link.counters()["received_bytes"], link.counters()["replies"]
        with pytest.raises(LinkLostError):
            link.read(0.0)
        came.append(b"")
        with pytest.raises(LinkLostError, match="hung up"):
            link.read(0.0)
        monkeypatch.undo()
    assert got == ([], 1, 1)


@pytest.mark.parametrize("piece_bytes", [1, 22, 62, 100, 352])
def test_a_scan_comes_with_its_last_byte_however_it_is_cut(piece_bytes, monkeypatch):
    """The same holds after a torn scan, which its own end cannot close.

    Without stamps, a reader that does not run for some milliseconds within a scan splits it: here each arrives at once.
    """
    now_ns = [time.monotonic_ns()]
    monkeypatch.setattr(slcan_serial.time, "monotonic_ns", lambda: now_ns[0])
    lines = [encode_frame(CanFrame(can_id, bytes(8))) for can_id, _ in USPA44_MAP.wire_order("4")]
    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        for sent, complete in ((lines, [True]), (lines[:3] + lines[4:], []), (lines, [False, True]), (lines, [True])):
            text = b"".join(sent)
            now_ns[0] += 10_000_000
            for at in range(0, len(text), piece_bytes):
                os.write(device.device_fd, text[at : at + piece_bytes])
            scans = []
            end_s = time.monotonic() + 60
            while len(scans) < len(complete) and time.monotonic() < end_s:
                scans += link.read(0.1)
            assert [scan.complete for scan in scans] == complete


def test_few_reads_make_a_scan(monkeypatch):
    """A plain loop wakes for every piece that comes; here the kernel gathers them."""
    wakes = []
    poll = select.poll

    class CountedPoll:
        def __init__(self):
            self._poll = poll()
            self.register = self._poll.register

        def poll(self, timeout_ms):
            wakes.append(timeout_ms)
            return self._poll.poll(timeout_ms)

    monkeypatch.setattr(select, "poll", CountedPoll)
    with Emulator([make_recording(60)], latency_s=0.0) as emulator, SlcanSerialLink(emulator.port) as link:
        assert len(read_until_lost(link)) == 60
    assert len(wakes) < 60 * 5, "one for each of sixteen frames"


def test_reading_where_nothing_comes():
    with SilentDevice() as device, SlcanSerialLink(device.port) as link:
        assert link.read(0.0) == []
        assert link.read(0.01) == []


def test_a_link_that_is_not_open():
    link = SlcanSerialLink("/dev/ttyUSB0")
    with pytest.raises(ValueError, match="with statement"):
        link.read(0.1)
    link.__exit__(None, None, None)


def test_opening_again_after_closing():
    with Emulator([make_recording(3)], loop=True) as emulator:
        link = SlcanSerialLink(emulator.port)
        for _ in range(2):
            with link:
                read_scans(link, 2)


def test_opening_again_joins_nothing_to_what_came_before():
    with SilentDevice() as device:
        link = SlcanSerialLink(device.port)
        lines = b"".join(encode_frame(CanFrame(can_id, bytes(8))) for can_id, _ in USPA44_MAP.wire_order("4"))
        for piece in (lines[:100], lines[100:]):
            with link:
                os.write(device.device_fd, piece)
                assert link.read(0.1) == []
        counters = link.counters()
        assert counters["abandoned"] == 4 and counters["skipped_bytes"] > 0


def test_triggers_wake_older_controllers():
    triggers = [trigger_frame(1), trigger_frame(2)]
    with SilentDevice() as device, SlcanSerialLink(device.port, model=LAYOUT_A_MAP, triggers=triggers) as link:
        assert device.received(30) == b"C\rS8\rZ1\rO\rt20120700\rt20220700\r"
        lines = b"".join(b"t%03X8000001000200%02X00\r" % (0x710 + taxel, 3) for taxel in range(16))
        os.write(device.device_fd, lines)
        (scan,) = read_scans(link, 1)
        assert scan.sensor == "1" and scan.complete and set(scan.counts[1].ravel().tolist()) == {2}


@pytest.mark.parametrize("old_canable", [True, False])
def test_what_lay_there_because_nobody_read_is_marked_old(old_canable):
    """Readings without stamps that are seconds old would look new."""
    playing = Emulator([make_recording(50)], loop=True, old_canable=old_canable)
    with playing as emulator, SlcanSerialLink(emulator.port) as link:
        read_scans(link, 20)
        time.sleep(0.6)
        (first, *_) = read_scans(link, 1)
        assert first.unread_ns > 500_000_000
        assert (first.device_ns is None) == old_canable
        end_s = time.monotonic() + 20
        while any(scan.unread_ns for scan in read_scans(link, 1)):
            assert time.monotonic() < end_s


def test_what_lay_there_since_the_opening_is_marked_old_and_sets_no_clock(monkeypatch):
    """Stamps of readings that nobody fetched set the adapter's clock, and by it they were new."""

    def starved(frame):
        time.sleep(0.6)
        return encode_frame(frame)

    playing = Emulator([make_recording(50)], loop=True)
    monkeypatch.setattr(slcan_serial, "encode_frame", starved)
    with playing as emulator, SlcanSerialLink(emulator.port, triggers=[trigger_frame(1)]) as link:
        (first, *_) = read_scans(link, 1)
        assert first.unread_ns > 500_000_000 and first.device_ns is None
        assert first.not_before_ns == first.time_ns - first.unread_ns
        end_s = time.monotonic() + 20
        while any(scan.unread_ns or scan.device_ns is None for scan in read_scans(link, 1)):
            assert time.monotonic() < end_s


def test_a_thread_that_stands_still_after_a_look_takes_the_port_for_empty_no_later(monkeypatch):
    """Otherwise bytes that arrive meanwhile would look new."""
    leader, follower = pty.openpty()
    now_s = [100.0]

    def stands_still(system_call):
        def call(*arguments):
            try:
                return system_call(*arguments)
            finally:
                now_s[0] += 0.5

        return call

    try:
        tty.setraw(follower)
        reader = bursts.BurstReader(follower, clock_s=lambda: now_s[0])
        monkeypatch.setattr(bursts.fcntl, "ioctl", stands_still(bursts.fcntl.ioctl))
        reader.look()
        assert (reader.empty_s, now_s[0]) == (100.0, 100.5)
        monkeypatch.setattr(bursts.os, "read", stands_still(os.read))
        assert reader.read(0, 22) == b""
        assert (reader.empty_s, now_s[0]) == (100.5, 101.0)
        assert reader.take_all() == b""
        assert (reader.empty_s, now_s[0]) == (101.0, 101.5)
    finally:
        monkeypatch.undo()
        os.close(leader)
        os.close(follower)
