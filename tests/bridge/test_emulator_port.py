"""Emulated adapter on a pseudo-terminal, in this process and as a command."""

import contextlib
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
import serial
from bridge_samples import make_counts, make_recording, read_scans, read_until_lost, stacked, write_recording

from firmware_bridge.emulation.robot_main import main
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.slcan_scans import SlcanScans

# The pseudo-terminal.


def open_raw(port: str) -> serial.Serial:
    return serial.Serial(port, 3_000_000, rtscts=True, timeout=0.2)


def test_an_emulator_that_waits_loses_no_frame_by_a_slow_reader():
    with (
        Emulator([make_recording(200, rate_hz=450.0)], jitter_s=0, waits=True) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        time.sleep(0.4)  # the terminal is full after .1 s; nor does it take its lateness for a stop, amid a scan
        scans = read_until_lost(link)
    assert (stacked(scans) == make_counts(200)).all()
    assert (emulator.sent_frames, emulator.lost_frames) == (200 * 16, 0)


def test_an_answer_waits_for_the_end_of_a_frame():
    decoder, data = SlcanScans(), b""
    recording = make_recording(100, rate_hz=2000.0)
    with Emulator([recording], frame_s=0, jitter_s=0, waits=True) as emulator, open_raw(emulator.port) as port:
        port.write(b"S8\rO\r")
        time.sleep(0.15)  # the terminal is full after 30 ms
        with contextlib.suppress(OSError):
            while True:
                port.write(b"V\r")
                data += port.read(min(port.in_waiting, 101) or 1)  # ends within a frame, and so does what finds room
    decoder.feed(data, 0)
    counters = decoder.counters()
    assert (counters["frames"], counters["bad_lines"]) == (100 * 16, 0) and data.count(b"V") > 100


# The command.


def start(*arguments: object) -> Any:
    command = [sys.executable, "-m", "firmware_bridge.emulation.robot_main", *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_the_command_plays_and_ends_with_who_started_it(tmp_path):
    path = write_recording(tmp_path / "a.csv", make_counts(8))
    with start(path, "--rate-hz", 200) as process:
        with SlcanSerialLink(process.stdout.readline().strip()) as link:
            scans = read_until_lost(link)
        assert {scan.sensor for scan in scans} == {"4"} and len(scans) == 8
        assert process.wait(60) == 0
    with start(path, "--rate-hz", 100, "--loop") as process:
        assert process.stdout.readline().startswith("/dev/pts/") and process.poll() is None
        process.stdin.close()
        assert process.wait(60) == 0


def test_the_command_goes_on_where_it_was_after_a_stop(tmp_path):
    """No controller sends in one burst what it has missed."""
    path = write_recording(tmp_path / "a.csv", make_counts(10))
    with start(path, "--rate-hz", 20) as process, SlcanSerialLink(process.stdout.readline().strip()) as link:
        scans = read_scans(link, 3)
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        process.send_signal(signal.SIGCONT)
        scans += read_until_lost(link)
    apart_ns = np.diff([scan.device_ns for scan in scans if scan.device_ns is not None])
    assert len(scans) == 10
    assert apart_ns.max() > 400_000_000, "its stamps have the stop as well"
    assert apart_ns.min() > 20_000_000, "no burst; a clock that is followed may be corrected by some ms after a stop"


def test_a_stop_amid_a_scan_tears_none():
    """Only the machine can stop an emulator there; a controller sends its scans whole."""
    with (
        Emulator([make_recording(20), make_recording(20, seed=1)], seed=3) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        encode = emulator.adapter.encode
        numbers = iter(range(20 * 32))

        def encode_slowly(frame, time_s):
            if next(numbers) in (20, 325):
                time.sleep(0.5)
            return encode(frame, time_s)

        emulator.adapter.encode = encode_slowly
        scans = read_until_lost(link)
    assert (stacked(scans, "4") == make_counts(20)).all() and (stacked(scans, "6") == make_counts(20, seed=1)).all()
    assert emulator.lost_frames == 0 and all(scan.fresh.all() for scan in scans)
    for sensor in "46":
        apart_ns = np.diff([scan.device_ns or 0 for scan in scans if scan.sensor == sensor])
        assert (apart_ns > 300_000_000).sum() >= 2, "a gap of each stop; the machine may have stopped it as well"
        assert apart_ns.min() > 0, "a clock whose rate is followed may be corrected by some ms after a stop"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["gone.csv"], "cannot be read"), (["a.csv"], "--rate-hz"), (["a.csv", "--rate-hz", "0"], "positive")],
)
def test_the_command_says_what_is_wrong(tmp_path, monkeypatch, capsys, arguments, words):
    write_recording(tmp_path / "a.csv", make_counts(1))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert words in capsys.readouterr().err.splitlines()[-1]


def test_ctrl_c_ends_the_command_quietly(tmp_path, monkeypatch, capsys):
    def interrupt(emulator, timeout_s):
        raise KeyboardInterrupt

    monkeypatch.setattr(Emulator, "wait", interrupt)
    path = write_recording(tmp_path / "a.csv", make_counts(1))
    assert main([str(path), "--rate-hz", "100"]) == 130
    assert capsys.readouterr().err == ""


def test_it_tells_when_the_last_frame_of_each_scan_is_handed_on():
    stamps = []
    emulator = Emulator(
        [make_recording(10), make_recording(10, seed=1)],
        frame_s=2e-4,
        on_scan=lambda controller, time_ns: stamps.append((controller, time_ns, emulator.sent_frames)),
    )
    begun_ns = time.monotonic_ns()
    with emulator, SlcanSerialLink(emulator.port) as link:
        scans = read_until_lost(link)
    assert all(sent >= 16 * (number + 1) for number, (_, _, sent) in enumerate(stamps))
    for controller in (4, 6):
        told_ns = [time_ns for name, time_ns, _ in stamps if name == controller]
        came_ns = [scan.time_ns for scan in scans if scan.sensor == str(controller)]
        assert len(told_ns) == len(came_ns) == 10
        assert all(begun_ns < before < after for before, after in zip(told_ns, came_ns, strict=True))
