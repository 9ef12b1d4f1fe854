"""Choice of the nodes of a graph that are worth quantising.

Layers that take most of the time are quantised: the convolutions of the largest grid except for those of the outputs.
Those of smaller grids, which read the taxels, stay in float: they take a tenth of the time, and no later layer
recovers their losses. A network that takes poses also quantises what encodes its earlier taps, a third of
its time with four taps, except for the convolutions of the inputs. Those that read logarithms stay in float: a step of
their range is a factor.
"""

from typing import Final

import onnx
from onnx import NodeProto

from edge.inference.contract import POSES_NAME

PASSING_ON: Final = {"Relu": any, "Add": any, "Concat": all}
"""Operations that are quantised if any or all of their inputs are."""
_COMPARING: Final = ("compare", "answer")
"""Layers of a FusionNet that compare taps: in int8 they made a pattern 2.9 times its largest value too large on windows
beyond any touch. In float int8 saturates there, for 5 % of the run time with four taps."""
_RESHAPING: Final = {"Reshape", "Transpose", "Concat"}


def takes_poses(model: onnx.ModelProto) -> bool:
    """Return True if the graph has an input for poses."""
    return any(given.name == POSES_NAME for given in model.graph.input)


def integer_nodes(model: onnx.ModelProto) -> list[str]:
    """Return the names of the nodes to quantise, in the graph's order."""
    shapes = _shapes(model)
    made_by = {name: node for node in model.graph.node for name in node.output}
    convs = [node for node in model.graph.node if node.op_type == "Conv"]
    most = max((_pixels(shapes, node) for node in convs), default=0)
    costly = {node.name for node in convs if _pixels(shapes, node) >= most}
    kept = _last_convolutions(model, made_by)
    if takes_poses(model):
        windows = _runs(shapes, convs[0])  # the newest taps enter first, one a window
        costly |= {node.name for node in convs if _runs(shapes, node) != windows}
        kept |= _first_convolutions(model) | {node.name for node in convs if _reads_logarithms(node, made_by)}
        kept |= {node.name for node in convs if node.input[1].partition(".")[0] in _COMPARING}
    chosen = {node.name for node in convs if node.name in costly - kept}
    for node in model.graph.node:  # every node comes after those of its inputs
        takes = [made_by[name].name for name in node.input if name in made_by]
        if takes and node.op_type in PASSING_ON and PASSING_ON[node.op_type](name in chosen for name in takes):
            chosen.add(node.name)
    return [node.name for node in model.graph.node if node.name in chosen]


def _first_convolutions(model: onnx.ModelProto) -> set[str]:
    """Return the convolutions that see the inputs without another convolution in between."""
    found: set[str] = set()
    behind: set[str] = set()
    for node in model.graph.node:
        later = not behind.isdisjoint(node.input)
        if node.op_type == "Conv" and not later:
            found.add(node.name)
        if later or node.op_type == "Conv":
            behind.update(node.output)
    return found


def _last_convolutions(model: onnx.ModelProto, made_by: dict[str, NodeProto]) -> set[str]:
    """Return the convolutions from which an output is computed without another convolution or a Gemm in between."""
    found, behind = set(), [value.name for value in model.graph.output]
    while behind:
        node = made_by.get(behind.pop())
        if node is None:
            continue
        if node.op_type == "Conv":
            found.add(node.name)
        elif node.op_type != "Gemm":  # a layer of its own, which sees what convolutions made
            behind += node.input
    return found


def _reads_logarithms(node: NodeProto, made_by: dict[str, NodeProto]) -> bool:
    """Return True if some input of a node is a logarithm, perhaps reshaped."""
    before = [made_by[name] for name in node.input if name in made_by]
    return any(
        one.op_type == "Log" or (one.op_type in _RESHAPING and _reads_logarithms(one, made_by)) for one in before
    )


def _shapes(model: onnx.ModelProto) -> dict[str, list[int | str]]:
    """Return the lengths of each value's dimensions, free ones by name."""
    inferred = onnx.shape_inference.infer_shapes(model)
    return {
        value.name: [length.dim_param or length.dim_value for length in value.type.tensor_type.shape.dim]
        for value in (*inferred.graph.value_info, *inferred.graph.output)
    }


def _pixels(shapes: dict[str, list[int | str]], node: NodeProto) -> int:
    height, width = shapes[node.output[0]][-2:]
    return int(height) * int(width)


def _runs(shapes: dict[str, list[int | str]], node: NodeProto) -> int | str:
    return shapes[node.output[0]][0]
