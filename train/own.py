"""Train a model for one sensor, from what its sensor file says of it; handed over where it is the better one.

    python -m train.own sensor.toml --recordings trials --mesh part.stl --minutes 60 --out mine
    python -m train.own sensor.toml --taps taps.npz --beside mine/mine.onnx --out tapped

A model for one pad is worse than none on another: so its pads are drawn within what is known of the sensor, and its
contract says whose it is. At the end it is compared with the bundled model, which is told the same: what loses is not
handed over, nor what is worse than the model that is there, nor a gain in the mean that too many of the pads in
question do not have.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_linear_map, fitted_methods
from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, INT8_SUFFIX, find_model
from edge.inference.onnx_session import ModelSession, load_session
from edge.terminal.argument_types import positive
from firmware_bridge.in_place import write_in_place
from firmware_bridge.pad_geometry import TAXELS
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import load_sensor_file
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.make_presses import make_presses
from train.data.press_batches import OneSensor
from train.data.presses import SEED, PressSet
from train.data.real_grips import Grip, grips_of, has_hole, hidden_taxels, loaded, play, z_of
from train.data.recorded_taps import load_tap_parts
from train.data.world import World, solve_pad
from train.errors import DatasetError, TrainError, ended_by_errors
from train.families.catalogue import FIGURES, SHARES
from train.learning.checkpoint import Training, fit_network
from train.learning.sensor_knowledge import FIFTH, Knowledge, knowledge_of
from train.learning.training_loop import Recipe
from train.physics.gripped import SCALE
from train.physics.pad_draws import KNOWN, constants
from train.report import Row, bootstrap_interval, markdown
from train.surfaces.meshes import mesh_name, size_of


class Plan(NamedTuple):
    """Amount of work of a training."""

    presses: int
    steps: int


REST_S: Final = 150.0  # of two cores, to export and to compare
TRIED: Final = 96  # presses and steps by which their time is measured
SIMULATING: Final = 0.25  # share of the time for presses, up to
MOST_PRESSES: Final = 24_000
COMPARED: Final = 480  # presses of each set that nothing is trained on


def tried(world: World, folder: Path) -> tuple[float, float]:
    """Return how long a press takes with all processors, and a step of training, in [s]."""
    small = replace(world, count=2 * TRIED, per_pad=TRIED)
    unseen = solve_pad(small, 0)  # which also loads what is loaded once
    begun_s = time.monotonic()
    presses = solve_pad(small, 1)
    press_s = (time.monotonic() - begun_s) / TRIED / len(os.sched_getaffinity(0))
    training = replace(_training("tried", OneSensor((0.0,) * KNOWN, 1.0), TRIED // 4), start=None)
    with tempfile.TemporaryDirectory(dir=folder) as drafts:
        report = fit_network(training, presses, freeze_presses(unseen, SEED).as_frozen_set(), Path(drafts))
    return press_s, report["elapsed_s"] / report["steps"]


def _training(name: str, sensor: OneSensor, steps: int) -> Training:
    recipe = Recipe(steps, learning_rate=2e-3, bf16=True)
    return Training(name, "compact-stsr", recipe, start="stsr.onnx", options={"known": KNOWN}, sensor=sensor)


class Comparison(NamedTuple):
    """Comparison of a model with others."""

    table: str
    objection: str | None  # why it is not handed over
    gains: Mapping[str, str]  # over the bundled model, with intervals, by set


def compared(
    own: ModelSession,
    knowledge: Knowledge,
    sets: Mapping[str, PressSet],
    grips: Sequence[Grip],
    beside: Mapping[str, ModelSession] = MappingProxyType({}),
) -> Comparison:
    """Compare a model with the bundled one, told the same, and with bilinear interpolation.

    `sets` are presses that it was not trained on, by what they are; TAPPED are the sensor's own, read as they are. They
    decide between further models `beside` it, of which one that is REPLACED must not be the better one. In `grips` the
    sensor holds flat faces, which cover its pad.
    """
    bundled = ModelSession(find_model(DEFAULT_MODEL))
    sensor, models = knowledge.sensor(), {OWN: own, bundled.name: bundled} | dict(beside)
    bilinear = fitted_methods(BUNDLE_DIR / "classical.npz", own.contract.scale)["bilinear"]
    over, below = f"over {bundled.name}", "pads below it"
    rows: dict[str, Row] = {name: {"method": name} for name in (*models, "bilinear", over, below)}
    times_us: dict[str, list[float]] = {name: [] for name in models}
    gains, losing, objections, simulated = dict[str, str](), 0.0, list[str](), list[Any]()
    for what, presses in sets.items():
        as_read = FrozenPresses(presses, np.ones(0, dtype=np.float32))
        frozen = as_read if what == TAPPED else freeze_presses(presses, SEED + 1, sensor.nuisances)
        windows, truth = frozen.windows(1), frozen.patterns()
        if what != TAPPED:
            simulated.append((truth.reshape(len(truth), -1), z_of(windows[:, 0])))
        patterns = {name: np.empty_like(truth) for name in models} | {"bilinear": bilinear(windows[:, 0])}
        for number, window in enumerate(windows):
            for name, model in models.items():  # in turn, so that both meet the same machine
                row, scaled = model.contract.pad_row(knowledge.pad), model.contract.scale_window(window)
                begun_ns = time.perf_counter_ns()
                patterns[name][number] = model.run(scaled, row)
                times_us[name].append((time.perf_counter_ns() - begun_ns) / 1000)
        errors = {name: psnr_db(made, truth, own.contract.output_full_scale) for name, made in patterns.items()}
        for name, values in errors.items():
            rows[name][f"{what} [dB]"] = f"{values.mean():.2f}"
            gained = errors[OWN] - values
            low, high = bootstrap_interval(gained, presses.pad)
            gain = f"{gained.mean():+.2f} ({low:+.2f} to {high:+.2f})"
            if name == bundled.name:
                gains[what], pads = gain, np.unique(presses.pad)
                losing = float(np.mean([gained[presses.pad == pad].mean() < 0 for pad in pads]))
                rows[over][f"{what} [dB]"], rows[below][f"{what} [dB]"] = gain, f"{losing:.0%}"
            # One that is made for a wider range is better outside of what is known by now.
            decides = name in (bundled.name, "bilinear") or what == TAPPED or (name == REPLACED and what != UNLIKE)
            if name != OWN and decides and (high < 0 if what == UNLIKE or name == REPLACED else low <= 0):
                objections.append(f"on {what} it is {gain} dB to {name}")
        if TAPPED not in sets and what != UNLIKE and losing > MOST_LOSING:  # taps show which pad it is
            objections.append(
                f"on {what} it is below {bundled.name} on {losing:.0%} of the pads that this may be, expected at "
                f"most {MOST_LOSING:.0%}" + ": train on taps of the sensor (train.taps)" * bool(knowledge.pad.constants)
            )
    if grips:
        truths, readings = map(np.concatenate, zip(*simulated, strict=True))
        operator = fit_linear_map(truths, readings, 0.1)  # reads z off patterns of pads like this one
        objections += _on_recordings(models, bundled.name, grips, knowledge.pad, operator, rows)
    for name, times in times_us.items():
        rows[name]["run time [us]"] = round(float(np.median(times)))
    return Comparison(markdown([*rows.values()]), "; ".join(objections) or None, gains)


def _on_recordings(
    models: Mapping[str, ModelSession],
    bundled: str,
    grips: Sequence[Grip],
    pad: Pad,
    operator: NDArray[np.floating],
    rows: Mapping[str, Row],
) -> list[str]:
    """Return what speaks against OWN in recordings of grips, of which the cells of each model are put into its row."""
    objections, holes, off = list[str](), dict[str, NDArray[np.floating]](), dict[str, NDArray[np.floating]]()
    for name, model in models.items():
        holes[name] = np.array([_holes(grip, model, pad) for grip in grips])
        off[name] = np.concatenate([_hidden(grip, model, pad, operator) for grip in grips])
        rows[name]["recordings with holes"] = f"{holes[name].mean():.1%}"
    for grip, mine, theirs in zip(grips, holes[OWN], holes[bundled], strict=True):
        if not mine <= theirs:
            objections.append(
                f"in {grip.trial} {mine:.1%} of its patterns have holes, {theirs:.1%} of {bundled}'s: the sensor "
                "is not as in the sensor file; lay a weight on it with edge-sr doctor"
            )
    recording = np.repeat(np.arange(len(grips)), TAXELS)
    worse = off[OWN] - off[bundled]
    known = np.isfinite(worse)
    if known.any():
        counts = {name: f"{np.sqrt(values[known].mean()):.0f}" for name, values in off.items()}
        for name, cell in counts.items():
            rows[name]["hidden taxel [counts]"] = cell
        if bootstrap_interval(worse[known], recording[known])[0] > 0:
            objections.append(
                f"of a taxel that is hidden it is {counts[OWN]} counts off, {bundled} {counts[bundled]}: the sensor "
                "is not as in the sensor file; lay a weight on it with edge-sr doctor"
            )
    return objections


def _holes(grip: Grip, model: ModelSession, pad: Pad) -> float:
    """Return the share of a recording's patterns that have a hole; not a number where there is no pattern."""
    patterns = play(grip, model, pad=pad).patterns
    made = patterns[np.isfinite(patterns).all(axis=(1, 2))]
    return float(has_hole(made).mean()) if len(made) else np.nan


def _hidden(grip: Grip, model: ModelSession, pad: Pad, operator: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the mean squared error of the z of each taxel (TAXELS,), hidden in turn; NaN where there is no pattern."""
    few = replace(grip, counts=grip.counts[:: max(1, len(grip.counts) // 100)])  # a recording may be of hours
    zeroed = few.zeroed()
    squares = (hidden_taxels(few, model, operator, pad) - z_of(zeroed[loaded(zeroed)])) ** 2
    made = squares[np.isfinite(squares).all(axis=1)]
    return made.mean(axis=0) if len(made) else np.full(TAXELS, np.nan)


MOST_LOSING: Final = 0.2  # share of the pads that a sensor may be, its mean over some presses each
OWN: Final = "this model"
REPLACED: Final = "the model that is there"  # under the name of the new one
UNLIKE: Final = "pads a fifth unlike it"
TAPPED: Final = "own taps at other poses"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, with exit code 1 where no model was handed over."""
    options = _parser().parse_args(arguments)
    with ended_by_errors("train.own"):
        _train(options)


def _train(options: argparse.Namespace) -> None:
    out: Path = options.out
    work = out / "work"
    work.mkdir(parents=True, exist_ok=True)
    file = load_sensor_file(options.sensor_file)
    knowledge = knowledge_of(file, options.sensor)
    say(knowledge.told())
    grips = [] if options.recordings is None else grips_of(options.recordings, knowledge.name, file)
    middle = constants(knowledge.middle())
    taps = {} if options.taps is None else load_tap_parts(options.taps, knowledge.name, knowledge.pad, middle)
    handed = out / f"{out.resolve().name}.onnx"
    beside = {one.name: one for one in map(ModelSession, options.beside)}
    beside |= {REPLACED: ModelSession(handed)} if handed.exists() else {}
    for name, one in beside.items():
        if one.contract.scale != SCALE or (one.contract.taps > 1 and not one.contract.takes_poses):
            got = f"{name} is a model of {one.contract.taps} taps at x{one.contract.scale}"
            raise DatasetError(f"{got}, expected one of a single tap, or of several with poses, at x{SCALE}")
    if not knowledge.pad.constants and knowledge.pad.gains_certainty < FIFTH:
        raise DatasetError(
            "nothing is known of this sensor, and a model for any sensor is there: lay a weight on it with "
            "edge-sr doctor, let edge-sr learn its gains from contacts, or find constants by train.identify"
        )
    meshes = [mesh_name(path, options.unit_mm) for path in options.mesh]
    for mesh in meshes:
        say(size_of(mesh))
    families = dict(SHARES) | dict.fromkeys(meshes, 20.0)
    world = World(families=families, ranges=knowledge.ranges, seed=options.seed)
    if not (grips or taps or options.without_recordings):
        raise DatasetError(
            "nothing to compare it on: a model for the wrong pad draws what looks right, so pass --recordings or "
            "--taps, or --without-recordings to rely on the sensor file alone"
        )
    plan = plan_of(options.minutes, world, work)
    path, judges = trained(knowledge, world, plan, COMPARED, work / f"{handed.stem}.pt", taps.get("training"))
    judges |= {TAPPED: taps["test"]} if taps else {}
    verdict = compared(ModelSession(path), knowledge, judges, grips, beside)
    say(verdict.table)
    if verdict.objection is not None:
        say(f"not handed over: {verdict.objection}")
        sys.exit(1)
    write_in_place(handed, lambda draft: draft.write_bytes(path.read_bytes()), load_session)
    say(f"from now on: edge-sr --sensor {options.sensor_file} --model {handed}")


def trained(
    knowledge: Knowledge, world: World, plan: Plan, compared_on: int, checkpoint: Path, taps: PressSet | None = None
) -> tuple[Path, dict[str, PressSet]]:
    """Make presses of a world, train on them, and export the model; return it and the sets that it is to be judged on.

    A set has `compared_on` presses. All is kept next to the checkpoint, so that an interrupted call resumes.
    """
    work, name = checkpoint.parent, checkpoint.stem
    even = replace(world, families=dict.fromkeys(world.families, 1.0), count=compared_on, per_pad=6, begun=0.0)
    sets = dict.fromkeys(("validation", "test", "all families"), even) | {
        "figures": replace(even, families=dict.fromkeys(FIGURES, 1.0)),
        UNLIKE: replace(even, ranges=knowledge.widened()),
    }
    made, presses = {}, make_presses(replace(world, count=plan.presses), work / "presses.npz")
    for number, (what, of) in enumerate(sets.items(), 1):
        path = work / f"{what.replace(' ', '-')}.npz"
        made[what] = make_presses(replace(of, seed=world.seed + 1000 * number), path)
    sensor = knowledge.sensor()
    frozen = freeze_presses(made["validation"], SEED, sensor.nuisances).as_frozen_set()
    report = fit_network(_training(name, sensor, plan.steps), presses, frozen, work, taps)
    say(f"{report['steps']} steps in {report['elapsed_s'] / 60:.1f} minutes")
    return _exported(work, name), {what: made[what] for what in list(sets)[2:]}


def _exported(work: Path, name: str) -> Path:
    """Return the model of a checkpoint, in 8-bit integers: what they cost is part of the comparison."""
    # A command of its own: the export is the floor above, and needs the memory that training leaves.
    command = [sys.executable, "-m", "export.to_onnx", work / f"{name}.pt", "--out", work]
    command += ["--validation", work / "validation.npz", "--test", work / "test.npz", "--int8", work / "presses.npz"]
    command += ["--trust", find_model(DEFAULT_MODEL)]
    path = work / f"{name}{INT8_SUFFIX}.onnx"
    path.unlink(missing_ok=True)
    subprocess.run([*map(str, command)], check=False)
    if not path.is_file():
        raise TrainError("the export has failed; see the lines above")
    return path


def plan_of(minutes: float, world: World, folder: Path) -> Plan:
    """Return the plan that a folder has of an earlier run with the same time, or one by the speed of this machine."""
    path = folder / "plan.json"
    if path.exists() and (kept := json.loads(path.read_text()))["minutes"] == minutes:
        return Plan(kept["presses"], kept["steps"])
    press_s, step_s = tried(world, folder)
    left_s = max(60 * minutes - REST_S, 0)
    presses = min(int(SIMULATING * left_s / press_s), MOST_PRESSES)
    plan = Plan(max(presses, TRIED), max(int((left_s - presses * press_s) / step_s), 1))
    parts = (plan.presses * press_s / 60, plan.steps * step_s / 60, REST_S / 60)
    say(
        f"about {sum(parts):.0f} minutes: {parts[0]:.1f} for {plan.presses} presses, {parts[1]:.1f} for "
        f"{plan.steps} steps, {parts[2]:.1f} to export and to compare"
    )
    text = json.dumps({"minutes": minutes, "presses": plan.presses, "steps": plan.steps}) + "\n"
    write_in_place(path, lambda draft: draft.write_text(text), lambda draft: draft.read_text(), keep_before=False)
    return plan


def say(line: str) -> None:
    """Write a line of a program at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.own", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("sensor_file", type=Path, metavar="SENSOR.toml", help="sensor file, as edge-sr doctor --out writes it")
    add("--out", type=Path, required=True, help="folder for everything; its name is the model's")
    add("--sensor", metavar="NAME", help="which sensor of the file (default: its only one)")
    add("--recordings", type=Path, metavar="FOLDER", help="TRIAL/xela_SENSOR.csv of grips of flat faces, to compare by")
    add("--without-recordings", action="store_true", help="hand it over by simulated presses alone")
    add("--taps", type=Path, metavar="FILE", help="the sensor's own taps, as train.taps makes them, to learn from, too")
    add("--beside", type=Path, action="append", default=[], metavar="MODEL", help="another model to compare with")
    add("--mesh", type=Path, action="append", default=[], metavar="FILE", help="STL, OBJ or PLY file to add")
    add("--unit-mm", type=float, default=1.0, help="unit of the meshes in mm (1)")
    add("--minutes", type=positive, default=20.0, help="about how long all takes (20)")
    add("--seed", type=int, default=1, help="seed of everything random (1)")
    return parser


if __name__ == "__main__":
    main()
