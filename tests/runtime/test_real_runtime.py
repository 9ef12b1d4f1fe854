"""A real recording through the whole road: emulated controller, pseudo-terminal, `edge-sr`, records."""
# pyright: reportArgumentType=false

import json
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS, undisturbed
from edge_samples import ROOT, write_model

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

TRIAL = REAL_RECORDINGS / "data_sample_2022-02-22-08-10-01"
"""Two fingers that grip from the start and let go at the end."""
SENSORS = ("4", "6")
BASELINE_ROWS = 20

pytestmark = pytest.mark.skipif(not TRIAL.is_dir(), reason=f"no real recordings at {TRIAL} (TACTILE_RECORDINGS)")


class Played(NamedTuple):
    records: dict[str, list[dict[str, Any]]]
    lost_frames: int


def play(tracks, options) -> Played:
    """Return the records of `edge-sr` by sensor, at twice the recorded rate."""
    with Emulator(tracks, controllers=[4, 6], rate_hz=120) as emulator:
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


def test_every_row_is_a_record_and_the_grip_ends_where_it_was_let_go(tmp_path):
    tracks = [load_recording(TRIAL / f"xela_sensor{number}.csv") for number in (1, 2)]
    counts_of = dict(zip(SENSORS, (one.tracks[0].counts for one in tracks), strict=True))
    baselines = [Baseline.from_counts(sensor, counts_of[sensor][-BASELINE_ROWS:], 1.0) for sensor in SENSORS]
    save_baselines(tmp_path / "zero.json", baselines)
    options = ["--model", write_model(tmp_path / "tiny.onnx"), "--baseline", tmp_path / "zero.json"]
    played = undisturbed(lambda: play(tracks, [*options, "--sink", "jsonl:-", "--give-up-s", "0"]))
    assert played.lost_frames == 0, "this machine was too busy to read in time"
    torn = repeated = 0
    for sensor, counts in counts_of.items():
        mine = played.records[sensor]
        assert [record["scan"] for record in mine] == list(range(len(counts))), "none lost, none invented"
        np.testing.assert_array_equal([record["counts"] for record in mine], counts)
        assert {(record["source"], record["fresh"]) for record in mine} == {("emulated", 0xFFFF)}
        changed = (np.diff(counts, axis=0) != 0).any(axis=1).reshape(len(counts) - 1, 16)
        masks = [0xFFFF, *(int(sum(1 << int(taxel) for taxel in np.flatnonzero(row))) for row in changed)]
        assert [record["renewed"] for record in mine] == masks
        torn += sum(mask not in (0, 0xFFFF) for mask in masks)
        repeated += masks.count(0)
        # No scan has shown the pad at rest near the stored baseline before the release, and then all do.
        z_counts = (counts[:, 2] - np.median(counts[-BASELINE_ROWS:, 2], axis=0)).sum(axis=(1, 2))
        release = int(np.argmax(z_counts < z_counts[0] / 2))
        states = [record["state"] for record in mine]
        end = states.index("idle")
        assert 0 <= end - release <= 5
        assert set(states[:end]) <= {"baseline_in_doubt", "contact"} and set(states[end:]) == {"idle"}
        assert set(states[: release - 1]) == {"baseline_in_doubt"}
        assert not any(record["trusted"] for record in mine[: release - 1])
    counted = [one["counters"] for mine in played.records.values() for one in mine if "counters" in one]
    last = max(counted, key=lambda counters: counters["scans"])
    assert (last["torn_source"], last["repeated"], last["torn_wire"]) == (torn, repeated, 0)
    assert torn > 0 and repeated > 0
