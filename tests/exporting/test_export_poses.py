"""Export of networks that take poses: any number of taps in one graph, in float and in integers, with intervals."""

import json

import numpy as np
import onnx
import pytest
import torch
from dataset_samples import make_sequences
from press_samples import make_press_set

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import ANY_BATCH
from edge.inference.onnx_session import ModelSession
from export.graphs.intervals import IntervalData
from export.graphs.reference import network_of
from export.to_onnx import export
from train.data.frozen_presses import freeze_presses
from train.errors import DatasetError
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, load_network
from train.learning.training_loop import Recipe
from train.networks.fusion import FusionNet
from train.physics.pad_draws import KNOWN
from train.physics.sensor_noise import Nuisances
from train.surfaces.tap_schedules import REACH_MM

TAPS = 4
TRAINING = Training(
    "fused",
    "fusion-mtsr4",
    Recipe(steps=3, batch=8, given=(0.25,) * TAPS),
    options={"channels": 16, "blocks": 2, "known": KNOWN},
)


@pytest.fixture(scope="module")
def presses():
    return make_press_set(64, taps=TAPS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, presses):
    """A network that takes poses, as training leaves it, and both graphs of it."""
    folder = tmp_path_factory.mktemp("posed")
    fit_network(TRAINING, presses, freeze_presses(presses, 1).as_frozen_set(), folder)
    net, _ = load_network(folder / "fused.pt")
    torch.manual_seed(0)
    assert isinstance(net, FusionNet)
    for part in (net.receive, net.revise):  # three steps are too few for earlier taps to matter
        for free in part.parameters():
            torch.nn.init.normal_(free, 0, 0.1)
    torch.save(net.state_dict(), folder / "fused.pt")
    frozen = freeze(make_sequences(taps=TAPS, seed=1), Nuisances.none(), seed=1, scale=10)
    export(folder / "fused.pt", folder, frozen, batch=ANY_BATCH, intervals=IntervalData(presses, presses))
    export(folder / "fused.pt", folder, frozen, batch=ANY_BATCH, calibration=presses)
    return folder


def windows_and_poses(count=3):
    rng = np.random.default_rng(3)
    windows = [rng.normal(0, 0.5, (taps, 3, 4, 4)).astype(np.float32) for taps in range(1, count + 1)]
    poses = [rng.normal(0, (2, 2, 20, 0, 0), (len(window), 5)).astype(np.float32) for window in windows]
    for one in poses:
        one[:, 3:], one[0] = (0.2, 1.0), 0
    return windows, poses


@pytest.mark.parametrize("name", ["fused", "fused" + INT8_SUFFIX])
def test_the_contract_states_poses_and_reach(folder, name):
    contract = ModelSession(folder / f"{name}.onnx").contract
    assert (contract.version, contract.taps, contract.takes_poses, contract.reach_mm) == (7, TAPS, True, REACH_MM)
    assert contract.window_shape == (ANY_BATCH, "taps", 3, 4, 4)
    assert set(contract.test_error) == {"1", "2", "3", "4"}, "with one to four taps of the paper's schedule"


def test_every_number_of_taps_gives_what_the_network_gives(folder):
    session, net = ModelSession(folder / "fused.onnx"), network_of(onnx.load(folder / "fused.onnx"))
    pad = np.zeros(KNOWN, dtype=np.float32)
    for window, poses in zip(*windows_and_poses(), strict=True):
        with torch.inference_mode():
            expected = net(*(torch.from_numpy(one[None]) for one in (window, pad, poses)))
        assert np.allclose(session.run(window, pad, poses), expected[0][0].numpy(), atol=1e-5)
        assert session.deviation is not None
        assert np.allclose(session.deviation, expected[1][0].numpy(), rtol=2e-3, atol=1e-5)


def test_windows_of_different_numbers_of_taps_share_a_run(folder):
    session = ModelSession(folder / "fused.onnx")
    windows, poses = windows_and_poses()
    alone = [session.run(window, poses=pose).copy() for window, pose in zip(windows, poses, strict=True)]
    assert np.allclose(session.run_together(windows, poses=poses), alone, atol=1e-5)
    assert not np.allclose(alone[1], session.run(windows[1][:1]), atol=1e-4), "the earlier tap matters"


def test_integers_are_near_the_float(folder):
    session, integers = (ModelSession(folder / f"fused{suffix}.onnx") for suffix in ("", INT8_SUFFIX))
    assert integers.contract.arithmetic == "int8"
    for window, pose in zip(*windows_and_poses(), strict=True):
        pattern = session.run(window, poses=pose)
        assert np.abs(integers.run(window, poses=pose) - pattern).max() < 0.2 * np.abs(pattern).max()


def test_a_network_with_poses_is_not_trained_on_sequences_without(tmp_path):
    sequences = make_sequences(taps=TAPS)
    frozen = freeze(sequences, Nuisances.none(), seed=1, scale=10)
    with pytest.raises(DatasetError, match="a network that takes poses is trained on presses"):
        fit_network(TRAINING, sequences, frozen, tmp_path)


def test_levels_of_intervals_are_written_of_readings_with_poses(folder):
    levels = ModelSession(folder / "fused.onnx").contract.interval_levels
    assert set(levels) == {"50", "80", "90", "95"}
    assert json.loads((folder / "fused.json").read_text())["taps"] == TAPS
