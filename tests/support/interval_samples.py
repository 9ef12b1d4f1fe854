"""A small model with intervals, in float and in integers, for tests of the export and of the report."""

import json
from pathlib import Path

import pytest
import torch
from dataset_samples import make_sequences
from press_samples import make_press_set

from edge.evaluation.test_set import FrozenSet
from export.graphs.intervals import IntervalData
from export.to_onnx import export
from train.freeze import freeze
from train.learning import interval_fit
from train.networks.registry import build
from train.physics.pad_draws import KNOWN
from train.physics.sensor_noise import Nuisances

LEVEL = 0.3
PRESSES = make_press_set(count=60, taps=2)


def some_frames() -> FrozenSet:
    """Return frames of a few taps, at the scale of the models."""
    return freeze(make_sequences(taps=2, seed=1), Nuisances.none(), seed=1, scale=10)


def export_with_intervals(folder: Path) -> None:
    """Write the checkpoint one.pt of random weights, one.onnx and one-int8.onnx."""
    torch.manual_seed(0)
    options = {"channels": 16, "blocks": 1, "known": KNOWN}
    net = build("compact-mtsr2", 10, **options)
    with torch.no_grad():
        # The exporter folds a factor of 1 and weights of 0, and without a lift most patterns would be zero everywhere.
        net.get_buffer("deviation_scale").fill_(1.5)
        for weight in net.get_submodule("context").parameters():
            torch.nn.init.normal_(weight, 0, 0.05)
        net.get_parameter("leave.2.bias_free").add_(0.02)
    torch.save(net.state_dict(), folder / "one.pt")
    report = {"network": "compact-mtsr2", "scale": 10, "options": options, "contact_level": LEVEL}
    (folder / "one.json").write_text(json.dumps(report | {"training_sha256": "ab" * 32}))
    data, frozen = IntervalData(PRESSES, PRESSES), some_frames()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interval_fit, "_STEPS", 50)
        export(folder / "one.pt", folder, frozen, validation=[frozen], intervals=data)
        export(folder / "one.pt", folder, frozen, validation=[frozen], intervals=data, calibration=PRESSES)
