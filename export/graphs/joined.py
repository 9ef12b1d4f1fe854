"""Graph of a single tap and graph of several in one file: the number of taps in a run decides which is computed."""

import hashlib
from dataclasses import replace
from typing import Final

import onnx
from onnx import GraphProto, TensorProto, helper

from edge.inference.contract import INPUT_NAME, Contract
from export.errors import ExportError

_NEWEST: Final = "newest"
"""Name of the window in the graph of a single tap, which has no dimension of taps."""
_IN_BRANCH: Final = " of branch"
"""End of the outputs' names within a branch: they differ from those of the file."""
_SAME: Final = (
    *("batch", "scale", "counts_per_unit", "output_unit", "output_full_scale", "sensor", "rows"),
    *("cols", "pitch_mm", "arithmetic", "pad_inputs", "takes_gains", "traction_scale"),
)
"""Keys of the contract that both graphs must share."""


def joined(one: onnx.ModelProto, more: onnx.ModelProto) -> onnx.ModelProto:
    """Return a graph that computes `one` in runs of one tap, and `more`, which takes poses, in all others.

    The branches keep the names of their nodes and weights.
    """
    file_graph = more.graph
    *_, rows, cols = _shape(file_graph.input[0])
    outputs = [value.name for value in file_graph.output]
    newest = TensorProto(name=f"{_NEWEST} shape", data_type=TensorProto.INT64, dims=[4], int64_data=[-1, 3, rows, cols])
    alone = _branch(one.graph, "one tap", {INPUT_NAME: _NEWEST} | {name: name + _IN_BRANCH for name in outputs})
    alone.node.insert(0, helper.make_node("Reshape", [INPUT_NAME, newest.name], [_NEWEST], name=_NEWEST))
    alone.initializer.append(newest)
    fused = _branch(file_graph, "several taps", {name: name + _IN_BRANCH for name in outputs})
    nodes = [
        helper.make_node("Shape", [INPUT_NAME], ["taps in the run"], name="taps", start=1, end=2),
        helper.make_node("Equal", ["taps in the run", "one"], ["is one tap"], name="is one tap"),
        helper.make_node("If", ["is one tap"], outputs, name="by taps", then_branch=alone, else_branch=fused),
    ]
    number = TensorProto(name="one", data_type=TensorProto.INT64, dims=[1], int64_data=[1])
    graph = helper.make_graph(nodes, file_graph.name, list(file_graph.input), list(file_graph.output), [number])
    model = helper.make_model(graph, opset_imports=more.opset_import, ir_version=more.ir_version)
    model.producer_name, model.producer_version = more.producer_name, more.producer_version
    onnx.checker.check_model(model, full_check=True)
    return model


def branches(model: onnx.ModelProto) -> tuple[GraphProto, GraphProto] | None:
    """Return the graphs of one tap and of several in a graph that `joined` made; None for any other graph."""
    for node in model.graph.node:
        if node.op_type == "If":
            held = {attribute.name: attribute.g for attribute in node.attribute}
            return held["then_branch"], held["else_branch"]
    return None


def with_one_tap(more: Contract, one: Contract) -> Contract:
    """Return the contract of the joined graph: that of several taps, with the levels of a single one.

    Levels of contact and of intervals are fitted to a network's own patterns, and most runs are of one tap. The hash of
    the training covers both.

    Raises:
        ExportError: `one` takes several taps, or a key differs that both must share; the message names the key.
    """
    if one.taps != 1:
        raise ExportError(f"the model for a single tap takes {one.taps}: name one of a network of one tap")
    for key in _SAME:
        got, expected = getattr(one, key), getattr(more, key)
        if got != expected:
            raise ExportError(f"contract key '{key}' of the model for a single tap is {got!r}, expected {expected!r}")
    trained = hashlib.sha256(f"{one.training_sha256} {more.training_sha256}".encode()).hexdigest()
    levels = {"contact_level": one.contact_level, "interval_levels": one.interval_levels}
    return replace(more, **levels, training_sha256=trained)


def _branch(graph: GraphProto, name: str, renamed: dict[str, str]) -> GraphProto:
    """Return a graph without inputs, which a branch takes from around it, and with values renamed."""
    branch = GraphProto(name=name, initializer=graph.initializer)
    for node in graph.node:
        copy = branch.node.add()
        copy.CopyFrom(node)
        copy.input[:] = [renamed.get(value, value) for value in node.input]
        copy.output[:] = [renamed.get(value, value) for value in node.output]
    for output in graph.output:
        copy = branch.output.add()
        copy.CopyFrom(output)
        copy.name = renamed[output.name]
    return branch


def _shape(value: onnx.ValueInfoProto) -> list[int]:
    return [length.dim_value for length in value.type.tensor_type.shape.dim]
