"""Train a network on your own object, and run it: STL, simulated taps, training, ONNX, patterns.

    pip install -e '.[export]'      # in the checkout, in an environment of its own
    python examples/train_and_deploy.py bolt.stl --out bolt                # the real thing, see below
    python examples/train_and_deploy.py bolt.stl --out bolt --minutes 4    # to see whether all of it works

The file is an STL, OBJ or PLY in millimetres. Its taps are simulated: presses into the pad at random places and
turns; training adds the noise, drift and dead taxels of real sensors. The defaults, 9000 presses and 16000 steps, are
those of the first bundled networks and take about an hour on two cores; before it begins it prints how long they take
here, by a few presses and steps that it tries. The same command resumes an interrupted run; after --minutes name the
presses and steps that it printed, as --sequences and --steps.

At the end the model is compared, on presses of the object that it was not trained on, with the bundled model and with
bilinear interpolation. Only one that is better than both is handed over, as OUT/NAME.onnx: four minutes are too few.

A network that was trained on one object alone draws that object for every contact, and looks right. Unless nothing
else can be touched, add --figures 9000: random figures as well, as for the bundled networks.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

try:
    import torch

    from export.to_onnx import main as export
except ModuleNotFoundError as error:
    sys.exit(f"train_and_deploy: {error}: pip install -e '.[export]' in the checkout")

from edge.api import (
    DEFAULT_MODEL,
    BridgeError,
    EdgeError,
    NoDeviceError,
    Stream,
    find_model,
    load_model,
    open_runtime,
    open_source,
)
from edge.evaluation.classical_methods import fitted_methods
from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import BUNDLE_DIR
from train.data.make_presses import main as make_presses
from train.data.presses import load_presses
from train.fit import main as fit
from train.networks.registry import build

NETWORK = "compact-stsr"
TRIED = 8
"""Presses, and steps, that are tried for an estimate."""
REST_STEPS = 150
"""Steps that take as long as all else: importing, the validation set, the export and its checks."""
JUDGED = 60
"""Presses, each on a pad of its own, by which the model is compared with others."""


def tried(mesh: Path) -> tuple[float, float]:
    """Return how long a press takes with all processors, and a step of training, in [s]."""
    seconds: list[float] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        for name in ("first", "second"):  # the first one also loads what is loaded once
            start_s = time.monotonic()
            taps(Path(folder) / f"{name}.npz", ["--families", "none", "--mesh", str(mesh)], TRIED, 1)
            seconds.append(time.monotonic() - start_s)
    press_s = min(seconds) / TRIED / len(os.sched_getaffinity(0))
    net, window, seconds = build(NETWORK, 10), torch.randn(64, 3, 4, 4), []
    for _ in range(TRIED):
        start_s = time.monotonic()
        outputs: tuple[torch.Tensor, ...] = net(window)
        loss = torch.stack([output.mean() for output in outputs]).sum()
        torch.autograd.grad(loss, list(net.parameters()), allow_unused=True)
        seconds.append(time.monotonic() - start_s)
    return press_s, sorted(seconds)[TRIED // 2]


def fitted(minutes: float, presses: int, steps: int, press_s: float, step_s: float) -> tuple[int, int]:
    """Return fewer presses and steps, in their proportion, that take so many minutes together."""
    share = (60 * minutes - REST_STEPS * step_s) / (presses * press_s + steps * step_s)
    share = min(max(share, 0.005), 1.0)
    return max(round(share * presses), 1), max(round(share * steps), 1)


def train(mesh: Path, out: Path, *, sequences: int, figures: int, steps: int, seed: int) -> Path:
    """Train a model from a mesh, and return its file; each call is also a command of its own."""
    out.mkdir(parents=True, exist_ok=True)
    name, checkpoints = out.resolve().name, out / "checkpoints"
    data = [taps(out / "object.npz", ["--families", "none", "--mesh", str(mesh)], sequences, seed)]
    if figures > 0:
        data.append(taps(out / "figures.npz", ["--families", "glyph,polygon"], figures, seed + 1))
    # python -m train.fit ...
    network = ["--network", NETWORK, "--name", name, "--steps", str(steps), "--seed", str(seed)]
    fit([str(checkpoints), "--data", *data, *network])
    # python -m export.to_onnx ...; compares ONNX with torch. The error in it is on the frozen test set, letters and
    # shapes, so it is the network's on objects that it was not trained for.
    export([str(checkpoints / f"{name}.pt"), "--out", str(checkpoints)])
    return checkpoints / f"{name}.onnx"


def is_better(model: Path, mesh: Path, out: Path, seed: int) -> bool:
    """Compare a model with others on presses of the object that none was trained on; print and return the verdict."""
    options = ["--families", "none", "--mesh", str(mesh), "--per-pad", "1"]
    presses = load_presses(Path(taps(out / "unseen.npz", options, JUDGED, seed)))
    counts, truth = presses.counts[:, 0].astype(np.float32), presses.patterns.astype(np.float32)
    own, bundled = (load_model(one) for one in (model, find_model(DEFAULT_MODEL)))

    def error_db(patterns: NDArray[np.float32]) -> NDArray[np.float64]:
        return psnr_db(patterns, truth, own.contract.output_full_scale)

    patterns = {
        one.name: np.stack([one.run(one.contract.scale_window(scan[None])).copy() for scan in counts])
        for one in (own, bundled)
    }
    patterns["bilinear"] = fitted_methods(BUNDLE_DIR / "classical.npz", own.contract.scale)["bilinear"](counts)
    found = {name: error_db(one) for name, one in patterns.items()}
    print(f"{len(counts)} presses of {mesh.name} that it was not trained on, PSNR (more is better): ", end="")
    print(", ".join(f"{name} {values.mean():.1f} dB" for name, values in found.items()))
    for name, values in found.items():
        gain_db = found[own.name] - values
        if name != own.name and gain_db.mean() < 2 * gain_db.std() / np.sqrt(len(gain_db)):
            print(f"not handed over: it is not better than {name}. Train it for longer, or use {bundled.name}.")
            return False
    return True


def taps(out: Path, options: list[str], count: int, seed: int) -> str:
    """Simulate taps: python -m train.data.make_presses ..."""
    code = make_presses([str(out), *options, "--count", str(count), "--seed", str(seed)])
    if code != 0:
        sys.exit(code)  # it has printed the reason
    return str(out)


def deploy(model: Path, source_text: str | None, duration_s: float) -> None:
    """Run the model, as `edge-sr --model FILE` does; without a source and an adapter, only say how."""
    then = f"from now on: edge-sr --model {model}"
    try:
        source = open_source(*filter(None, [source_text]))
    except NoDeviceError as error:
        if source_text is not None:
            raise
        print(f"not tried on a sensor: {error}\n{then}")
        return
    session = load_model(model)
    print(f"{session.name}: error on the frozen test set {session.contract.test_error}")
    patterns = 0
    with source:
        for result in Stream(source, open_runtime(session, source), duration_s=duration_s):
            if result.pattern is not None:
                patterns += 1
                print(
                    f"{result.source} sensor {result.scan.sensor}: pattern {result.pattern.shape} in "
                    f"{result.pattern_unit}, deepest {result.pattern.max():.2f}, {result.area_mm2:.0f} mm2 touch"
                )
    print(f"{patterns} patterns; {then}")


def main() -> None:
    """Train, then run."""
    parser = argparse.ArgumentParser(description="Train on an object of your own, and run the model.")
    parser.add_argument("mesh", type=Path, help="STL, OBJ or PLY, in millimetres")
    parser.add_argument("--out", type=Path, required=True, help="folder for everything; its name is the model's")
    parser.add_argument("--sequences", type=int, default=9000, help="simulated presses (9000)")
    parser.add_argument("--figures", type=int, default=0, help="number of random figures to press in addition (0)")
    parser.add_argument("--steps", type=int, default=16_000, help="training steps (16000)")
    parser.add_argument("--minutes", type=float, help="take fewer presses and steps, for about so many minutes")
    parser.add_argument("--seed", type=int, default=1, help="seed of everything random (1)")
    parser.add_argument(
        "--source", help="source to try it on, as for edge-sr (default: the adapter plugged in, if any)"
    )
    parser.add_argument("--duration-s", type=float, default=10, help="seconds to try it (10)")
    options = parser.parse_args()
    try:
        if options.source is not None:
            open_source(options.source)  # a form that does not exist is refused now, not after the training
        press_s, step_s = tried(options.mesh)
        sequences, figures, steps = options.sequences, options.figures, options.steps
        if options.minutes is not None:
            presses, steps = fitted(options.minutes, sequences + figures, steps, press_s, step_s)
            figures = round(presses * figures / (sequences + figures))
            sequences = max(presses - figures, 1)
        simulating, training, rest = (sequences + figures) * press_s, steps * step_s, REST_STEPS * step_s
        print(
            f"about {(simulating + training + rest) / 60:.1f} minutes on this machine: {simulating / 60:.1f} to "
            f"simulate {sequences + figures} presses, {training / 60:.1f} for {steps} steps of training, "
            f"{rest / 60:.1f} for the rest",
            flush=True,
        )
        start_s = time.monotonic()
        model = train(options.mesh, options.out, sequences=sequences, figures=figures, steps=steps, seed=options.seed)
        print(f"trained in {(time.monotonic() - start_s) / 60:.1f} minutes")
        if not is_better(model, options.mesh, options.out, options.seed + 1000):
            sys.exit(1)
        deploy(model.replace(options.out / model.name), options.source, options.duration_s)
    except BrokenPipeError:  # the reader has closed; point stdout elsewhere, or Python reports an error at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        pass  # the with statement has closed everything
    except (BridgeError, EdgeError) as error:
        sys.exit(f"train_and_deploy: {error}")


if __name__ == "__main__":
    main()
