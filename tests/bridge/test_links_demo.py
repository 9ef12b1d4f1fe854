"""The demo: its emulator plays through, and has hung up however the demo ends."""

import threading
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import make_counts, read_scans, read_until_lost, stacked, write_recording

from firmware_bridge.errors import DeviceError
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "demo.csv", make_counts(30), rate_hz=100)


@pytest.mark.parametrize(("loop", "rate_hz", "rounds"), [(False, None, 1), (True, 150, 3)])
def test_it_plays_through_and_ends_or_begins_again(recording, loop, rate_hz, rounds):
    with DemoLink(recording, rate_hz, loop=loop) as link:
        scans = read_scans(link, 75)[:75] if loop else read_until_lost(link)
        assert link.ended != loop
        assert loop or link.read(0.1) == []
    assert (stacked(scans) == np.concatenate([make_counts(30)] * rounds)[: len(scans)]).all()
    assert len(scans) == (75 if loop else 30)


def test_leaving_early_and_a_port_that_does_not_open_leave_no_emulator(recording, monkeypatch):
    def refuse(link):
        raise DeviceError("no port")

    before = threading.active_count(), len(list(Path("/proc/self/fd").iterdir()))
    with DemoLink(recording, rate_hz=2) as link:  # fifteen seconds, if it were left to play on
        read_scans(link, 1)
    monkeypatch.setattr(SlcanSerialLink, "__enter__", refuse)
    with pytest.raises(DeviceError, match="no port"):
        DemoLink(recording).__enter__()
    assert (threading.active_count(), len(list(Path("/proc/self/fd").iterdir()))) == before


@pytest.mark.parametrize(
    ("name", "rate_hz", "words"),
    [("gone.npz", None, "cannot be read"), ("a.csv", None, "--rate-hz"), ("a.csv", 0, "positive")],
)
def test_a_recording_that_cannot_be_played(tmp_path, name, rate_hz, words):
    write_recording(tmp_path / "a.csv", make_counts(1))
    with pytest.raises(DeviceError, match=rf"^the emulator did not start: .*{words}"):
        DemoLink(tmp_path / name, rate_hz).__enter__()
