"""Real recordings, both fingers at once, as slcan text: torn and repeated rows are told, and every row is one scan."""

import random

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS

from firmware_bridge.can.slcan import encode_frame
from firmware_bridge.emulation.xela_controller import scan_frames
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.slcan_scans import SlcanScans

TRIALS = sorted(path.parent for path in REAL_RECORDINGS.glob("*/xela_sensor1.csv"))


@pytest.mark.skipif(not TRIALS, reason=f"no recordings in {REAL_RECORDINGS} (set TACTILE_RECORDINGS)")
@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_every_row_is_one_scan_and_torn_ones_are_told(trial):
    fingers = [load_recording(trial / f"xela_sensor{finger}.csv") for finger in (1, 2)]
    scans, noise, got = SlcanScans(), random.Random(1), {"4": [], "6": []}
    for number, rows in enumerate(zip(*(finger.tracks[0].counts for finger in fingers), strict=True)):
        frames = zip(
            *(scan_frames(row, int(sensor), noise) for row, sensor in zip(rows, got, strict=True)), strict=True
        )
        text = b"".join(encode_frame(frame) for pair in frames for frame in pair)
        for scan in scans.feed(text, number * 16_000_000):
            got[scan.sensor].append(scan)
    torn = repeated = 0
    for own, finger in zip(got.values(), fingers, strict=True):
        rows = np.loadtxt(finger.path, delimiter=",", skiprows=1).reshape(-1, 16, 3)
        assert [scan.number for scan in own] == list(range(len(rows)))
        assert (np.stack([scan.counts for scan in own]).reshape(-1, 3, 16) == rows.transpose(0, 2, 1)).all()
        changed = np.vstack([np.ones((1, 16), dtype=bool), (rows[1:] != rows[:-1]).any(axis=2)])
        assert [scan.renewed.ravel().tolist() for scan in own] == changed.tolist()
        renewed = changed.sum(axis=1)
        assert [scan.torn for scan in own] == ((renewed > 0) & (renewed < 16)).tolist()
        assert [scan.repeated for scan in own] == (renewed == 0).tolist()
        torn, repeated = torn + sum(scan.torn for scan in own), repeated + sum(scan.repeated for scan in own)
    # The recordings hold both; a comparison without any would prove nothing.
    assert torn > 200 and repeated > 40
    counted = {name: count for name, count in scans.counters().items() if count}
    frames = counted["frames"]
    assert counted == {
        "frames": frames, "readings": frames, "scans": frames // 16, "torn_source": torn, "repeated": repeated
    }  # fmt: skip
