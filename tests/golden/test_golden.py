"""Behaviour of edge-sr and edge.api, frozen: records, events, notes, exit codes and messages of each scene.

`python tests/golden/test_golden.py [NAME...]` writes it again after a meant change.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

if __name__ == "__main__":  # as pyproject.toml has it for pytest
    sys.path[:0] = [str(Path(__file__).parents[1] / "support"), str(Path(__file__).parents[2])]

from bridge_samples import write_npz
from bridge_samples import write_recording as write_csv
from cli_samples import EDGE_SR
from golden_runs import brief, differences, edge_sr, environment, short

from edge.api import demo_recording
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.slcan_emulator import Emulator, SlcanAdapter
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.scan import ABSENT

PITCH_MM = 4.7
PLACES_MM = (np.arange(4) - 1.5) * PITCH_MM
REST = np.array([16_000, 16_400, 38_600])[:, None, None] + 37 * np.arange(16).reshape(4, 4)
FREE_SCANS = 110
"""Scans of the free pad before the first press: those of a zeroing, and some."""
TAP_SCANS = 40


def readings(x_mm: float, y_mm: float, radius_mm: float, counts: float, drag: float = 0.0) -> np.ndarray:
    """Return what a round press adds to the counts of the pad, (3, 4, 4), x right and y down.

    `counts` is the z of its strongest taxel, and `drag` its drag along x.
    """
    x, y = np.meshgrid(PLACES_MM - x_mm, PLACES_MM - y_mm)
    # The layer spreads a load by its thickness, and pushes material outwards at the edge of a contact.
    z = counts * np.exp(-(x**2 + y**2) / (radius_mm**2 + 3.0**2))
    return np.stack([z * (0.12 * x + drag), z * 0.12 * y, z])


PRESSES = (
    readings(0.0, 0.0, 5.0, 700),
    readings(2.0, -3.0, 4.0, 900, drag=0.3),
    readings(-4.0, 4.0, 6.0, 600),
    readings(1.0, 1.0, 3.0, 1100, drag=-0.2),
)


def pressed(presses: Sequence[np.ndarray] = PRESSES, *, seed: int = 1) -> np.ndarray:
    """Return the counts (n, 3, 4, 4) of a free pad and of taps, each pressed, held and released."""
    force = np.concatenate([np.linspace(0, 1, 8), np.ones(12), np.linspace(1, 0, 8), np.zeros(TAP_SCANS - 28)])
    taps = [force[:, None, None, None] * press for press in presses]
    made = np.concatenate([np.zeros((FREE_SCANS, 3, 4, 4)), *taps])
    noise = np.random.default_rng(seed).normal(0, 2, made.shape)
    return np.rint(REST + made + noise).astype(np.int32)


def gripped(scans: int = 200, *, free: int = 60) -> np.ndarray:
    """Return the counts of a grip from the first scan, which is opened before the last `free` ones."""
    load = np.ones(scans)
    load[scans - free - 10 : scans - free], load[scans - free :] = np.linspace(1, 0, 10), 0
    face = np.stack([np.zeros((4, 4)), np.zeros((4, 4)), np.full((4, 4), 650.0)])
    noise = np.random.default_rng(2).normal(0, 2, (scans, 3, 4, 4))
    return np.rint(REST + load[:, None, None, None] * face + noise).astype(np.int32)


FROZEN = Path(__file__).parent / "frozen"
MODEL = ("--model", "stsr-small-int8")
RECORDS = ("--sink", "jsonl:-")
Outcome = dict[str, Any]
SCENES: dict[str, Callable[[Path], Outcome]] = {}


def scene(make: Callable[[Path], Outcome]) -> Callable[[Path], Outcome]:
    SCENES[make.__name__] = make
    return make


def replayed(folder: Path, name: str, counts: np.ndarray, *words: object, rate_hz: int = 100) -> Outcome:
    write_csv(folder / f"{name}.csv", counts)
    return edge_sr(folder, "replay", f"{name}.csv", "--rate-hz", rate_hz, *words, *RECORDS)


@scene
def csv_replay(folder: Path) -> Outcome:
    return replayed(folder, "press", pressed(), *MODEL)


@scene
def simulated_taps(folder: Path) -> Outcome:
    """The demo's recording, whose contacts are believed, in float32, which all processors round nearly alike."""
    return edge_sr(folder, "replay", demo_recording(), "--duration-s", 5, "--model", "mtsr", *RECORDS)


@scene
def several_taps(folder: Path) -> Outcome:
    return replayed(folder, "press", pressed([PRESSES[0]] * 4), "--model", "mtsr4")


@scene
def chosen_fields_and_thresholds(folder: Path) -> Outcome:
    fields = ("--fields", "force_n,area_mm2", "--counts-per-newton", 1180, "--contact-on-counts", 4000)
    return replayed(folder, "press", pressed(), *fields, *MODEL)


@scene
def recorded_and_replayed(folder: Path) -> Outcome:
    write_csv(folder / "press.csv", pressed())
    made = edge_sr(folder, "replay", "press.csv", "--rate-hz", 100, *MODEL, "--sink", "mcap:press.mcap")
    again = edge_sr(folder, "replay", "press.mcap", *MODEL, *RECORDS)
    return {"made": made, "again": again}


@scene
def two_fingers(folder: Path) -> Outcome:
    write_csv(folder / "left.csv", pressed(seed=1))
    write_csv(folder / "right.csv", pressed(PRESSES[::-1], seed=2))
    return edge_sr(folder, "replay", "left.csv,right.csv", "--rate-hz", 100, *MODEL, *RECORDS)


@scene
def hand(folder: Path) -> Outcome:
    names = [f"pad{number}.csv" for number in range(16)]
    for number, name in enumerate(names):
        write_csv(folder / name, pressed(PRESSES[number % 4 :][:1], seed=number))
    ran = edge_sr(folder, "replay", *names, "--rate-hz", 100, *MODEL, *RECORDS)
    for sensor in ran["sensors"].values():
        sensor["records"] = sensor.get("records", [])[-1:]
    return ran


@scene
def begins_in_a_grip(folder: Path) -> Outcome:
    return replayed(folder, "grip", gripped(), *MODEL, rate_hz=60)


@scene
def never_free(folder: Path) -> Outcome:
    return replayed(folder, "grip", gripped(free=0)[:-10], *MODEL, rate_hz=60)


@scene
def old_baseline(folder: Path) -> Outcome:
    """The pad's rest level has fallen since it was zeroed: alike on all taxels, and each by something of its own."""
    fallen = np.rint(np.random.default_rng(5).normal([[[60]], [[-20]], [[-500]]], 70, (3, 4, 4))).astype(np.int32)
    (folder / "earlier").mkdir()
    write_csv(folder / "earlier" / "press.csv", pressed(()))
    zeroed = edge_sr(folder, "baseline", "--source", "replay:earlier/press.csv", "--rate-hz", 100, "--out", "zero.json")
    return {
        "zeroed": zeroed,
        "played": replayed(folder, "press", pressed() - fallen, "--baseline", "zero.json", *MODEL),
    }


@scene
def faulty_taxels(folder: Path) -> Outcome:
    """Taxel 5 falls silent, taxel 10 repeats itself, and at last a field is added to all taxels."""
    counts = pressed()
    counts[FREE_SCANS:, :, 2, 2] = counts[FREE_SCANS, :, 2, 2]
    counts[FREE_SCANS:, :, 1, 1] = ABSENT
    there = counts[-40:] != ABSENT
    counts[-40:] += there * np.array([900, -400, 1500])[:, None, None]
    write_npz(folder / "faulty.npz", counts)
    return edge_sr(folder, "replay", "faulty.npz", *MODEL, *RECORDS)


@scene
def extreme_counts(folder: Path) -> Outcome:
    counts = pressed()
    counts[FREE_SCANS + 5, 2] = 65_535
    counts[FREE_SCANS + 6, :, 1, 1] = 0
    return replayed(folder, "extreme", counts, *MODEL)


@scene
def commands_and_poses(folder: Path) -> Outcome:
    """From Python: zeroing on demand in and out of contact, a reset, poses of four half-pitch taps."""
    from edge import api

    write_csv(folder / "press.csv", pressed([PRESSES[0]] * 4))
    results = []
    with api.open_recording(folder / "press.csv", rate_hz=100.0) as source:
        runtime = api.open_runtime("mtsr", source)
        for result in api.Stream(source, runtime):
            number = result.scan.number
            if number % 40 == 0 and number > 100:
                x_mm, y_mm = [(0, 0), (2.35, 0), (2.35, 2.35), (0, 2.35)][(number - 120) // 40 % 4]
                runtime.pose(api.PadPose(x_mm, y_mm), result.scan.time_ns, holds=True)
            if number in (FREE_SCANS + 10, FREE_SCANS + 35):
                runtime.zero()
            if number == FREE_SCANS + 120:
                runtime.reset()
            results.append(result)
    return short(list(map(record_of, results)))


def record_of(result: Any) -> dict[str, Any]:
    kept = ("state", "contact", "taps_used", "force_counts", "trusted", "event", "note")
    record = {"sensor": result.scan.sensor, "scan": result.scan.number} | {name: getattr(result, name) for name in kept}
    record["next_tap"] = None if result.next_tap is None else [result.next_tap.dx_mm, result.next_tap.dy_mm]
    return record | {"pattern": None if result.pattern is None else result.pattern.tolist()}


class Adapter(SlcanAdapter):
    """Adapter that may know no time stamps, and may lose and garble what it hands on, by the number of the frame."""

    def __init__(self, *, stamped: bool, faulty: bool) -> None:
        super().__init__()
        self._stamped, self._faulty, self._frames, self._held = stamped, faulty, 0, b""

    def feed(self, data: bytes) -> bytes:
        return super().feed(data if self._stamped else data.replace(b"Z1", b"Z?"))

    def encode(self, frame: CanFrame, time_s: float) -> bytes:
        number, place = divmod(self._frames, 16)
        self._frames += 1
        line = super().encode(frame, time_s)
        if not self._stamped:  # a scan at once, since arrivals are its times: a machine that stalls would tear it
            self._held = line if place == 0 else self._held + line
            return self._held if place == 15 else b""
        if self._faulty and number % 15 == 9:
            return b"garbage\r" * (place == 0) + line + b"t0048zz\r" * (place == 15)
        return b"" if self._faulty and number % 15 == 7 and place == 5 else line


def over_slcan(folder: Path, *, stamped: bool = True, faulty: bool = False) -> Outcome:
    """Play presses over a link; states and forces depend on times, readings do not."""
    recording = Recording(folder, (Track("4", pressed(PRESSES[:2]), None),), 100.0)
    # A port of its own: a pseudo-terminal that is gone may be given to another, and the run tries it again.
    port, adapter = folder / "port", Adapter(stamped=stamped, faulty=faulty)
    with Emulator([recording], adapter=adapter, link=port):
        command = [*EDGE_SR, "--source", f"slcan:{port}", "--duration-s", "4", *MODEL, *RECORDS]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, env=environment())
    scans = [record for record in map(json.loads, ran.stdout.splitlines()) if record["state"] != "event"]
    if not stamped:  # how many cycles wait for their pace to show depends on when they were read
        return {"exit": ran.returncode, "fresh": sorted({one["fresh"] for one in scans}), "enough": len(scans) > 20}
    kept = [{"scan": one["scan"], "counts": brief(one["counts"])} for one in scans if one["scan"] % 15 == 0]
    return {"exit": ran.returncode, "fresh": [one["fresh"] for one in scans], "records": kept}


@scene
def slcan_stamped(folder: Path) -> Outcome:
    return over_slcan(folder)


@scene
def slcan_without_stamps(folder: Path) -> Outcome:
    return over_slcan(folder, stamped=False)


@scene
def slcan_with_faults(folder: Path) -> Outcome:
    return over_slcan(folder, faulty=True)


REFUSALS = (
    "--source nowhere:1",
    "--source slcan:/dev/none",
    "--model none.onnx --source demo",
    "--model press.csv --source demo",
    "--sink nowhere:x --source demo",
    "--sink jsonl:/none/x --source demo",
    "--sink mcap:press.csv --source demo",
    "--baseline press.csv --source demo",
    "--sensor press.csv --source demo",
    "--contact-on-counts 5 --contact-off-counts 9 --source demo",
    "--contact-on-counts nan --source demo",
    "--taps 9 --model mtsr4 --source demo",
    "--duration-s -1 --source demo",
    "--view 70000 --source demo",
    "--poses mqtt:x --source demo",
    "--id-map none --source demo",
    "--sorce demo",
    "replay",
    "replay none.csv",
    "replay press.txt",
    "replay short.csv",
    "replay text.csv",
    "replay press.csv --fields nothing",
    "replay press.csv --rate-hz 0",
    "record x.txt --source nowhere",
    "record press.csv --source demo --duration-s 1",
    "record x.npz --source demo --duration-s 1",
    "--sink npz:x.npz --source demo",
    "convert press.csv",
    "convert press.csv new.mcap",
    "convert press.csv new.txt",
    "convert none.mcap new.npz",
    "baseline --source replay:short.csv --out z.json",
    "models --nothing",
    "doctor --source nowhere",
    "map --out x.npz",
    "devices --nothing",
    "bench --only none",
    "nothing",
)
"""Command lines of a person, in a folder with press.csv, short.csv, text.csv and press.txt."""


@scene
def refusals(folder: Path) -> Outcome:
    counts = pressed(())
    write_csv(folder / "press.csv", counts)
    write_csv(folder / "short.csv", counts[:10])
    (folder / "text.csv").write_text("a,b\n1,2\n")
    (folder / "press.txt").write_text("nothing")
    ran = {line: edge_sr(folder, *line.split()) for line in REFUSALS}
    return {line: {key: done[key] for key in ("exit", "stderr")} for line, done in ran.items()}


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
        before = json.loads(path.read_text()) if path.exists() else None
        changes = differences(before, now) if before else ["new"]
        print(f"{name}: {len(changes)} changes", *changes[:8], sep="\n    ")
        if changes:
            path.write_text(json.dumps(now, sort_keys=True).replace("}, {", "},\n{") + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
