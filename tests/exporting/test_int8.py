"""Graphs in integers: which convolutions, of which ranges, and that light contacts are among what they are taken of."""

import numpy as np
import onnx
import pytest
import torch
from export_samples import PRESSES, made_once, small_models

from edge.inference.onnx_session import ModelSession
from export.graph import ExportError
from export.int8 import calibration_batch, convolutions, integer_nodes, quantised
from train.data.press_batches import Batch


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return made_once(tmp_path_factory, small_models) / "sure.onnx"


@pytest.fixture(scope="module")
def model(path):
    return onnx.load(path)


@pytest.fixture(scope="module")
def windows():
    return np.random.default_rng(0).normal(size=(64, 6, 4, 4)).astype(np.float32)


@pytest.fixture(scope="module")
def seen(windows, model):
    """Batch that ranges are taken from; its truth is not used."""
    known = model.graph.input[1].type.tensor_type.shape.dim[1].dim_value
    return Batch(torch.from_numpy(windows), torch.zeros(len(windows), 40, 40), pad=torch.zeros(len(windows), known))


@pytest.fixture(scope="module")
def integers(model, seen):
    return quantised(model, seen)


def test_the_largest_grid_is_in_integers_but_for_outputs(model, integers):
    weights = {node.name: node.input[1] for node in model.graph.node if node.op_type == "Conv"}
    chosen = {weights[name] for name in integer_nodes(model) if name in weights}
    trunk = {f"trunk.0.body.{layer}.weight" for layer in (0, 2)}
    assert chosen == trunk | {"leave.0.weight", "uncertainty.0.weight"}
    assert (convolutions(model), convolutions(integers)) == ((0, 16), (4, 16)), "once optimised"


def test_the_same_windows_give_the_same_bytes(model, seen, integers):
    before = model.SerializeToString(deterministic=True)
    again = quantised(model, seen)
    assert again.SerializeToString(deterministic=True) == integers.SerializeToString(deterministic=True)
    assert model.SerializeToString(deterministic=True) == before


def test_a_graph_without_convolutions_is_refused(seen):
    ends = [[onnx.helper.make_tensor_value_info(name, 1, [1, 6, 4, 4])] for name in ("window", "pattern")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["window"], ["pattern"])], "none", *ends)
    with pytest.raises(ExportError, match=r"no convolution .* without --int8"):
        quantised(onnx.helper.make_model(graph), seen)


def test_ranges_are_of_light_contacts_and_all_numbers_of_taps(path):
    contract = ModelSession(path).contract
    windows = calibration_batch(PRESSES, contract).window.numpy()
    assert windows.shape == (64, 6, 4, 4)
    assert np.array_equal(windows, calibration_batch(PRESSES, contract).window.numpy())
    size = np.abs(windows[:, :3]).max(axis=(1, 2, 3))
    assert size.min() < 0.3 * size.max()
    given = (np.abs(windows[:, 3:]).max(axis=(1, 2, 3)) > 0).mean()
    assert 0.2 < given < 0.8
    with pytest.raises(ExportError, match="31 sequences to take ranges of, expected 32 or more"):
        calibration_batch(PRESSES.pick(np.arange(31)), contract)
