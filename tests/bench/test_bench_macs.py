"""Multiply-accumulates, counted without an ONNX library, against those of the network itself; and the peak."""

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from edge.bench.contenders import Subject, peer_weights, taps_of
from edge.bench.macs import counted, macs_of
from edge.bench.peak import peak_gmac_s, product_model
from edge.errors import ModelError
from edge.inference.bundled import find_model
from edge.inference.onnx_session import ModelSession
from export.graphs.reference import network_of
from export.peer import export_peer
from export.peer import main as peer_main
from train.networks.cost import macs
from train.networks.registry import build
from train.networks.symmetric import write_out


@pytest.mark.parametrize("name", ["stsr", "mtsr2", "mtsr4"])
def test_bundled_models_have_those_of_their_network_in_floats_and_in_integers(name):
    # The network's layers, and the product of its factors with three masks of 40 x 40 pixels.
    expected = macs(network_of(onnx.load(find_model(name)))) + 3 * 40 * 40
    for path in (find_model(name), find_model(f"{name}-int8")):
        found = macs_of(path)
        assert (found.count, found.uncounted) == (expected, ())


def test_a_model_of_any_number_of_taps_has_those_of_as_many_as_it_takes():
    path = find_model("mtsr7-int8")
    one, two, seven = (macs_of(path, taps).count for taps in (1, 2, 7))
    assert one == macs_of(find_model("stsr-int8")).count  # a graph of its own
    assert one < two < seven and taps_of(Subject("mtsr7-int8", "model", str(path))) == 7


def test_a_peer_of_random_weights_says_so_is_seeded_and_has_those_of_its_network(tmp_path):
    path = tmp_path / "peer.onnx"
    assert "weights random, seed 3" in export_peer("compact-stsr", path, seed=3, scale=2)
    torch.manual_seed(3)
    net = write_out(build("compact-stsr", 2))
    held = {weight.name: numpy_helper.to_array(weight) for weight in onnx.load(path).graph.initializer}
    assert np.array_equal(held["leave.2.weight"], net.state_dict()["leave.2.weight"])
    assert macs_of(path).count == macs(net)
    assert peer_weights(path) == "random, of compact-stsr, seed 3"
    with pytest.raises(ModelError, match="'version' is missing"):
        ModelSession(path)


def test_a_peer_that_there_is_not_is_said_in_a_line(tmp_path):
    with pytest.raises(SystemExit, match=r"peer: .*/none/peer.onnx: No such file"):
        peer_main(["compact-stsr", "--scale", "2", "--out", str(tmp_path / "none" / "peer.onnx")])


def write(path, nodes, inputs, weights, outputs):
    graph = helper.make_graph(
        nodes,
        "operators",
        [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in inputs],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def test_every_operator_counts_its_own_way(tmp_path):
    ones = lambda *shape: np.ones(shape, dtype=np.float32)  # noqa: E731
    nodes = [
        helper.make_node("Conv", ["image", "grouped"], ["a"], group=2, strides=[2, 2]),
        helper.make_node("ConvTranspose", ["image", "turned"], ["b"], strides=[3, 3]),
        helper.make_node("Gemm", ["table", "wide"], ["c"], transA=1, transB=1),
        helper.make_node("MatMul", ["stack", "narrow"], ["d"]),
        helper.make_node("Add", ["stack", "stack"], ["e"]),
    ]
    inputs = [("image", TensorProto.FLOAT, ["batch", 4, 9, 9]), ("table", TensorProto.FLOAT, [7, 5])]
    inputs.append(("stack", TensorProto.FLOAT, [2, 3, 6]))
    weights = {"grouped": ones(6, 2, 3, 3), "turned": ones(4, 5, 3, 3), "wide": ones(11, 7), "narrow": ones(6, 8)}
    path = write(tmp_path / "operators.onnx", nodes, inputs, weights, "abcde")
    convolution, transposed = 6 * 4 * 4 * (2 * 9), 4 * 9 * 9 * (5 * 9)
    assert macs_of(path).count == convolution + transposed + 5 * 7 * 11 + 2 * 3 * 6 * 8


def event(operator, inputs, output):
    shapes = [{"float": shape} for shape in inputs]
    return {"args": {"op_name": operator, "input_type_shape": shapes, "output_type_shape": [{"float": output}]}}


def test_integers_keep_their_weights_elsewhere_and_what_is_not_counted_is_named():
    scales = [[], []]
    found = counted(
        [
            event("QLinearConv", [[1, 3, 4, 4], *scales, [8, 3, 3, 3], *scales], [1, 8, 4, 4]),
            event("QLinearMatMul", [[5, 6], *scales, [6, 7], *scales], [5, 7]),
            event("LSTM", [[1, 1, 4]], [1, 1, 8]),
            {"args": {"op_name": "Conv"}, "cat": "Node"},  # the event of a fence, without shapes
            {"cat": "Session"},
        ]
    )
    assert found.count == 8 * 16 * 27 + 5 * 6 * 7
    assert found.uncounted == ("LSTM",)


def test_an_input_that_is_not_of_floats_is_refused_by_name(tmp_path):
    node = helper.make_node("Cast", ["index"], ["a"], to=TensorProto.FLOAT)
    path = write(tmp_path / "whole.onnx", [node], [("index", TensorProto.INT64, [3])], {}, "a")
    with pytest.raises(ModelError, match="input index is tensor\\(int64\\), expected floats"):
        macs_of(path)


def test_the_product_written_by_hand_is_a_model_and_has_a_peak(tmp_path):
    onnx.checker.check_model(onnx.load_from_string(product_model()))
    assert peak_gmac_s(1, sizes=(64,)) > 0
