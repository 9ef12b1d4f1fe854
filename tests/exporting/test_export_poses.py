"""Export of networks that take poses: any number of taps in one graph, in float and in integers, with intervals."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from dataset_samples import make_sequences
from press_samples import make_press_set

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION
from edge.inference.onnx_session import ModelSession
from export.errors import ExportError
from export.graphs.intervals import IntervalData
from export.graphs.joined import branches, with_one_tap
from export.graphs.parity import TOLERANCE
from export.graphs.reference import contract_in, network_of
from export.quantisation.int8 import convolutions
from export.to_onnx import export
from export.verify import verify
from train.data.frozen_presses import freeze_presses
from train.errors import DatasetError
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, load_network
from train.learning.training_loop import Recipe
from train.networks.fusion import FusionNet
from train.networks.one_or_more import OneOrMoreNet
from train.physics.pad_draws import KNOWN
from train.physics.sensor_noise import Nuisances
from train.surfaces.tap_schedules import REACH_MM

TAPS = 4
TRAINING = Training(
    "fused",
    "fusion-mtsr4",
    Recipe(steps=3, batch=8, given=(0.25,) * TAPS),
    options={"channels": 16, "blocks": 1, "known": KNOWN},
)


@pytest.fixture(scope="module")
def presses():
    return make_press_set(64, taps=TAPS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, presses):
    """A network that takes poses, as training leaves it, and both graphs of it, with another one for single taps."""
    folder = tmp_path_factory.mktemp("posed")
    validation = freeze_presses(presses, 1).as_frozen_set()
    fit_network(TRAINING, presses, validation, folder)
    fit_network(
        Training("one", "compact-stsr", Recipe(3, batch=8), options=TRAINING.options), presses, validation, folder
    )
    net, _ = load_network(folder / "fused.pt")
    torch.manual_seed(0)
    assert isinstance(net, FusionNet)
    for part in (net.receive, net.revise):  # three steps are too few for earlier taps to matter
        for free in part.parameters():
            torch.nn.init.normal_(free, 0, 0.1)
    torch.save(net.state_dict(), folder / "fused.pt")
    frozen = freeze(make_sequences(taps=TAPS, seed=1), Nuisances.none(), seed=1, scale=10)
    intervals = IntervalData(presses, presses)
    export(folder / "one.pt", folder, frozen, batch=ANY_BATCH, intervals=intervals)
    export(folder / "one.pt", folder, frozen, batch=ANY_BATCH, calibration=presses)
    export(folder / "fused.pt", folder, frozen, batch=ANY_BATCH, intervals=intervals, one_tap="one")
    export(folder / "fused.pt", folder, frozen, batch=ANY_BATCH, calibration=presses, one_tap="one")
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
    assert (contract.version, contract.taps, contract.takes_poses, contract.reach_mm) == (
        *(CONTRACT_VERSION, TAPS, True, REACH_MM),
    )
    assert contract.window_shape == (ANY_BATCH, "taps", 3, 4, 4)
    assert set(contract.test_error) == {"1", "2", "3", "4"}, "with one to four taps of the paper's schedule"


def test_every_number_of_taps_gives_what_the_network_gives(folder):
    session, net = ModelSession(folder / "fused.onnx"), network_of(onnx.load(folder / "fused.onnx"))
    assert isinstance(net, OneOrMoreNet)
    pad = np.zeros(KNOWN, dtype=np.float32)
    for window, poses in zip(*windows_and_poses(), strict=True):
        with torch.inference_mode():
            expected = net(*(torch.from_numpy(one[None]) for one in (window, pad, poses)))
        assert np.allclose(session.run(window, pad, poses), expected[0][0].numpy(), atol=1e-5)
        assert session.deviation is not None
        assert np.allclose(session.deviation, expected[1][0].numpy(), rtol=2e-3, atol=1e-5)


def test_windows_of_different_numbers_of_taps_run_together(folder):
    session = ModelSession(folder / "fused.onnx")
    windows, poses = (list(reversed(given)) for given in windows_and_poses())
    windows, poses = ([given[0], given[2], *given[1:]] for given in (windows, poses))  # a single tap amid others
    alone = [
        [np.array(made) for made in (session.run(window, poses=pose), session.deviation, session.traction)]
        for window, pose in zip(windows, poses, strict=True)
    ]
    together = session.run_together(windows, poses=poses).copy()
    assert np.allclose(together, [pattern for pattern, *_ in alone], atol=1e-5)
    assert session.deviation is not None and session.traction is not None
    assert np.allclose(session.traction, [traction for *_, traction in alone], atol=1e-3)
    assert np.allclose(session.deviation, [deviation for _, deviation, _ in alone], rtol=2e-3, atol=1e-5)
    assert not np.allclose(alone[0][0], session.run(windows[0][:1]), atol=1e-4), "the earlier tap matters"


@pytest.mark.parametrize("suffix", ["", INT8_SUFFIX])
def test_a_single_tap_has_the_network_of_one_tap(folder, suffix):
    one, fused = (ModelSession(folder / f"{name}{suffix}.onnx") for name in ("one", "fused"))
    window = windows_and_poses()[0][0]
    expected = one.run(window)
    assert np.array_equal(fused.run(window), expected)
    absent = np.concatenate([window, np.zeros_like(window)])
    assert np.array_equal(fused.run(absent), expected), "absent taps are left out"
    assert fused.contract.contact_level == one.contract.contact_level
    model = onnx.load(folder / f"fused{suffix}.onnx")
    found = branches(model)
    assert found is not None
    assert convolutions(model)[1] == sum("Conv" in node.op_type for graph in found for node in graph.node)


def test_both_branches_are_verified(folder, tmp_path):
    frozen = freeze(make_sequences(count=4, taps=TAPS, seed=1), Nuisances.none(), seed=1, scale=10)

    def pattern_off(path, checkpoints=folder):
        rows = [row for row in verify(path, frozen, checkpoints) if row.windows == "one tap"]
        return max(row.differences[0].relative for row in rows)

    assert not [row for row in verify(folder / "fused.onnx", frozen) if row.broken]
    assert pattern_off(folder / "fused.onnx") < TOLERANCE
    model = onnx.load(folder / "fused.onnx")
    graphs = [
        attribute.g for node in model.graph.node for attribute in node.attribute if attribute.name == "then_branch"
    ]
    (bias,) = [weight for weight in graphs[0].initializer if weight.name == "force.0.bias"]
    bias.raw_data = (np.frombuffer(bias.raw_data, np.float32) + 1).tobytes()
    onnx.save(model, tmp_path / "fused.onnx")
    assert pattern_off(tmp_path / "fused.onnx") > TOLERANCE


def test_a_model_that_does_not_stand_for_a_single_tap_is_refused(folder):
    one, fused = (contract_in(onnx.load(folder / f"{name}.onnx")) for name in ("one", "fused"))
    with pytest.raises(ExportError, match="for a single tap takes 4: name one of a network of one tap"):
        with_one_tap(fused, fused)
    with pytest.raises(ExportError, match="key 'batch' of the model for a single tap is 1, expected 'any'"):
        with_one_tap(fused, replace(one, batch=1))
    frozen = freeze(make_sequences(count=4, taps=TAPS, seed=1), Nuisances.none(), seed=1, scale=10)
    with pytest.raises(ExportError, match=r"two.onnx: No such file or directory: export the model for single taps"):
        export(folder / "fused.pt", folder, frozen, batch=ANY_BATCH, one_tap="two")


def test_integers_are_near_the_float(folder):
    session, integers = (ModelSession(folder / f"fused{suffix}.onnx") for suffix in ("", INT8_SUFFIX))
    assert integers.contract.arithmetic == "int8"
    for window, pose in zip(*windows_and_poses(), strict=True):
        pattern = session.run(window, poses=pose)
        assert np.abs(integers.run(window, poses=pose) - pattern).max() < 0.2 * np.abs(pattern).max()


def test_what_encodes_earlier_taps_is_in_integers_but_not_what_reads_inputs_or_logarithms(folder):
    found = branches(onnx.load(folder / f"fused{INT8_SUFFIX}.onnx"))
    assert found is not None
    in_integers = {weight.name.partition(".weight_quantized")[0] for weight in found[1].initializer}
    earlier = {"encode.1", "send", "ask", "hear", "compare", "answer"}
    assert earlier | {"trunk.0.body.0", "leave.0", "uncertainty.0"} <= in_integers
    in_float = {"enter", "enter_earlier", "merge.1", "receive", "revise", "share", "leave.2", "uncertainty.2"}
    assert not in_float & in_integers


def test_a_network_with_poses_is_not_trained_on_sequences_without(tmp_path):
    sequences = make_sequences(taps=TAPS)
    frozen = freeze(sequences, Nuisances.none(), seed=1, scale=10)
    with pytest.raises(DatasetError, match="a network that takes poses is trained on presses"):
        fit_network(TRAINING, sequences, frozen, tmp_path)


def test_levels_of_intervals_are_written_of_readings_with_poses(folder):
    levels = ModelSession(folder / "fused.onnx").contract.interval_levels
    assert set(levels) == {"50", "80", "90", "95"}
    assert json.loads((folder / "fused.json").read_text())["taps"] == TAPS
