"""Pad of one sensor: its constants and gains, as the model takes them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.perception.pattern_check import PatternCheck
from edge.perception.result import WrenchOrigin
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import Pad


class SensorPad:
    """Constants and gains of a sensor, which may be learned while it runs.

    Args:
        contract: of the model.
        pad: what is known of it; None for nothing.
        counts_per_newton: of the sensor, which stands for those that the pad lacks.
        check: of its patterns, which takes the same pad; None without checks.

    Attributes:
        counts_per_newton: summed z per [N], if that is known.
        row: the constants as model input.
        gains: (3, rows, cols) that the model takes readings divided by; None where it takes them as they are.
        gains_certainty: of the gains that are available, see firmware_bridge.scans.pad_constants.Pad; None without.
        wrench_origin: whether the model gets the sensor's counts per newton.
    """

    def __init__(
        self, contract: Contract, pad: Pad | None, counts_per_newton: float | None, check: PatternCheck | None
    ) -> None:
        self._contract, self._check = contract, check
        self.counts_per_newton = counts_per_newton
        self.use(pad)

    def use(self, pad: Pad | None) -> None:
        """Take a pad from now on, converted once for all runs of the model."""
        contract = self._contract
        if self.counts_per_newton is not None and (pad is None or pad.counts_per_newton is None):
            pad = replace(pad or Pad(), counts_per_newton=self.counts_per_newton)
        self.row: NDArray[np.float32] = contract.pad_row(pad)
        self.gains: NDArray[np.float32] | None = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            self.gains = np.asarray(pad.gains, dtype=np.float32).reshape(len(AXES), contract.rows, contract.cols)
        if self._check is not None:
            self._check.use_pad(self.row, outside=contract.is_outside(pad))
        self.gains_certainty = None if pad is None or pad.gains is None else pad.gains_certainty
        calibrated = pad is not None and pad.counts_per_newton is not None
        takes = any(name == "counts_per_newton" for name, _, _ in contract.pad_inputs)
        self.wrench_origin: WrenchOrigin = "calibrated" if calibrated and takes else "nominal"
