"""Models made to harm: each is refused in one line, before onnxruntime sees it."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from edge_samples import make_contract, save_graph, write_model
from hostile_samples import one_line
from onnx import TensorProto, helper

from edge.errors import ModelError
from edge.inference import onnx_guard
from edge.inference.onnx_guard import check_plain
from edge.inference.onnx_session import ModelSession


def in_graph(tensor: bytes) -> bytes:
    """A model of nothing but these weights, which may be messages in a row."""
    return bytes([7 << 3 | 2, len(tensor) + 2, 5 << 3 | 2, len(tensor)]) + tensor


def of_graph(**parts: Any) -> bytes:
    return onnx.ModelProto(graph=onnx.GraphProto(**parts)).SerializeToString()


INNER = helper.make_graph([], "inner", [], [])
OUTSIDE = TensorProto(name="w", data_location=TensorProto.EXTERNAL).SerializeToString()
SEVEN = in_graph(OUTSIDE)
"""A model as bytes, which begin with the tag of a graph, 0x3a."""
REFUSED = [
    # Protocol Buffers join messages that come twice, and of numbers the last one counts.
    (in_graph(OUTSIDE + TensorProto(data_location=TensorProto.DEFAULT).SerializeToString()), "side file"),
    (of_graph(initializer=[TensorProto(dims=[1 << 30] * 2)]), r"\[1073741824, 1073741824\], more than its \d+"),
    (of_graph(initializer=[TensorProto(dims=[1] * 100_000)]), "more than its"),
    (of_graph(node=[helper.make_node("If", ["x"], ["y"], then_branch=INNER)]), "graphs within its graph|operator 'If'"),
    (of_graph(node=[helper.make_node("Relu", ["x"], ["y"], body=INNER)]), "graphs within its graph"),
    (onnx.ModelProto(functions=[onnx.FunctionProto(name="f")]).SerializeToString(), "graphs within its graph"),
    (of_graph(sparse_initializer=[onnx.SparseTensorProto(dims=[1 << 40])]), "sparse"),
    # The encoding is read as onnxruntime reads it: a tag may be written longer than it must.
    (b"\xba\x00" + SEVEN[1:], "side file"),
    *((broken + SEVEN[1:], "damaged") for broken in (b"\xba\x80\x80\x80\x80\x00", b"\xba\x80\x80\x80\x10")),
    *((broken, "damaged") for broken in (b"\x3b", b"\x02\x00")),
]


class TestModels:
    def outside(self, tmp_path, location: str, where: str) -> Path:
        """A model whose weights lie elsewhere, in an initializer or in a node's attribute."""
        tensor = TensorProto(name="w", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
        tensor.external_data.add(key="location", value=location)
        take = [helper.make_node("Constant", [], ["w"], value=tensor)] if where == "attribute" else []
        nodes = [*take, helper.make_node("Add", ["x", "w"], ["y"])]
        ends = [helper.make_tensor_value_info(name, 1, [4]) for name in "xy"]
        graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [] if take else [tensor])
        path = tmp_path / "models" / "m.onnx"
        path.parent.mkdir()
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
        path.write_bytes(model.SerializeToString())
        return path

    @pytest.mark.parametrize("where", ["initializer", "attribute"])
    @pytest.mark.parametrize("location", ["../../etc/passwd", "{}/secret", "link", "beside", ""])
    def test_weights_in_another_file_are_refused_before_onnxruntime_sees_them(
        self, tmp_path, monkeypatch, location, where
    ):
        (tmp_path / "secret").write_bytes(bytes(16))
        path = self.outside(tmp_path, location.format(tmp_path), where)
        (path.parent / "link").symlink_to(tmp_path / "secret")
        (path.parent / "beside").write_bytes(bytes(16))
        monkeypatch.setattr("onnxruntime.InferenceSession", lambda *_, **__: pytest.fail("it was asked"))
        with pytest.raises(ModelError, match=r"m.onnx: keeps its weights in a side file, expected one file") as raised:
            ModelSession(path)
        assert one_line(raised)

    @pytest.mark.parametrize(("model", "words"), REFUSED)
    def test_what_is_no_plain_graph_is_refused(self, model, words):
        with pytest.raises(ModelError, match=words):
            check_plain(model)

    def test_more_fields_than_a_graph_has(self, limits):
        limits(onnx_guard, MOST_FIELDS=1000)
        with pytest.raises(ModelError, match="more than 1000 fields"):
            check_plain(b"\x08\x01" * 1001)

    def test_names_that_are_no_text_are_one_line_and_nothing_on_stdout(self, tmp_path, capfd):
        path = write_model(tmp_path / "tiny.onnx")
        for name in (b"Squeeze", b"tactile.sensor", b"window"):
            content = path.read_bytes()
            (tmp_path / "odd.onnx").write_bytes(content.replace(name, b"\xe5" * len(name)))
            with pytest.raises(ModelError) as raised:
                ModelSession(tmp_path / "odd.onnx")
            assert one_line(raised)
        assert capfd.readouterr().out == ""

    def test_an_array_that_no_machine_holds(self, tmp_path):
        contract = make_contract(taps=1)
        nodes = [
            helper.make_node("ConstantOfShape", ["shape"], ["huge"]),
            helper.make_node("ReduceSum", ["huge"], ["sum"], keepdims=0),
            helper.make_node("Add", ["blank", "sum"], ["pattern"]),
        ]
        blank = np.zeros(contract.output_shapes["pattern"], np.float32)
        constants = {"shape": np.array([1 << 30, 1 << 20]), "blank": blank}
        path = save_graph(tmp_path / "huge.onnx", nodes, contract, constants, contract.to_metadata())
        with pytest.raises(ModelError, match=r"huge\.onnx: .*allocate") as raised:
            ModelSession(path)
        assert one_line(raised)
