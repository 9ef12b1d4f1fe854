"""Interface of a model session as the runtime and the evaluation use it."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract


class Model(Protocol):
    """Model that is ready to run."""

    name: str
    contract: Contract

    def run(
        self,
        window: NDArray[np.float32],
        pad: NDArray[np.float32] | None = None,
        poses: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return the pattern (H, W) of a window (taps, 3, rows, cols) in network input units, its pad and its poses."""
        ...

    def run_together(
        self,
        windows: Sequence[NDArray[np.float32]],
        pads: Sequence[NDArray[np.float32]] | None = None,
        poses: Sequence[NDArray[np.float32]] | None = None,
    ) -> NDArray[np.float32]:
        """Return the patterns (n, H, W) of several windows in one call."""
        ...

    @property
    def deviation(self) -> NDArray[np.float32] | None:
        """Standard deviation of each pixel of the last run's patterns, of their shape; None without."""
        ...

    @property
    def traction(self) -> NDArray[np.float32] | None:
        """Traction (3, h, w) of the last run, (n, 3, h, w) of several windows, in [kPa]; None without."""
        ...
