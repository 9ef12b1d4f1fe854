"""Behaviour of edge-sr and edge.api, frozen: records, events, notes, exit codes and messages of each scene.

`python tests/golden/test_golden.py [NAME...]` writes it again after a meant change.
"""

import contextlib
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

if __name__ == "__main__":  # as pyproject.toml has it for pytest
    sys.path[:0] = [str(Path(__file__).parents[1] / "support"), str(Path(__file__).parents[2])]

from bridge_samples import write_npz
from bridge_samples import write_recording as write_csv
from cli_samples import records, run

from edge import api
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT

FROZEN = Path(__file__).parent / "frozen"
SAMPLED = 15
"""Every so many records of a sensor one is kept whole, and the first two of each stretch of a state."""
OF_THE_RUN = {
    *("time_ns", "device_time_ns", "run_time_us", "latency_us", "counters", "baseline", "baseline_age_s", "event"),
    *("events", "note", "notes"),
}
"""Keys that differ from run to run, or are kept apart."""
RELATIVE, ABSOLUTE = 0.02, 2e-3
"""Tolerances: 8-bit integers differ between processors by a thousandth of a pattern, and by as much of an area."""
OWN_ABSOLUTE = {"force_counts": 1.0, "area_mm2": 3.0, "mean": 2e-3, "peak": 5e-3, "at": 2}
MODEL = ("--model", "stsr-small-int8")
RECORDS = ("--sink", "jsonl:-")
FREE, PRESS = 150, slice(310)
"""Scans of the demo's free pad before the first tap, and those until the end of the second."""
Outcome = dict[str, Any]


def edge_sr(folder: Path, *arguments: object) -> Outcome:
    """Run edge-sr, in this process since as many starts take half a minute; return all that it says, in short."""
    with contextlib.chdir(folder):
        done = run(*arguments, COLUMNS="80", NO_COLOR="1")
    told = [line for line in done.stdout.splitlines() if line.startswith("{")]
    texts = [masked(line) for line in done.stdout.splitlines() if line not in told]
    errors = [masked(line) for line in done.stderr.splitlines()]
    return {"exit": done.returncode, "stdout": texts, "stderr": errors, **short(records("\n".join(told)))}


def masked(text: str) -> str:
    """Return a text without ids, paths of a folder and numbers."""
    return re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?", "#", re.sub(r"/\S*/|\b[0-9a-f]{8}\b", "", text))


def short(records: Sequence[dict[str, Any]]) -> Outcome:
    """Return records in short: states in stretches, notes and events as they come, and some records whole."""
    sensors: dict[str, Any] = {}
    for record in records:
        if record["state"] == "event":
            sensors.setdefault("", {"events": []})["events"].append(masked(record["event"]))
            continue
        of = sensors.setdefault(record["sensor"], {"states": [], "notes": [], "events": [], "records": []})
        if not of["states"] or of["states"][-1][0] != record["state"]:
            of["states"].append([record["state"], 0])
        of["states"][-1][1] += 1
        note = record.get("note")
        if note is not None and (not of["notes"] or of["notes"][-1][1] != masked(note)):
            of["notes"].append([record["scan"], masked(note)])
        if record.get("event"):
            of["events"].append([record["scan"], masked(record["event"])])
        if record["scan"] % SAMPLED == 0 or of["states"][-1][1] <= 2:
            of["records"].append({key: brief(value) for key, value in record.items() if key not in OF_THE_RUN})
    return {"sensors": sensors}


def brief(value: Any) -> Any:
    """Return a value, an array as its mean, its peak and the place of it."""
    if isinstance(value, list) and value and isinstance(value[0], list) and len(value) > 2:
        numbers = np.array(value, dtype=float)
        rows = numbers.reshape(-1, numbers.shape[-1])
        at = np.unravel_index(int(np.nanargmax(rows)), rows.shape)
        return {"mean": float(np.nanmean(rows)), "peak": float(np.nanmax(rows)), "at": list(map(int, at))}
    if isinstance(value, dict):
        return {key: brief(one) for key, one in value.items()}
    return value


def differences(frozen: Any, now: Any) -> list[str]:
    """Return where two outcomes differ by more than the tolerances, a line each."""
    before, after = dict(leaves(frozen)), dict(leaves(now))
    pairs = {place: (before.get(place, "nothing"), after.get(place, "nothing")) for place in before | after}
    return [f"{place}: {b!r}, was {a!r}" for place, (a, b) in pairs.items() if not alike(a, b, place)]


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the place and the value of all that an outcome is made of."""
    parts = dict(enumerate(value)) if isinstance(value, list) else value
    if not isinstance(parts, dict) or not parts:
        yield place, value
        return
    for key, part in parts.items():
        yield from leaves(part, f"{place}.{key}")


def alike(frozen: Any, now: Any, place: str) -> bool:
    if {type(frozen), type(now)} <= {int, float}:
        key = re.findall(r"[a-z]\w*", place)[-1]
        return math.isclose(frozen, now, rel_tol=RELATIVE, abs_tol=OWN_ABSOLUTE.get(key, ABSOLUTE))
    return frozen == now


def demo_counts() -> np.ndarray:
    return load_recording(api.demo_recording()).tracks[0].counts.copy()


def replayed(folder: Path, name: str, counts: np.ndarray, *words: object, rate_hz: int = 100) -> Outcome:
    write_csv(folder / f"{name}.csv", counts)
    return edge_sr(folder, "replay", f"{name}.csv", "--rate-hz", rate_hz, *words, *RECORDS)


def csv_replay(folder: Path) -> Outcome:
    return replayed(folder, "press", demo_counts()[PRESS], *MODEL)


def simulated_taps(folder: Path) -> Outcome:
    """The demo's recording, whose contacts are believed, in float32, which all processors round nearly alike."""
    return edge_sr(folder, "replay", api.demo_recording(), "--duration-s", 5, "--model", "mtsr", *RECORDS)


def chosen_fields_and_thresholds(folder: Path) -> Outcome:
    fields = ("--fields", "force_n,area_mm2", "--counts-per-newton", 1180, "--contact-on-counts", 4000)
    return replayed(folder, "press", demo_counts()[PRESS], *fields, *MODEL)


def two_fingers(folder: Path) -> Outcome:
    write_csv(folder / "left.csv", demo_counts()[PRESS])
    write_csv(folder / "right.csv", np.delete(demo_counts(), np.s_[FREE:390], axis=0)[PRESS])
    return edge_sr(folder, "replay", "left.csv,right.csv", "--rate-hz", 100, *MODEL, *RECORDS)


def begins_in_a_grip(folder: Path) -> Outcome:
    counts = np.concatenate([demo_counts()[165:230], demo_counts()[:60]])
    return replayed(folder, "grip", counts, *MODEL, rate_hz=60)


def never_free(folder: Path) -> Outcome:
    counts = demo_counts()
    return replayed(folder, "grip", counts[:FREE] + counts[180] - counts[0], *MODEL, rate_hz=60)


def old_baseline(folder: Path) -> Outcome:
    """The pad's rest level has fallen since it was zeroed: alike on all taxels, and each by something of its own."""
    fallen = np.rint(np.random.default_rng(5).normal([[[60]], [[-20]], [[-500]]], 70, (3, 4, 4))).astype(np.int32)
    (folder / "earlier").mkdir()
    write_csv(folder / "earlier" / "press.csv", demo_counts()[:FREE])
    zeroed = edge_sr(folder, "baseline", "--source", "replay:earlier/press.csv", "--rate-hz", 100, "--out", "zero.json")
    return {
        "zeroed": zeroed,
        "played": replayed(folder, "press", demo_counts()[PRESS] - fallen, "--baseline", "zero.json", *MODEL),
    }


def faulty_taxels(folder: Path) -> Outcome:
    """Taxel 5 falls silent, taxel 10 repeats itself, and at last a field is added to all taxels."""
    counts = demo_counts()[PRESS]
    counts[FREE:, :, 2, 2] = counts[FREE, :, 2, 2]
    counts[FREE:, :, 1, 1] = ABSENT
    there = counts[-40:] != ABSENT
    counts[-40:] += there * np.array([900, -400, 1500], dtype=np.int32)[:, None, None]
    write_npz(folder / "faulty.npz", counts)
    return edge_sr(folder, "replay", "faulty.npz", *MODEL, *RECORDS)


def extreme_counts(folder: Path) -> Outcome:
    counts = demo_counts()[PRESS]
    counts[FREE + 5, 2] = 65_535
    counts[FREE + 6, :, 1, 1] = 0
    return replayed(folder, "extreme", counts, *MODEL)


def commands_and_poses(folder: Path) -> Outcome:
    """From Python: zeroing on demand in and out of contact, a reset, poses of four half-pitch taps."""
    write_csv(folder / "press.csv", demo_counts()[:477])
    stated = {150: (0, 0), 230: (2.35, 0), 310: (2.35, 2.35), 390: (0, 2.35)}
    told = folder / "records.jsonl"
    with api.open_recording(folder / "press.csv", rate_hz=100.0) as source:
        model = api.load_model("mtsr")
        runtime = api.open_runtime(model, source)
        with contextlib.closing(api.open_sink(f"jsonl:{told}", model.contract, source)) as sink:
            for result in api.Stream(source, runtime):
                number = result.scan.number
                if number in stated:
                    runtime.pose(api.PadPose(*stated[number]), result.scan.time_ns, holds=True)
                if number in (180, 215):
                    runtime.zero()
                if number == 300:
                    runtime.reset()
                sink.write(result, {})
    return short(records(told.read_text()))


OF_TAPS = (csv_replay, simulated_taps, chosen_fields_and_thresholds, two_fingers, commands_and_poses)
OF_FAULTS = (begins_in_a_grip, never_free, old_baseline, faulty_taxels, extreme_counts)
SCENES = {scene.__name__: scene for scene in OF_TAPS + OF_FAULTS}


def play(name: str) -> Outcome:
    with TemporaryDirectory() as folder:
        return json.loads(json.dumps(SCENES[name](Path(folder))))


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_gives_what_it_gave(name):
    changes = differences(json.loads((FROZEN / f"{name}.json").read_text()), play(name))
    assert not changes, "\n".join(["as in frozen/, or write it again by this file:", *changes[:20]])


def main(names: list[str]) -> None:
    for name in names or SCENES:
        now, path = play(name), FROZEN / f"{name}.json"
        if not path.exists() or differences(json.loads(path.read_text()), now):
            path.write_text(json.dumps(now, sort_keys=True).replace("}, {", "},\n{") + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
