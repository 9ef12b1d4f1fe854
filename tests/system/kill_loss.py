"""Loss of a recording by `kill -9`, for docs/recordings.md: `python tests/system/kill_loss.py [RUNS]`.

The sink `jsonl:` writes each record at once: records that it has and the recording has not were lost.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.formats import load_recording

ROOT = Path(__file__).resolve().parents[2]


def loss_ms(folder: Path, after_s: float) -> float:
    """Kill one recorder of the demo so long after its first record."""
    path, told = folder / "killed.mcap", folder / "told.jsonl"
    process = subprocess.Popen(
        [sys.executable, "-m", "edge.cli.main", "record", path, "--source", "demo:loop", "--sink", f"jsonl:{told}"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not told.exists() or not told.stat().st_size:
        time.sleep(0.01)
    time.sleep(after_s)
    process.kill()
    process.wait()
    records = [json.loads(line) for line in told.read_text().splitlines(keepends=True) if line.endswith("\n")]
    times_ns = [record["time_ns"] for record in records if record["state"] != "event"]
    try:
        kept_ns = int(load_recording(path).tracks[0].time_ns[-1])
    except RecordingError:
        kept_ns = times_ns[0]
    path.unlink()
    told.unlink()
    return (times_ns[-1] - kept_ns) / 1e6


def main() -> None:
    """Print median and most of so many runs."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    random.seed(0)
    with tempfile.TemporaryDirectory() as folder:
        lost_ms = sorted(loss_ms(Path(folder), random.uniform(1, 3)) for _ in range(runs))
    print(f"{runs} runs: lost {lost_ms[runs // 2]:.0f} ms (median), at most {lost_ms[-1]:.0f} ms")


if __name__ == "__main__":
    main()
