"""Report on taps from known poses, in miniature: every table is there, and the model is one that takes poses."""

import csv

import numpy as np
import pytest
import torch
from dataset_samples import make_sequences
from press_samples import make_press_set

from edge.inference.contract import ANY_BATCH
from export.to_onnx import export
from train.data.frozen_presses import freeze_presses
from train.experiments.__main__ import main
from train.experiments.sensor.posed_taps import MODEL, SCHEDULES, _off
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network
from train.learning.training_loop import Recipe
from train.physics.pad_draws import KNOWN
from train.physics.sensor_noise import Nuisances


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    training = Training(
        "posed",
        "fusion-mtsr7",
        Recipe(steps=1, batch=4, given=(1 / 7,) * 7),
        options={"channels": 16, "blocks": 2, "known": KNOWN},
    )
    presses = make_press_set(16, taps=7)
    fit_network(training, presses, freeze_presses(presses, 1).as_frozen_set(), folder)
    frozen = freeze(make_sequences(taps=7, seed=1), Nuisances.none(), seed=1, scale=10)
    export(folder / "posed.pt", folder, frozen, batch=ANY_BATCH)
    (folder / "posed.onnx").rename(folder / f"{MODEL}.onnx")
    return folder


def test_it_runs_in_miniature(models, tmp_path, capsys):
    places = [f"--{place}={tmp_path / place}" for place in ("reports", "data", "checkpoints")]
    main(["posed-taps", "--quick", *places, f"--models={models}"])
    report = tmp_path / "reports" / "posed-taps"
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    assert "quick run" in report.with_suffix(".md").read_text()
    tables = {}
    for part in ("schedules", "known", "families", "begun", "wrong poses"):
        with report.with_name(f"posed-taps-{part}.csv").open() as file:
            tables[part] = list(csv.DictReader(file))
    assert {row["schedule"] for row in tables["schedules"]} == set(SCHEDULES)
    assert {row["taps"] for row in tables["schedules"]} == {"1", "2", "3", "4", "7"}
    assert all(row["run time us"] and row["over the peer"] for row in tables["schedules"] + tables["begun"])
    assert [row["off mm"] for row in tables["wrong poses"]][:4] == ["0.2", "0.5", "1.0", "2.0"]


def test_poses_are_off_by_just_so_much():
    true = np.zeros((50, 4, 3), dtype=np.float32)
    poses = _off(true, (2.0, 5.0), (0.2, 1.0))
    assert np.hypot(poses[:, 1:, 0], poses[:, 1:, 1]) == pytest.approx(2.0)
    assert np.abs(poses[:, 1:, 2]) == pytest.approx(5.0)
    assert not poses[:, 0].any() and np.allclose(poses[:, 1:, 3:], (0.2, 1.0))
