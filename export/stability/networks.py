"""Networks in both arithmetics on windows outside the training: finite, and equal to torch in float64."""

import copy
from collections.abc import Iterator
from typing import Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from edge.inference.bundled import bundled_models
from edge.inference.contract import DEVIATION_NAME, Contract
from export.errors import ParityError
from export.graphs.graph import outputs
from export.graphs.parity import Difference, GraphRun, differences, extreme_windows
from export.graphs.reference import contract_in, in_float, network_of
from export.stability.case import Case, timed
from train.networks.blocks import PatternNet

PART: Final = "networks"
FLOAT: Final = 1e-5
"""Bound of float32 against float64, as a share of the network's largest value."""
INT8: Final = {"zeros": 1e-3, "denormals": 1e-3, "a count in one taxel": 1e-3, "one hot taxel": 0.5}
"""Bounds of int8. One taxel at the full range is no contact, and no pattern of it is believed; mtsr2 is off by
.35 there. Presses with fewer taps have INT8_PRESS, windows outside the training INT8_BEYOND."""
INT8_PRESS: Final = 0.05
INT8_BEYOND: Final = 0.75
"""Bound against nonsense rather than for accuracy, because ranges were measured on real contacts."""


def cases(quick: bool = False) -> Iterator[Case]:
    """Yield all cases of every bundled model."""
    for path in bundled_models()[:2] if quick else bundled_models():
        model = onnx.load(path)
        yield from of_graph(path.stem, model, network_of(onnx.load(in_float(path))), contract_in(model))


def of_graph(name: str, model: onnx.ModelProto, net: PatternNet, contract: Contract) -> Iterator[Case]:
    """Yield the cases of one graph, compared with its network."""
    run, double = GraphRun(model), copy.deepcopy(net).double()
    for severity, window in extreme_windows(contract).items():
        given, run_ms = timed(lambda window=window: run(window))
        true = [maps.numpy() for maps in outputs(double, torch.from_numpy(_felt(window)).double())]
        most = FLOAT if contract.arithmetic == "float32" else _most(severity)
        try:
            found = differences(run.outputs, true, given, contract.output_full_scale)
            sure = all((maps > 0).all() for maps, of in zip(given, run.outputs, strict=True) if of == DEVIATION_NAME)
            value = max(_share(one, contract) for one in found) if sure else float("nan")
        except ParityError:  # a value is not finite
            value = float("nan")
        note = f"largest {np.abs(true[0]).max():.2g} mm"
        yield Case(PART, name, severity, "to torch in float64, all finite", value, most, run_ms, note=note)


def _share(found: Difference, contract: Contract) -> float:
    """Return an output's relative difference; a deviation's is relative to full scale at least.

    At rest patterns are zero and deviations some .0001 mm: a share of these would be of the last bits.
    """
    if found.output != DEVIATION_NAME:
        return found.relative
    return min(found.relative, found.largest / contract.output_full_scale)


def _most(severity: str) -> float:
    return INT8.get(severity, INT8_PRESS if severity.endswith("taps") else INT8_BEYOND)


def _felt(window: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a window as in the runtime, with denormals set to zero."""
    return np.where(np.abs(window) < np.finfo(np.float32).tiny, np.float32(0), window)
