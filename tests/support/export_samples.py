"""A small network as training leaves it, and its model."""

import json
from pathlib import Path
from typing import Any, Final

import torch
from press_samples import make_press_set

from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import find_model
from export.to_onnx import export
from train.data.frozen_presses import freeze_presses
from train.learning.checkpoint import Training, fit_network, load_network
from train.learning.training_loop import Recipe
from train.networks.blocks import PatternNet
from train.physics.pad_draws import KNOWN
from train.trust import load_trust

OPTIONS: Final = {"channels": 16, "blocks": 1, "known": KNOWN}
PRESSES: Final = make_press_set(count=64, taps=2)
SURE: Final = Training("sure", "fusion-mtsr2", Recipe(steps=2, batch=4, given=(0.5, 0.5)), options=OPTIONS)
INTERVALS: Final[dict[str, Any]] = {"validation": PRESSES, "intervals": PRESSES, "steps": 50}
BEFORE: Final = b"the one before"
"""Content of sure.onnx before it is written."""


def some_frames(taps: int = 2) -> FrozenSet:
    """Return a few presses, which are not those of any training."""
    return freeze_presses(make_press_set(24, taps=taps, seed=1), 1).as_frozen_set()


def small_models(folder: Path) -> None:
    """Write sure.pt, and sure.onnx with intervals and checks."""
    fit_network(SURE, PRESSES, some_frames(), folder)
    net, _ = load_network(folder / "sure.pt")
    torch.manual_seed(0)
    with torch.no_grad():
        for name in ("receive", "revise"):  # two steps are too few for earlier taps to matter
            for free in net.get_submodule(name).parameters():
                torch.nn.init.normal_(free, 0, 0.1)
        net.get_parameter("log_reach")[0] += 0.1  # a graph holds equal numbers once
        # The exporter folds weights of 0, and without a lift most patterns would be zero everywhere.
        for weight in net.get_submodule("context").parameters():
            torch.nn.init.normal_(weight, 0, 0.05)
        net.get_parameter("leave.2.bias_free").add_(0.02)
    torch.save(net.state_dict(), folder / "sure.pt")
    (folder / "sure.onnx").write_bytes(BEFORE)
    trust = load_trust(find_model("stsr-int8"))
    export(folder / "sure.pt", folder, some_frames(), trust=trust, **INTERVALS)


def save_checkpoint(path: Path, net: PatternNet, name: str, **options: int) -> Path:
    """Write weights as they are, which is enough to be exported."""
    torch.save(net.state_dict(), path)
    report = {"network": name, "scale": net.scale, "options": options}
    path.with_suffix(".json").write_text(json.dumps(report | {"contact_level": 0.5, "training_sha256": "ab" * 32}))
    return path
