"""Export of networks that take poses: any number of taps in one graph, and a network of its own for a single one."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from export_samples import POSED_PRESSES, TAPS, made_once, posed_models, some_frames

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION
from edge.inference.onnx_session import ModelSession
from export.errors import ExportError
from export.graphs.graph import contract_in, network_of
from export.graphs.joined import branches, with_one_tap
from export.graphs.parity import TOLERANCE
from export.quantisation.int8 import convolutions
from export.to_onnx import export
from export.verify import verify
from train.networks.fusion import OneOrMoreNet
from train.physics.pad_draws import KNOWN
from train.surfaces.poses import REACH_MM


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_once(tmp_path_factory, posed_models)


def windows_and_poses(count=3):
    rng = np.random.default_rng(3)
    windows = [rng.normal(0, 0.5, (taps, 3, 4, 4)).astype(np.float32) for taps in range(1, count + 1)]
    poses = [rng.normal(0, (2, 2, 20, 0, 0), (len(window), 5)).astype(np.float32) for window in windows]
    for one in poses:
        one[:, 3:], one[0] = (0.2, 1.0), 0
    return windows, poses


def test_the_contract_states_poses_and_reach(folder):
    contract = ModelSession(folder / "fused.onnx").contract
    assert (contract.version, contract.taps, contract.takes_poses, contract.reach_mm) == (
        *(CONTRACT_VERSION, TAPS, True, REACH_MM),
    )
    assert contract.window_shape == (ANY_BATCH, "taps", 3, 4, 4)
    assert set(contract.test_error) == {"1", "2", "3", "4"}, "with one to four taps of the paper's schedule"
    assert set(contract.interval_levels) == {"50", "80", "90", "95"}


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


def assert_single_taps_are_those_of(one, fused):
    window = windows_and_poses()[0][0]
    expected = one.run(window)
    assert np.array_equal(fused.run(window), expected)
    absent = np.concatenate([window, np.zeros_like(window)])
    assert np.array_equal(fused.run(absent), expected), "absent taps are left out"
    assert fused.contract.contact_level == one.contract.contact_level


def test_a_single_tap_has_the_network_of_one_tap(folder):
    assert_single_taps_are_those_of(*(ModelSession(folder / f"{name}.onnx") for name in ("one", "fused")))
    model = onnx.load(folder / "fused.onnx")
    found = branches(model)
    assert found is not None
    assert convolutions(model)[1] == sum("Conv" in node.op_type for graph in found for node in graph.node)


@pytest.mark.night
def test_in_integers_it_is_near_the_float_and_keeps_its_single_taps(folder, tmp_path):
    for name in ("one", "fused"):
        export(
            folder / f"{name}.pt", tmp_path, some_frames(), batch=ANY_BATCH, calibration=POSED_PRESSES, one_tap="one"
        )
    one, integers = (ModelSession(tmp_path / f"{name}{INT8_SUFFIX}.onnx") for name in ("one", "fused"))
    assert_single_taps_are_those_of(one, integers)
    session = ModelSession(folder / "fused.onnx")
    for window, pose in zip(*windows_and_poses(), strict=True):
        pattern = session.run(window, poses=pose)
        assert np.abs(integers.run(window, poses=pose) - pattern).max() < 0.2 * np.abs(pattern).max()


def test_both_branches_are_verified(folder, tmp_path):
    frozen = some_frames()

    def pattern_off(path):
        rows = [row for row in verify(path, frozen, folder) if row.windows == "one tap"]
        return max(row.differences[0].relative for row in rows)

    assert not [row for row in verify(folder / "fused.onnx", frozen) if row.broken]
    assert pattern_off(folder / "fused.onnx") < TOLERANCE
    model = onnx.load(folder / "fused.onnx")
    graphs = [part.g for node in model.graph.node for part in node.attribute if part.name == "then_branch"]
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
    with pytest.raises(ExportError, match=r"two.onnx: No such file or directory: export the model for single taps"):
        export(folder / "fused.pt", folder, some_frames(), batch=ANY_BATCH, one_tap="two")
