import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import make_counts, read_scans, read_until_lost, stacked, write_recording

from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links import demo
from firmware_bridge.links.demo import DemoLink


def processes_playing(path: Path) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"firmware_bridge.emulation.robot_main" in command and str(path).encode() in command:
                found.append(int(entry.name))
    return found


def wait_until_gone(path: Path) -> None:
    end_s = time.monotonic() + 60
    while processes_playing(path):
        assert time.monotonic() < end_s, "the emulator lives on"
        time.sleep(0.02)


@pytest.fixture
def recording(tmp_path) -> Path:
    return write_recording(tmp_path / "demo.csv", make_counts(30), rate_hz=100)


def test_the_demo_plays_through_and_ends(recording):
    link = DemoLink(recording)
    assert (link.kind, link.name, link.ended) == ("emulated", "demo", False)
    assert link.counters() == {}
    with link:
        scans = read_until_lost(link)
        assert link.ended and link.read(0.1) == []
        assert link.counters()["scans"] == 30
    assert link.counters()["scans"] == 30, "the summary is told when the link is closed"
    assert (stacked(scans) == make_counts(30)).all()
    assert processes_playing(recording) == []


def test_the_counters_of_a_closed_demo_are_the_callers_own(recording):
    """A source adds those of its other links to them, each time that it is asked."""
    link = DemoLink(recording)
    with link:
        read_until_lost(link)
    link.counters()["scans"] += 1000
    assert link.counters()["scans"] == 30


def test_a_loop_goes_on_where_the_demo_ends_until_it_is_left(recording):
    with DemoLink(recording, rate_hz=1000, loop=True) as link:
        scans = read_scans(link, 75)
        assert not link.ended
    assert (stacked(scans[:75]) == np.concatenate([make_counts(30)] * 3)[:75]).all()
    assert processes_playing(recording) == []


def test_leaving_early_ends_the_emulator(recording):
    open_before = len(list(Path("/proc/self/fd").iterdir()))
    with DemoLink(recording, rate_hz=2) as link:  # fifteen seconds, if it were left to play on
        read_scans(link, 1)
        assert len(processes_playing(recording)) == 1
        process, serial_link = link._process, link._link
    assert serial_link is not None and serial_link._serial is None
    assert len(list(Path("/proc/self/fd").iterdir())) == open_before
    assert process is not None and process.returncode == 0  # by itself: nobody had to kill it
    assert processes_playing(recording) == []


def test_an_emulator_that_hangs_is_killed(recording, monkeypatch):
    monkeypatch.setattr(demo, "END_TIMEOUT_S", 0.2)
    with DemoLink(recording, rate_hz=50) as link:
        read_scans(link, 1)
        (process_id,) = processes_playing(recording)
        os.kill(process_id, signal.SIGSTOP)
    assert processes_playing(recording) == []


def test_an_emulator_that_dies_is_a_lost_link(recording):
    with DemoLink(recording, rate_hz=5) as link:
        read_scans(link, 1)
        (process_id,) = processes_playing(recording)
        os.kill(process_id, signal.SIGKILL)
        with pytest.raises(LinkLostError):
            for _ in range(100):
                link.read(0.1)
        assert not link.ended
    assert processes_playing(recording) == []


def test_a_recording_that_cannot_be_played(tmp_path):
    with pytest.raises(DeviceError, match=r"the emulator did not start: .*gone\.npz: cannot be read"):
        DemoLink(tmp_path / "gone.npz").__enter__()
    assert processes_playing(tmp_path / "gone.npz") == []


def test_a_port_that_does_not_open_leaves_no_emulator(recording, monkeypatch):
    monkeypatch.setattr(demo, "SlcanSerialLink", lambda port: pytest.fail("no port"))
    with pytest.raises(pytest.fail.Exception):
        DemoLink(recording).__enter__()
    assert processes_playing(recording) == []


def test_a_link_that_is_not_open(recording):
    link = DemoLink(recording)
    with pytest.raises(ValueError, match="with statement"):
        link.read(0.1)
    link.__exit__(None, None, None)


SCRIPT = """
import sys
from firmware_bridge.links.demo import DemoLink
link = DemoLink(sys.argv[1], rate_hz=20)
try:
    with link:
        process = link._process
        while not link.read(0.1):
            pass
        sys.stdout.write("reading\\n")
        sys.stdout.flush()
        while not link.ended:
            link.read(0.1)
except KeyboardInterrupt:
    sys.stdout.write(f"interrupted, the emulator ended with {process.returncode}\\n")
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_emulator_ends_however_its_parent_ends(recording, how):
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(recording)], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as parent:
        assert parent.stdout is not None and parent.stdout.readline() == "reading\n"
        assert len(processes_playing(recording)) == 1
        # To the whole process group, as a terminal sends Ctrl-C.
        os.killpg(parent.pid, how)
        last_words, _ = parent.communicate(timeout=60)
    wait_until_gone(recording)
    if how == signal.SIGINT:
        # Ctrl-C was for the parent alone: the emulator was asked to end, and ended well.
        assert last_words == "interrupted, the emulator ended with 0\n"
