"""The demo: its emulator plays through, and is gone however the demo ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import make_counts, read_scans, read_until_lost, stacked, write_recording
from edge_samples import wait_for
from link_rigs import processes_playing

from firmware_bridge.errors import DeviceError
from firmware_bridge.links import demo
from firmware_bridge.links.demo import DemoLink


@pytest.fixture
def recording(tmp_path):
    path = write_recording(tmp_path / "demo.csv", make_counts(30), rate_hz=100)
    yield path
    assert processes_playing(path) == []


@pytest.mark.parametrize(("loop", "rate_hz", "rounds"), [(False, None, 1), (True, 150, 3)])
def test_it_plays_through_and_ends_or_begins_again(recording, loop, rate_hz, rounds):
    with DemoLink(recording, rate_hz, loop=loop) as link:
        scans = read_scans(link, 75)[:75] if loop else read_until_lost(link)
        assert link.ended != loop
        assert loop or link.read(0.1) == []
    assert (stacked(scans) == np.concatenate([make_counts(30)] * rounds)[: len(scans)]).all()
    assert len(scans) == (75 if loop else 30)


def test_leaving_early_ends_the_emulator_without_force(recording, monkeypatch):
    monkeypatch.setattr(subprocess.Popen, "kill", lambda process: pytest.fail("killed"))
    open_before = len(list(Path("/proc/self/fd").iterdir()))
    with DemoLink(recording, rate_hz=2) as link:  # fifteen seconds, if it were left to play on
        read_scans(link, 1)
        assert len(processes_playing(recording)) == 1
    assert len(list(Path("/proc/self/fd").iterdir())) == open_before


def test_an_emulator_that_hangs_is_killed(recording, limits):
    limits(demo, END_TIMEOUT_S=0.2)
    with DemoLink(recording, rate_hz=50) as link:
        read_scans(link, 1)
        (process_id,) = processes_playing(recording)
        os.kill(process_id, signal.SIGSTOP)


def test_a_recording_that_cannot_be_played(tmp_path):
    with pytest.raises(DeviceError, match=r"the emulator did not start: .*gone\.npz: cannot be read"):
        DemoLink(tmp_path / "gone.npz").__enter__()
    assert processes_playing(tmp_path / "gone.npz") == []


def test_a_port_that_does_not_open_leaves_no_emulator(recording, monkeypatch):
    monkeypatch.setattr(demo, "SlcanSerialLink", lambda port: pytest.fail("no port"))
    with pytest.raises(pytest.fail.Exception):
        DemoLink(recording).__enter__()


SCRIPT = """
import subprocess, sys
from firmware_bridge.links.demo import DemoLink

class Told(subprocess.Popen):
    def wait(self, timeout=None):
        code = super().wait(timeout)
        sys.stdout.write(f"the emulator ended with {code}\\n")
        return code

subprocess.Popen = Told
try:
    with DemoLink(sys.argv[1], rate_hz=2) as link:
        sys.stdout.write("reading\\n")
        sys.stdout.flush()
        while not link.ended:
            link.read(0.1)
except KeyboardInterrupt:
    pass
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_emulator_ends_however_its_parent_ends(recording, how):
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(recording)], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as parent:
        assert parent.stdout.readline() == "reading\n"
        assert len(processes_playing(recording)) == 1
        os.killpg(parent.pid, how)  # to the whole process group, as a terminal sends Ctrl-C
        last_words, _ = parent.communicate(timeout=60)
    wait_for(lambda: not processes_playing(recording), 60)
    if how == signal.SIGINT:  # Ctrl-C was for the parent alone: the emulator was asked to end, and ended well
        assert set(last_words.splitlines()) == {"the emulator ended with 0"}
