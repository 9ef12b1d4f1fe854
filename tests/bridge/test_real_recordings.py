"""Real recordings, both fingers at once, as slcan text over a pseudo-terminal at the recorded rate."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS, read_until_lost, undisturbed

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording
from firmware_bridge.scans.scan import Scan

TRIALS = sorted(path.parent for path in REAL_RECORDINGS.glob("*/xela_sensor1.csv"))

pytestmark = pytest.mark.skipif(not TRIALS, reason=f"no recordings in {REAL_RECORDINGS} (set TACTILE_RECORDINGS)")


class Played(NamedTuple):
    fingers: list[Recording]
    scans: list[Scan]
    counters: dict[str, int]
    lost_frames: int


def play(trial: Path) -> Played:
    fingers = [load_recording(trial / f"xela_sensor{finger}.csv") for finger in (1, 2)]
    with (
        Emulator(fingers, controllers=(4, 6), seed=len(trial.name)) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        return Played(fingers, read_until_lost(link, timeout_s=60), link.counters(), emulator.lost_frames)


@pytest.fixture(scope="module")
def played() -> dict[Path, Played]:
    """All trials at once: each takes as long as it took, and none needs much of a core."""
    with ThreadPoolExecutor(len(TRIALS)) as pool:
        return dict(zip(TRIALS, pool.map(lambda trial: undisturbed(lambda: play(trial)), TRIALS), strict=True))


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_every_row_is_one_scan(played, trial):
    told = played[trial]
    assert told.lost_frames == 0, "this machine was too busy to read in time"
    for sensor, finger in zip(("4", "6"), told.fingers, strict=True):
        scans = [scan for scan in told.scans if scan.sensor == sensor]
        rows = finger.tracks[0].counts
        assert [scan.number for scan in scans] == list(range(len(rows)))
        assert (np.stack([scan.counts for scan in scans]) == rows).all()
    assert len(told.scans) == sum(len(finger.tracks[0].counts) for finger in told.fingers)
    trouble = (
        "bad_lines",
        "non_ascii_lines",
        "skipped_bytes",
        "foreign",
        "duplicates",
        "unconfirmed",
        "missing_taxels",
    )
    assert {name: told.counters[name] for name in trouble} == dict.fromkeys(trouble, 0)


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_torn_and_repeated_rows_are_told(played, trial):
    told = played[trial]
    torn = repeated = 0
    for sensor, finger in zip(("4", "6"), told.fingers, strict=True):
        rows = np.loadtxt(finger.path, delimiter=",", skiprows=1).reshape(-1, 16, 3)
        changed = np.vstack([np.ones((1, 16), dtype=bool), (rows[1:] != rows[:-1]).any(axis=2)])
        scans = [scan for scan in told.scans if scan.sensor == sensor]
        assert [scan.renewed.ravel().tolist() for scan in scans] == changed.tolist()
        renewed = changed.sum(axis=1)
        assert [scan.torn for scan in scans] == ((renewed > 0) & (renewed < 16)).tolist()
        assert [scan.repeated for scan in scans] == (renewed == 0).tolist()
        torn += int(((renewed > 0) & (renewed < 16)).sum())
        repeated += int((renewed == 0).sum())
    # The recordings hold both; a comparison without any would prove nothing.
    assert torn > 200 and repeated > 40
    assert (told.counters["torn_source"], told.counters["repeated"], told.counters["torn_wire"]) == (torn, repeated, 0)
