"""Train a network on your own object: STL, simulated presses, training, and an ONNX model for edge-sr.

    pip install -e '.[export]'      # in the checkout, in an environment of its own
    python examples/train_and_deploy.py bolt.stl --out bolt                # the real thing, an hour
    python examples/train_and_deploy.py bolt.stl --out bolt --minutes 4    # to see whether all of it works

The file is an STL, OBJ or PLY in millimetres. It is pressed into simulated pads at random places and turns; training
adds the noise, drift and dead taxels of real sensors. Before it begins it prints how many presses and steps fit into
the minutes here, by a few that it tries. The same command resumes an interrupted run.

At the end the model is compared, on presses of the object that it was not trained on, with the bundled model and with
bilinear interpolation. Only one that is better than both is handed over, as OUT/NAME.onnx: four minutes are too few.

A network that was trained on one object alone draws that object for every contact, and looks right. Unless nothing
else can be touched, add --figures 0.5: half of the presses are then of random figures.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

try:
    from export.to_onnx import main as export
except ModuleNotFoundError as error:
    sys.exit(f"train_and_deploy: {error}: pip install -e '.[export]' in the checkout")

from edge.api import load_model
from edge.terminal.argument_types import positive
from firmware_bridge.in_place import write_in_place
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import freeze_presses
from train.data.make_presses import make_presses
from train.data.presses import SEED
from train.data.world import World
from train.errors import ended_by_errors
from train.learning.checkpoint import Training, fit_network
from train.learning.sensor_knowledge import Knowledge
from train.learning.training_loop import Recipe
from train.own import REPLACED, compared, plan_of
from train.physics.pad_draws import KNOWN, RANGES
from train.surfaces.meshes import mesh_name, size_of

UNSEEN = 240
"""Presses by which the network is calibrated, and as many by which it is compared, on pads of their own."""


def train(mesh: Path, out: Path, *, minutes: float, figures: float, seed: int) -> bool:
    """Train a model from a mesh, as OUT/NAME.onnx, and return True if it is better than the bundled one."""
    work, name, surface = out / "work", out.resolve().name, mesh_name(mesh)
    work.mkdir(parents=True, exist_ok=True)
    print(size_of(surface), flush=True)
    handed = out / f"{name}.onnx"
    before = {REPLACED: load_model(handed)} if handed.exists() else {}
    shares = {surface: 1 - figures, "glyph": figures / 2, "polygon": figures / 2}
    world = World(families={family: share for family, share in shares.items() if share}, seed=seed)
    plan = plan_of(minutes, world, work)
    unseen = World(families={surface: 1.0}, count=UNSEEN, per_pad=6)
    presses = make_presses(replace(world, count=plan.presses), work / "presses.npz")
    validation, test = (
        make_presses(replace(unseen, seed=seed + more), work / f"{what}.npz")
        for what, more in (("validation", 1000), ("test", 2000))
    )
    recipe = Recipe(plan.steps, bf16=True)
    training = Training(name, "compact-stsr", recipe, options={"known": KNOWN}, seed=seed)
    fit_network(training, presses, freeze_presses(validation, SEED).as_frozen_set(), work)
    # Compares ONNX with torch. The error in it is on the frozen test set, letters and shapes, so it is the network's on
    # objects that it was not trained for.
    export([str(work / f"{name}.pt"), "--out", str(work), "--validation", str(work / "validation.npz")])
    own, any_sensor = load_model(work / f"{name}.onnx"), Knowledge("any", Pad(), RANGES)
    verdict = compared(own, any_sensor, {f"presses of {mesh.name}": test}, [], before)
    print(verdict.table)
    if verdict.objection is not None:
        print(f"not handed over: {verdict.objection}. Train it for longer, or use the bundled model.")
        return False
    write_in_place(handed, lambda draft: draft.write_bytes((work / f"{name}.onnx").read_bytes()), load_model)
    return True


def main() -> None:
    """Train, and say how to run the model."""
    parser = argparse.ArgumentParser(description="Train on an object of your own.")
    add = parser.add_argument
    add("mesh", type=Path, help="STL, OBJ or PLY, in millimetres")
    add("--out", type=Path, required=True, help="folder for everything; its name is the model's")
    add("--minutes", type=positive, default=60.0, help="about how long all takes (60)")
    add("--figures", type=float, default=0.0, help="share of the presses that are of random figures (0)")
    add("--seed", type=int, default=1, help="seed of everything random (1)")
    options = parser.parse_args()
    with ended_by_errors("train_and_deploy"):
        out, minutes = options.out, options.minutes
        if not train(options.mesh, out, minutes=minutes, figures=options.figures, seed=options.seed):
            sys.exit(1)
    print(f"from now on: edge-sr --model {out / out.resolve().name}.onnx")


if __name__ == "__main__":
    main()
