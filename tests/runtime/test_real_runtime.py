"""Real recordings through the whole road: emulated controller, pseudo-terminal, `edge-sr`, records."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from bridge_samples import undisturbed
from edge_samples import ROOT, write_model

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

RECORDINGS = Path(os.environ.get("TACTILE_RECORDINGS", ROOT / "../shared/recordings/imanlab"))
TRIALS = sorted(path.name for path in RECORDINGS.glob("data_sample_*")) if RECORDINGS.is_dir() else []
RELEASED = "data_sample_2022-02-22-08-10-01"
SENSORS = ("4", "6")
BASELINE_ROWS = 20

pytestmark = pytest.mark.skipif(not TRIALS, reason=f"no real recordings at {RECORDINGS} (TACTILE_RECORDINGS)")


def counts_of(trial):
    """Raw counts (n, 3, 4, 4) of both fingers."""
    return [load_recording(RECORDINGS / trial / f"xela_sensor{n}.csv").tracks[0].counts for n in (1, 2)]


class Played(NamedTuple):
    records: dict[str, list[dict[str, Any]]]
    lost_frames: int


def play(trial, folder) -> Played:
    """Records of `edge-sr` for one trial, both fingers at once at the recorded rate."""
    baselines = [
        Baseline.from_counts(sensor, counts[-BASELINE_ROWS:], created_unix_s=1.0)
        for sensor, counts in zip(SENSORS, counts_of(trial), strict=True)
    ]
    save_baselines(folder / f"{trial}.json", baselines)
    tracks = [load_recording(RECORDINGS / trial / f"xela_sensor{n}.csv") for n in (1, 2)]
    with Emulator(tracks, controllers=[4, 6]) as emulator:
        options = ["--model", folder / "tiny.onnx", "--baseline", folder / f"{trial}.json", "--sink", "jsonl:-"]
        options += ["--give-up-s", "0"]
        done = subprocess.run(
            [sys.executable, "-m", "edge.cli.main", "--source", f"slcan:{emulator.port}", *map(str, options)],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=120,
        )
        lost_frames = emulator.lost_frames
    assert done.returncode == 3, done.stderr  # the emulator hangs up at the end, which is the cable out
    # A machine that stands still for a moment reports a silent sensor; what counts is that no scan is lost of it.
    records = [one for one in map(json.loads, done.stdout.splitlines()) if one["state"] != "event"]
    by_sensor = {sensor: [record for record in records if record["sensor"] == sensor] for sensor in SENSORS}
    return Played(by_sensor, lost_frames)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    folder = tmp_path_factory.mktemp("real")
    write_model(folder / "tiny.onnx")
    with ThreadPoolExecutor(len(TRIALS)) as pool:
        told = pool.map(lambda trial: undisturbed(lambda: play(trial, folder)), TRIALS)
        return dict(zip(TRIALS, told, strict=True))


@pytest.mark.parametrize("trial", TRIALS)
def test_one_record_for_every_row_none_lost_none_invented(played, trial):
    records = played[trial].records
    assert played[trial].lost_frames == 0, "this machine was too busy to read in time"
    for sensor, counts in zip(SENSORS, counts_of(trial), strict=True):
        mine = records[sensor]
        assert [record["scan"] for record in mine] == list(range(len(counts)))
        np.testing.assert_array_equal([record["counts"] for record in mine], counts)
        assert {record["source"] for record in mine} == {"emulated"}
        assert {record["fresh"] for record in mine} == {0xFFFF}


@pytest.mark.parametrize("trial", TRIALS)
def test_torn_and_repeated_rows_are_reported(played, trial):
    records = played[trial].records
    torn = repeated = 0
    for sensor, counts in zip(SENSORS, counts_of(trial), strict=True):
        changed = (np.diff(counts, axis=0) != 0).any(axis=1).reshape(len(counts) - 1, 16)
        masks = [0xFFFF, *(int(sum(1 << int(taxel) for taxel in np.flatnonzero(row))) for row in changed)]
        assert [record["renewed"] for record in records[sensor]] == masks
        torn += sum(mask not in (0, 0xFFFF) for mask in masks)
        repeated += masks.count(0)
    counted = [one["counters"] for mine in records.values() for one in mine if "counters" in one]
    last = max(counted, key=lambda counters: counters["scans"])
    assert (last["torn_source"], last["repeated"], last["torn_wire"]) == (torn, repeated, 0)
    assert torn > 0 and repeated > 0


@pytest.mark.skipif(RELEASED not in TRIALS, reason=f"{RELEASED} is not there")
def test_a_grip_from_the_start_is_in_doubt_and_its_end_is_seen_within_five_scans_of_the_release(played):
    """No scan has shown the pad at rest near the stored baseline before the release, and then all are."""
    records = played[RELEASED].records
    for sensor, counts in zip(SENSORS, counts_of(RELEASED), strict=True):
        z_counts = (counts[:, 2] - np.median(counts[-BASELINE_ROWS:, 2], axis=0)).sum(axis=(1, 2))
        # Released: the first row with less than half of the grip that the trial starts with.
        release = int(np.argmax(z_counts < z_counts[0] / 2))
        states = [record["state"] for record in records[sensor]]
        end = states.index("idle")
        assert 0 <= end - release <= 5
        assert set(states[:end]) <= {"baseline_in_doubt", "contact"} and set(states[end:]) == {"idle"}
        assert set(states[: release - 1]) == {"baseline_in_doubt"}
        assert not any(record["trusted"] for record in records[sensor][: release - 1])
