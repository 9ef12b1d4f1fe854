"""Rounding of a quantised graph emulated in torch: weights and values are rounded as the graph rounds them.

Gradients pass as if nothing were rounded, except for values outside a range. A convolution is identified in the graph
by the name of its weight, which the exporter keeps; batch normalisation is folded first, because it changes the
weights.
"""

import contextlib
import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import onnx
import torch
from onnx import NodeProto, numpy_helper
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval, parametrize

from export.errors import ExportError
from train.networks.blocks import MultiScaleResidual, PatternNet, Residual
from train.networks.compact import CompactNet
from train.networks.symmetric import SymmetricResidual, write_out

_MOST_WEIGHT: Final = 127
MOST_VALUE: Final = 255
_TINY: Final = 1e-30
"""Least weight of a channel, so that a channel of zeros has a scale as well."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid of one tensor's values: scale * (0..255 - zero_point)."""

    scale: float
    zero_point: int

    def __call__(self, values: Tensor) -> Tensor:
        """Round values of any shape to the grid."""
        return torch.fake_quantize_per_tensor_affine(values, self.scale, self.zero_point, 0, MOST_VALUE)


@dataclass(frozen=True, slots=True)
class IntegerConvolution:
    """Rounding around one convolution of a graph; None where the graph does not round.

    Attributes:
        taken: grid of its input.
        given: grid of its output, after the ReLU that follows it if there is one.
        added: grid of the sum with its output, after the ReLU that follows the sum.
    """

    taken: Grid
    given: Grid | None
    added: Grid | None


def folded(net: PatternNet) -> PatternNet:
    """Return a copy that computes the same in evaluation mode with ordinary convolutions alone.

    Symmetric convolutions are written out, and batch normalisation is folded into the convolutions before it.

    Raises:
        ExportError: a batch normalisation does not follow a convolution.
    """
    fused = copy.deepcopy(net).eval()
    write_out(fused)
    for sequence in [module for module in fused.modules() if isinstance(module, nn.Sequential)]:
        for place in range(1, len(sequence)):
            before, norm = sequence[place - 1], sequence[place]
            if isinstance(before, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                sequence[place - 1], sequence[place] = fuse_conv_bn_eval(before, norm), nn.Identity()
    left = [name for name, module in fused.named_modules() if isinstance(module, nn.BatchNorm2d)]
    if left:
        raise ExportError(f"{left[0]} does not follow a convolution: it cannot be made part of one")
    return fused


def integer_convolutions(model: onnx.ModelProto, quantised_model: onnx.ModelProto) -> dict[str, IntegerConvolution]:
    """Return the convolutions that a quantised graph runs in int8, by the name of their weight.

    Args:
        model: graph in float.
        quantised_model: its quantised graph.
    """
    held = {weight.name: weight for weight in quantised_model.graph.initializer}
    grids, made_by, nodes = {}, {}, {node.name: node for node in quantised_model.graph.node}
    for node in quantised_model.graph.node:
        made_by |= dict.fromkeys(node.output, node)
        if node.op_type == "QuantizeLinear":
            scale, zero_point = (numpy_helper.to_array(held[name]) for name in node.input[1:3])
            grids[node.input[0]] = Grid(float(scale), int(zero_point))
    found = {}
    for node in model.graph.node:
        if node.op_type != "Conv":
            continue
        after = nodes[node.name]  # its output is the ReLU's if the quantiser has merged the two
        before, weight = (made_by.get(name) for name in after.input[:2])
        if before is None or weight is None or weight.op_type != "DequantizeLinear":
            continue
        # After another quantise node, so the input of this one is the rounded value.
        taken = grids[made_by[before.input[0]].input[0]]
        sums = _sums_of(model, node)
        added = grids.get(nodes[sums[0].name].output[0]) if sums else None
        found[node.input[1]] = IntegerConvolution(taken, grids.get(after.output[0]), added)
    return found


def _sums_of(model: onnx.ModelProto, conv: NodeProto) -> list[NodeProto]:
    return [node for node in model.graph.node if node.op_type == "Add" and conv.output[0] in node.input]


class _RoundedWeight(nn.Module):
    """Weights (channels, ...) rounded to the quantiser's grid, which follows the largest weight."""

    def forward(self, weight: Tensor) -> Tensor:
        zero_point = torch.zeros(len(weight), dtype=torch.int32, device=weight.device)
        return torch.fake_quantize_per_channel_affine(
            weight, _scale(weight), zero_point, 0, -_MOST_WEIGHT, _MOST_WEIGHT
        )


class _RoundedBias(nn.Module):
    """Biases (channels,) rounded to the grid of products, a value's step times a weight's."""

    def __init__(self, taken: Grid, weight: Tensor) -> None:
        super().__init__()
        self._step = lambda: taken.scale * _scale(weight)  # as an attribute, the weight would become a parameter

    def forward(self, bias: Tensor) -> Tensor:
        step = self._step().to(bias.device)
        return bias + ((bias / step).round() * step - bias).detach()


def _scale(weight: Tensor) -> Tensor:
    return weight.detach().abs().amax(dim=(1, 2, 3)).clamp_min(_TINY) / _MOST_WEIGHT


@contextlib.contextmanager
def rounded(net: PatternNet, convolutions: Mapping[str, IntegerConvolution]) -> Iterator[None]:
    """Run and train the network with the quantised graph's rounding inside the context, in float again after it.

    Args:
        net: without batch normalisation; its weights stay its own.
        convolutions: roundings of its graph, by weight.

    Raises:
        ExportError: the network has no convolution of such a name.
    """
    modules = dict(net.named_modules())
    named = {name.removesuffix(".weight"): grids for name, grids in convolutions.items()}
    foreign = [name for name in named if not isinstance(modules.get(name), nn.Conv2d)]
    if foreign:
        raise ExportError(f"the graph's convolution {foreign[0]} does not belong to the network: fold before export")
    with contextlib.ExitStack() as undone:
        for name, grids in named.items():
            module = modules[name]
            roundings: dict[str, nn.Module] = {"weight": _RoundedWeight()}
            if isinstance(module.bias, Tensor) and isinstance(module.weight, Tensor):
                roundings["bias"] = _RoundedBias(grids.taken, module.weight)
            for tensor, rounding in roundings.items():
                parametrize.register_parametrization(module, tensor, rounding)
                undone.callback(parametrize.remove_parametrizations, module, tensor, leave_parametrized=False)
            undone.callback(module.register_forward_pre_hook(_taking(grids.taken)).remove)
            if grids.given:
                undone.callback(module.register_forward_hook(_giving(grids.given)).remove)
        for name, module in modules.items():
            # The identity path parallel to the convolutions is rounded too, and so is the sum.
            match module:
                case Residual() | SymmetricResidual():
                    first, last = f"{name}.body.0", f"{name}.body.2"
                case CompactNet() if "leave.0" in named and "traction" not in named:
                    # The traction is computed in float from features that are rounded for the pattern.
                    taking = _taking(named["leave.0"].taken)
                    undone.callback(module.traction.register_forward_pre_hook(taking).remove)
                    continue
                case MultiScaleResidual():
                    first, last = f"{name}.fine.0", f"{name}.fuse"
                case _:
                    continue
            if first in named:
                undone.callback(module.register_forward_pre_hook(_taking(named[first].taken)).remove)
            if last in named and (added := named[last].added):
                undone.callback(module.register_forward_hook(_giving(added)).remove)
        yield


def _taking(grid: Grid) -> Any:
    return lambda _, taken: (grid(taken[0]), *taken[1:])


def _giving(grid: Grid) -> Any:
    return lambda _, taken, given: grid(given)
