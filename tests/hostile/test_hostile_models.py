"""Models made to harm: each is refused in one line, before onnxruntime sees it."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from edge_samples import make_contract, write_model
from hostile_samples import one_line
from onnx import TensorProto, helper, numpy_helper

from edge.errors import ModelError
from edge.inference import onnx_guard
from edge.inference.onnx_guard import check_plain
from edge.inference.onnx_session import ModelSession


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

    def test_a_part_of_a_tensor_that_another_part_denies_is_refused_too(self):
        # Protocol Buffers join messages that come twice, and of numbers the last one counts.
        tensor = TensorProto(name="w", data_location=TensorProto.EXTERNAL).SerializeToString()
        tensor += TensorProto(data_location=TensorProto.DEFAULT).SerializeToString()
        with pytest.raises(ModelError, match="side file"):
            check_plain(in_graph(tensor))

    def test_weights_of_more_elements_than_bytes(self):
        tensor = TensorProto(name="w", data_type=1, dims=[1 << 30, 1 << 30]).SerializeToString()
        with pytest.raises(ModelError, match=r"shape \[1073741824, 1073741824\], more than its \d+ bytes"):
            check_plain(in_graph(tensor))
        with pytest.raises(ModelError, match="more than its"):
            check_plain(in_graph(TensorProto(dims=[1] * 100_000).SerializeToString()))

    def test_graphs_within_the_graph_functions_and_sparse_weights(self):
        inner = helper.make_graph([], "inner", [], [])
        node = helper.make_node("If", ["x"], ["y"], then_branch=inner, else_branch=inner)
        nodes = ([node], [helper.make_node("Relu", ["x"], ["y"], body=inner)])
        for graph in (helper.make_graph(each, "g", [], []) for each in nodes):
            with pytest.raises(ModelError, match=r"graphs within its graph|operator 'If'"):
                check_plain(onnx.ModelProto(graph=graph).SerializeToString())
        with pytest.raises(ModelError, match="graphs within its graph"):
            check_plain(onnx.ModelProto(functions=[onnx.FunctionProto(name="f")]).SerializeToString())
        sparse = onnx.SparseTensorProto(dims=[1 << 40])
        with pytest.raises(ModelError, match="sparse"):
            check_plain(onnx.ModelProto(graph=onnx.GraphProto(sparse_initializer=[sparse])).SerializeToString())

    def test_more_fields_than_a_graph_has(self, limits):
        limits(onnx_guard, MOST_FIELDS=1000)
        with pytest.raises(ModelError, match="more than 1000 fields"):
            check_plain(b"\x08\x01" * 1001)

    def test_the_encoding_is_read_as_onnxruntime_reads_it(self):
        seven = in_graph(TensorProto(name="w", data_location=TensorProto.EXTERNAL).SerializeToString())
        assert seven[:1] == b"\x3a"
        with pytest.raises(ModelError, match="side file"):  # a tag may be written longer than it must
            check_plain(b"\xba\x00" + seven[1:])
        for broken in (
            b"\xba\x80\x80\x80\x80\x00" + seven[1:],
            b"\xba\x80\x80\x80\x10" + seven[1:],
            b"\x3b",
            b"\x02\x00",
        ):
            with pytest.raises(ModelError, match="damaged"):
                check_plain(broken)

    def test_a_file_larger_than_any_model(self, tmp_path, limits, bounded_memory):
        limits(onnx_guard, MOST_BYTES=1 << 20)
        path = tmp_path / "large.onnx"
        with path.open("wb") as file:
            file.truncate(3_000_000_000)
        with pytest.raises(ModelError, match=r"large.onnx: cannot be read: larger than the 1,048,576 bytes"):
            ModelSession(path)

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
        shape = numpy_helper.from_array(np.array([1 << 30, 1 << 20]), "shape")
        nodes = [
            helper.make_node("ConstantOfShape", ["shape"], ["huge"]),
            helper.make_node("ReduceSum", ["huge"], ["s"]),
        ]
        nodes += [helper.make_node("Add", ["window", "s"], ["pattern"])]
        ends = [
            helper.make_tensor_value_info("window", 1, [1, 3, 4, 4]),
            helper.make_tensor_value_info("pattern", 1, None),
        ]
        graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [shape])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
        helper.set_model_props(model, make_contract(taps=1).to_metadata())
        (tmp_path / "huge.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(ModelError, match=r"huge\.onnx") as raised:
            ModelSession(tmp_path / "huge.onnx")
        assert one_line(raised)


def in_graph(tensor: bytes) -> bytes:
    """A model of nothing but these weights."""

    def field(number: int, content: bytes) -> bytes:
        length, size = b"", len(content)
        while size > 0x7F:
            length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
        return bytes([number << 3 | 2]) + length + bytes([size]) + content

    return field(7, field(5, tensor))
