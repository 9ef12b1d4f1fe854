"""Step of export that makes a network's intervals hold: see train.learning.interval_fit."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import onnx
import torch
from numpy.typing import NDArray

from export.graphs.graph import outputs
from export.graphs.parity import GraphRun
from train.data.presses import PressSet
from train.learning.interval_fit import Run, conform, fit_correction, readings_of_presses
from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet

_AT_ONCE: Final = 256


@dataclass(frozen=True, slots=True)
class Corrected:
    """Network whose intervals hold, and its factors at several levels; as it was if it gives no deviations."""

    net: PatternNet
    interval_levels: dict[str, list[float]]


@dataclass(frozen=True, slots=True)
class IntervalData:
    """Presses that make intervals; without those of training, corrections are by region and number of taps alone."""

    validation: PressSet
    training: PressSet | None = None

    def corrected(self, net: PatternNet, contact_level: float) -> Corrected:
        """Return a copy of a network with a correction that holds for the network itself."""
        if not isinstance(net, CompactNet):
            return Corrected(net, {})
        other = copy.deepcopy(net)
        if self.training is None:
            other.add_intervals().contact_level.fill_(contact_level)
        else:
            fit_correction(other, self.training, contact_level)
        return self._conformed(other, lambda *given: _run(other, *given))

    def conformed(self, net: PatternNet, graph: onnx.ModelProto) -> Corrected:
        """Return a copy of a corrected network whose correction holds for its graph, which is in integers."""
        if not isinstance(net, CompactNet):
            return Corrected(net, {})
        return self._conformed(copy.deepcopy(net), GraphRun(graph))

    def _conformed(self, net: CompactNet, run: Run) -> Corrected:
        readings = readings_of_presses(self.validation, net.taps, posed=net.takes_poses)
        return Corrected(net, conform(net, run, readings))


def _run(net: CompactNet, *given: NDArray | None) -> Sequence[NDArray]:
    """Return the outputs for windows, pads and poses, in parts."""
    windows, *known = (None if one is None else torch.from_numpy(one).split(_AT_ONCE) for one in given)
    count = 0 if windows is None else len(windows)
    parts = zip(windows or (), *(one or [None] * count for one in known), strict=True)
    return [torch.cat(maps).numpy() for maps in zip(*(outputs(net, *part) for part in parts), strict=True)]
