"""Report on taps from known poses, in miniature: every table is there, and the model is one that takes poses."""

import csv
import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from dataset_samples import make_sequences
from onnx import helper
from press_samples import make_press_set
from trust_samples import linear, make_posed_trust

from edge.inference.contract import ANY_BATCH, KEY_PREFIX
from edge.inference.familiarity import Check
from edge.inference.onnx_session import ModelSession
from export.to_onnx import export
from train.data.frozen_presses import freeze_presses
from train.experiments.__main__ import main
from train.experiments.sensor.posed_taps import MODEL, SCHEDULES, _guarded, _off
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, load_network
from train.learning.training_loop import Recipe
from train.networks.fusion import FusionNet
from train.physics.pad_draws import INPUTS, KNOWN
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
    net, _ = load_network(folder / "posed.pt")
    assert isinstance(net, FusionNet)
    for free in net.receive.parameters():  # one step is too few for earlier taps to matter
        torch.nn.init.normal_(free, 0, 0.1)
    torch.save(net.state_dict(), folder / "posed.pt")
    frozen = freeze(make_sequences(taps=7, seed=1), Nuisances.none(), seed=1, scale=10)
    export(folder / "posed.pt", folder, frozen, batch=ANY_BATCH)
    model = onnx.load(folder / "posed.onnx")
    stated = {entry.key: entry.value for entry in model.metadata_props}
    helper.set_model_props(model, stated | {f"{KEY_PREFIX}trust": json.dumps(make_wide_trust().to_json())})
    onnx.save(model, folder / f"{MODEL}.onnx")
    return folder


def make_wide_trust():
    """Return checks for all constants of a pad, by which earlier taps farther than 3 mm along x do not belong."""
    trust, constants = make_posed_trust(3.0), len(INPUTS)
    operator = np.pad(trust.forward.operator, ((0, constants + 1 - len(trust.forward.operator)), (0, 0), (0, 0)))
    contact = Check(linear(48 + 1 + 2 * constants + 1, {0: 10.0}), 5.0)
    return replace(trust, forward=replace(trust.forward, operator=operator), contact=contact)


def test_it_runs_in_miniature(models, tmp_path, capsys):
    places = [f"--{place}={tmp_path / place}" for place in ("reports", "data", "checkpoints")]
    main(["posed-taps", "--quick", *places, f"--models={models}"])
    report = tmp_path / "reports" / "posed-taps"
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    assert "quick run" in report.with_suffix(".md").read_text()
    tables = {}
    for part in ("schedules", "known", "families", "begun", "wrong-poses"):
        with report.with_name(f"posed-taps-{part}.csv").open() as file:
            tables[part] = list(csv.DictReader(file))
    assert {row["schedule"] for row in tables["schedules"]} == set(SCHEDULES)
    assert {row["taps"] for row in tables["schedules"]} == {"1", "2", "3", "4", "7"}
    assert all(row["run time us"] for row in tables["schedules"] + tables["begun"])
    mapped = {(row["schedule"], row["taps"]) for row in tables["schedules"] if row["linear map dB"]}
    assert mapped == {(name, taps) for name in ("half-pitch", "turns") for taps in ("1", "4")}
    assert all(row["over one tap, not stated, guarded"] and row["left out %"] for row in tables["wrong-poses"])
    assert [row["off mm"] for row in tables["wrong-poses"]][:4] == ["0.2", "0.5", "1.0", "2.0"]


def test_taps_that_do_not_belong_are_left_out_alone(models):
    rng = np.random.default_rng(0)
    windows, poses = rng.normal(0, 500, (2, 4, 3, 4, 4)).astype(np.float32), np.zeros((2, 4, 5), dtype=np.float32)
    poses[0, 1, 0], poses[1, 2:, 0] = 4.0, 5.0
    kept, left_out = _guarded(ModelSession(models / f"{MODEL}.onnx"), windows, poses)
    assert left_out.tolist() == [[False, True, False, False], [False, False, True, True]]
    assert not kept[left_out].any() and np.array_equal(kept[~left_out], windows[~left_out])


def test_the_papers_schedule_in_miniature(tmp_path, capsys):
    """By the bundled models: those of several taps are given what their number says, next to one tap of the default."""
    main(["paper-schedule", "--quick", *(f"--{place}={tmp_path / place}" for place in ("reports", "data"))])
    report = tmp_path / "reports" / "paper-schedule"
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    with report.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["set"] for row in rows} == {"frozen set", "more sequences"}
    for name in ("frozen set", "more sequences"):
        one, *several = (row for row in rows if row["set"] == name)
        assert (one["model"], one["taps"], one["over one tap"]) == ("stsr-int8", "1", "")
        own, *others = several
        assert (own["model"], own["taps"]) == (f"{MODEL}, its network of several taps", "1")
        assert [(row["model"], row["taps"]) for row in others] == [("mtsr4-int8", "4"), (MODEL, "4"), (MODEL, "7")]
        assert len({row["PSNR dB"] for row in (one, *several)}) == 5, "each sees something else"
        assert all(row["over one tap"] and row["over one tap, by figure"] for row in several)
        assert all(row["run time us"] for row in others)
        assert [bool(row["over its own network with one"]) for row in (one, *several)] == [*[False] * 3, True, True]


def test_poses_are_off_by_just_so_much():
    true = np.zeros((50, 4, 3), dtype=np.float32)
    poses = _off(true, (2.0, 5.0), (0.2, 1.0))
    assert np.hypot(poses[:, 1:, 0], poses[:, 1:, 1]) == pytest.approx(2.0)
    assert np.abs(poses[:, 1:, 2]) == pytest.approx(5.0)
    assert not poses[:, 0].any() and np.allclose(poses[:, 1:, 3:], (0.2, 1.0))
