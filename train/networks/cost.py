"""Cost of a network in parameters and multiply-accumulates."""

from typing import Final

import torch
from torch import nn

from train.networks.blocks import PatternNet
from train.networks.symmetric import SymmetricConv2d

_TAXEL_AXES: Final = 3


def parameters_count(net: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(parameter.numel() for parameter in net.parameters())


def macs(net: PatternNet, rows: int = 4, cols: int = 4) -> int:
    """Count multiply-accumulates of one window in convolutions and linear layers, without norms and interpolation."""
    counted: list[int] = []

    def count(layer: nn.Conv2d | nn.Linear | SymmetricConv2d, _: object, output: torch.Tensor) -> None:
        # Every output value is the sum of as many products as one row of the weights has entries.
        counted.append(output[0].numel() * layer.weight[0].numel())

    summing = [layer for layer in net.modules() if isinstance(layer, (nn.Conv2d, nn.Linear, SymmetricConv2d))]
    hooks = [layer.register_forward_hook(count) for layer in summing]
    like, training = next(net.parameters()), net.training
    try:
        with torch.inference_mode():
            net.eval()(torch.zeros(1, _TAXEL_AXES * net.taps, rows, cols, device=like.device, dtype=like.dtype))
    finally:
        for hook in hooks:
            hook.remove()
        net.train(training)
    return sum(counted)
