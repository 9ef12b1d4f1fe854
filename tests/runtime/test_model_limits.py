"""Limits of a model: its operators and its format."""

import re

import onnx
import pytest
from edge_samples import ROOT, write_model
from onnx import helper

from edge.api import ModelError, bundled_models
from edge.inference.onnx_guard import OPERATORS, check_plain
from edge.inference.onnx_session import ModelSession


def one_node(operator: str, domain: str = "") -> bytes:
    node = helper.make_node(operator, ["window"], ["pattern"], domain=domain)
    return helper.make_model(helper.make_graph([node], "g", [], [])).SerializeToString()


class TestOperators:
    def test_one_that_is_not_listed_or_of_another_domain_is_refused(self):
        check_plain(one_node("Relu", "ai.onnx"))
        for operator in ("Loop", "LSTM", "RandomNormal", "Range", "relu"):
            with pytest.raises(ModelError, match=r"has operator '.*', expected only those that docs/formats.md lists"):
                check_plain(one_node(operator))
        for domain in ("com.microsoft", "ai.onnx.ml", "pkg.mine"):
            with pytest.raises(ModelError, match=f"domain '{domain}', expected ONNX's own alone"):
                check_plain(one_node("Relu", domain))

    def test_of_a_node_with_two_operators_both_count(self):
        two = onnx.NodeProto(op_type="Loop").SerializeToString() + onnx.NodeProto(op_type="Relu").SerializeToString()
        node = b"\x0a" + bytes([len(two)]) + two
        with pytest.raises(ModelError, match="operator 'Loop'"):
            check_plain(b"\x3a" + bytes([len(node)]) + node)

    def test_the_list_is_in_the_docs_and_enough_for_our_models(self):
        page = (ROOT / "docs" / "formats.md").read_text()
        listed = re.search(r"Allowed operators: (.*?)\.\n", page, re.DOTALL)
        assert listed is not None and set(re.findall(r"\w+", listed[1])) == OPERATORS
        assert all(onnx.defs.has(name) for name in OPERATORS)
        used = {node.op_type for path in bundled_models() for node in onnx.load(path).graph.node}
        assert used and used <= OPERATORS


def test_onnxruntimes_own_format_is_never_assumed(tmp_path):
    model = onnx.load(write_model(path := tmp_path / "m.onnx"))
    model.producer_name = "ORTM"
    onnx.save(model, path)
    assert path.read_bytes()[4:8] == b"ORTM" and ModelSession(path).name == "m"
