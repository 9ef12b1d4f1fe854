"""Train a network on your own object, and run it: STL, simulated taps, training, ONNX, patterns.

    pip install '.[export]'
    python train_and_deploy.py bolt.stl --out bolt                    # the real thing, see below
    python train_and_deploy.py bolt.stl --out bolt --sequences 32 --steps 20    # whether all of it works

The file is an STL, OBJ or PLY in millimetres. Its taps are simulated: presses into the pad at random places and
turns; training adds the noise, drift and dead taxels of real sensors. The defaults, 9000 presses and 16000 steps, are
those of the bundled networks and take about an hour on two cores. The same command resumes an interrupted run.

A network that was trained on one object alone draws that object for every contact, and looks right. Unless nothing
else can be touched, add --figures 9000: random figures as well, as for the bundled networks.
"""

import argparse
import os
import sys
from pathlib import Path

from edge.api import BridgeError, EdgeError, Stream, load_model, open_runtime, open_source
from export.to_onnx import main as export
from train.fit import main as fit
from train.generate import main as generate


def train(mesh: Path, out: Path, *, sequences: int, figures: int, steps: int, seed: int) -> Path:
    """Train a model from a mesh, and return its file; each call is also a command of its own."""
    out.mkdir(parents=True, exist_ok=True)
    name, checkpoints = out.resolve().name, out / "checkpoints"
    data = [taps(out / "object.npz", ["--mesh", str(mesh)], sequences, seed)]
    if figures > 0:
        kinds = ["--glyphs", str(figures // 2), "--polygons", str(figures - figures // 2)]
        data.append(taps(out / "figures.npz", kinds, figures, seed + 1))
    # python -m train.fit ...
    network = ["--network", "compact-stsr", "--name", name, "--steps", str(steps), "--seed", str(seed)]
    fit([str(checkpoints), "--data", *data, *network])
    # python -m export.to_onnx ...; compares ONNX with torch. Its error is on the frozen test set, letters and shapes,
    # so it shows the network's error on objects that it was not trained for.
    export([str(checkpoints / f"{name}.pt"), "--out", str(out), "--batch", "any"])
    return out / f"{name}.onnx"


def taps(out: Path, surfaces: list[str], count: int, seed: int) -> str:
    """Simulate taps: python -m train.generate ..."""
    code = generate(
        [str(out), "--surfaces", "none", *surfaces, "--count", str(count), "--taps", "1", "--seed", str(seed)]
    )
    if code != 0:
        sys.exit(code)  # it has printed the reason
    return str(out)


def deploy(model: Path, source_text: str | None, duration_s: float) -> None:
    """Run the model, as `edge-sr --model FILE` does."""
    session = load_model(model)
    print(f"{session.name}: error on the frozen test set {session.contract.test_error}")
    patterns = 0
    with open_source(*filter(None, [source_text])) as source:
        for result in Stream(source, open_runtime(session, source), duration_s=duration_s):
            if result.pattern is not None:
                patterns += 1
                print(
                    f"{result.source} sensor {result.scan.sensor}: pattern {result.pattern.shape} in "
                    f"{result.pattern_unit}, deepest {result.pattern.max():.2f}, {result.area_mm2:.0f} mm2 touch"
                )
    print(f"{patterns} patterns; from now on: edge-sr --model {model}")


def main() -> None:
    """Train, then run."""
    parser = argparse.ArgumentParser(description="Train on an object of your own, and run the model.")
    parser.add_argument("mesh", type=Path, help="STL, OBJ or PLY, in millimetres")
    parser.add_argument("--out", type=Path, required=True, help="folder for everything; its name is the model's")
    parser.add_argument("--sequences", type=int, default=9000, help="simulated presses (9000)")
    parser.add_argument("--figures", type=int, default=0, help="number of random figures to press in addition (0)")
    parser.add_argument("--steps", type=int, default=16_000, help="training steps (16000)")
    parser.add_argument("--seed", type=int, default=1, help="seed of everything random (1)")
    parser.add_argument("--source", help="source to try it on, as for edge-sr (default: the adapter plugged in)")
    parser.add_argument("--duration-s", type=float, default=10, help="seconds to try it (10)")
    options = parser.parse_args()
    model = train(
        options.mesh,
        options.out,
        sequences=options.sequences,
        figures=options.figures,
        steps=options.steps,
        seed=options.seed,
    )
    try:
        deploy(model, options.source, options.duration_s)
    except BrokenPipeError:  # the reader has closed; point stdout elsewhere, or Python reports an error at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        pass  # the with statement has closed everything
    except (BridgeError, EdgeError) as error:
        sys.exit(f"train_and_deploy: {error}")


if __name__ == "__main__":
    main()
