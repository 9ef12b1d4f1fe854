"""Graphs in integers: which convolutions, of which ranges, and that light contacts are among what they are taken of."""

import numpy as np
import onnx
import pytest
import torch
from dataset_samples import make_sequences
from onnx import numpy_helper
from test_export import at_frames, frozen_at, save_untrained

from edge.inference.contract import Contract
from edge.inference.onnx_session import ModelSession
from export.errors import ExportError
from export.graphs.graph import to_model
from export.graphs.parity import GraphRun
from export.quantisation.int8 import calibration_batch, convolutions, quantised, rounded_ranges
from export.quantisation.integer_nodes import integer_nodes, newest_values
from export.to_onnx import export
from firmware_bridge.pad_geometry import USPA44
from train.data.batch import Batch
from train.networks.registry import build
from train.networks.symmetric import write_out


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return write_out(build("compact-mtsr2", 10, channels=16, blocks=2).eval())


@pytest.fixture(scope="module")
def model(net):
    return to_model(net, USPA44)


@pytest.fixture(scope="module")
def windows():
    return np.random.default_rng(0).normal(size=(64, 6, 4, 4)).astype(np.float32)


@pytest.fixture(scope="module")
def seen(windows):
    """Batch that ranges are taken from; its truth is not used."""
    return Batch(torch.from_numpy(windows), torch.zeros(len(windows), 40, 40))


def test_the_largest_grid_is_done_in_integers_but_for_what_gives_the_outputs(model):
    weights = {node.name: node.input[1] for node in model.graph.node if node.op_type == "Conv"}
    chosen = {weights[name] for name in integer_nodes(model) if name in weights}
    trunk = {f"trunk.{block}.body.{layer}.weight" for block in (0, 1) for layer in (0, 2)}
    assert chosen == trunk | {"leave.0.weight", "uncertainty.0.weight"}


def test_of_the_papers_network_all_but_the_last(seen):
    model = to_model(build("mtsr2", 4).eval(), USPA44)
    assert sum(node.op_type == "Conv" for node in model.graph.node) == 40
    whole = quantised(model, Batch(seen.window[:4], seen.pattern[:4]))
    assert convolutions(whole) == (39, 40)


def test_they_run_in_integers_once_optimised(model, seen):
    assert convolutions(model) == (0, 18)
    assert convolutions(quantised(model, seen)) == (6, 18)


def test_weights_have_a_scale_for_each_channel_and_activations_are_unsigned(model, seen):
    held = {weight.name: numpy_helper.to_array(weight) for weight in quantised(model, seen).graph.initializer}
    scale, zero = held["trunk.0.body.0.weight_scale"], held["trunk.0.body.0.weight_zero_point"]
    assert scale.shape == (16,) and len(set(scale.tolist())) > 1
    assert zero.dtype == np.int8 and not zero.any()
    points = [value.dtype for name, value in held.items() if name.endswith("_zero_point") and value.shape == ()]
    assert points.count(np.uint8) >= 6


def test_the_same_windows_give_the_same_bytes(model, seen):
    once, again = (quantised(model, seen).SerializeToString(deterministic=True) for _ in range(2))
    assert once == again


def test_the_given_graph_is_left_as_it_was(model, seen):
    before = model.SerializeToString(deterministic=True)
    quantised(model, seen)
    assert model.SerializeToString(deterministic=True) == before


def test_a_batch_of_them_computes_what_one_does(net, model, windows, seen):
    together = quantised(to_model(net, USPA44, batch=5), seen)  # 64 windows are no multiple of 5
    for many, one in zip(GraphRun(together)(windows), GraphRun(quantised(model, seen))(windows), strict=True):
        assert np.abs(many - one).max() < 0.02 * np.abs(one).max()


def test_windows_beyond_any_touch_widen_the_ranges(model, windows, seen):
    one = Batch(seen.window[:1].repeat(32, 1, 1, 1), seen.pattern[:32])
    narrow, wide = (rounded_ranges(quantised(model, one, beyond=beyond)) for beyond in (None, windows))
    assert narrow.keys() == wide.keys()
    assert all(wide[name][0] <= low and wide[name][1] >= high for name, (low, high) in narrow.items())
    factors = {name: wide[name][1] / high for name, (_, high) in narrow.items()}
    own = newest_values(model) & factors.keys()
    assert max(factors[name] for name in own) == pytest.approx(1.3, rel=0.02), "of its own layers none further"
    assert max(factors[name] for name in factors.keys() - own) > 1.35


def test_too_few_taps_have_no_ranges(contract):
    with pytest.raises(ExportError, match="31 sequences to take ranges of, expected 32 or more"):
        calibration_batch(make_sequences(count=31), contract)


def test_a_graph_without_convolutions_is_refused(seen):
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Relu", ["window"], ["pattern"])],
        "none",
        *[[onnx.helper.make_tensor_value_info(name, 1, [1, 6, 4, 4])] for name in ("window", "pattern")],
    )
    with pytest.raises(ExportError, match=r"no convolution .* without --int8"):
        quantised(onnx.helper.make_model(graph), seen)


@pytest.fixture(scope="module")
def contract(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    path = save_untrained(folder / "one.pt", "compact-mtsr2", 10, channels=16, blocks=1)
    export(path, folder, at_frames(frozen_at(10), slice(0, 96, 30)))
    return ModelSession(folder / "one.onnx").contract


def test_ranges_are_taken_of_light_contacts_and_of_every_number_of_taps(contract):
    sequences = make_sequences(count=60)
    windows = calibration_batch(sequences, contract).window.numpy()
    assert windows.shape == (60, 6, 4, 4)
    assert np.array_equal(windows, calibration_batch(sequences, contract).window.numpy())
    size = np.abs(windows[:, :3]).max(axis=(1, 2, 3))
    assert size.min() < 0.1 * size.max()
    given = (np.abs(windows[:, 3:]).max(axis=(1, 2, 3)) > 0).mean()
    assert 0.2 < given < 0.8


def test_the_export_writes_another_file_that_says_what_it_is(tmp_path):
    path = save_untrained(tmp_path / "one.pt", "compact-mtsr2", 10, channels=16, blocks=1)
    frozen = frozen_at(10)
    line = export(path, tmp_path, frozen, calibration=make_sequences(count=40))
    assert line.startswith("one-int8.onnx: ") and "4 of 16 convolutions in int8" in line and "dB lost" in line
    model = onnx.load(tmp_path / "one-int8.onnx")
    contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
    assert contract.arithmetic == "int8" and set(contract.test_error) == {"1", "2"}
    assert not (tmp_path / "one.onnx").exists()
    export(path, tmp_path, frozen)
    in_float = ModelSession(tmp_path / "one.onnx").contract
    assert in_float.arithmetic == "float32" and in_float.test_error != contract.test_error
