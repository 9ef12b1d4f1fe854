"""Limits of a model: its operators, its format, and what becomes of one that fails while it runs."""

import re

import numpy as np
import onnx
import pytest
from cli_samples import write_recording
from edge_samples import BASELINE, ROOT, make_contract, save_graph, write_model
from onnx import helper

from edge.api import ModelError, bundled_models, save_baselines
from edge.cli import main as cli
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


def test_a_run_that_fails_is_one_line_and_ends_edge_sr_with_4(tmp_path, capsys):
    """The model takes the first of its one patterns for a free pad, and one that is not there for any other."""
    nodes = (
        helper.make_node("ReduceMax", ["window"], ["most"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["most", "hundred"], ["number"]),
        helper.make_node("Cast", ["number"], ["index"], to=onnx.TensorProto.INT64),
        helper.make_node("Gather", ["zeros", "index"], ["pattern"], axis=0),
    )
    zeros, contract = np.zeros((1, 40, 40), np.float32), make_contract()
    constants = {"zeros": zeros, "hundred": np.array(100, np.float32)}
    path = save_graph(tmp_path / "m.onnx", [*nodes], contract, constants, contract.to_metadata())
    assert not ModelSession(path).run(np.zeros((4, 3, 4, 4), np.float32)).any()
    # A press that lasts, or newer scans may overtake all of it, and on all taxels: one alone is not believed.
    taps = write_recording(tmp_path / "taps.npz", [0] * 200)
    recorded = dict(np.load(taps))
    recorded["counts"][5:, 2] += 200 + 10 * np.arange(16).reshape(4, 4)
    np.savez(taps, **recorded)
    save_baselines(tmp_path / "zero.json", [BASELINE])
    known = ["--source", f"replay:{taps}", "--baseline", str(tmp_path / "zero.json")]
    code = cli.main([*known, "--model", str(path), "--sink", f"jsonl:{tmp_path / 'out.jsonl'}"])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "cannot be run" in line]
    assert code == 4 and len(line) < 500
    assert re.match(re.escape(f"edge-sr: {path}: cannot be run: ") + ".*Gather", line)
