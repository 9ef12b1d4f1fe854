"""Windows of real recordings: no truth is known of them, but a graph must give what its network gives."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from train.data.real_grips import recorded_sets

_SCANS_APART = 20


def recorded_windows(folder: Path, contract: Contract) -> NDArray[np.float32]:
    """Windows (n, 3K, rows, cols) in network units: scans under load, and others of their trial as the taps before.

    Raises:
        DatasetError: no such folder or no recordings in it, or one cannot be read.
    """
    windows = []
    for scans in recorded_sets(folder):
        newest = np.arange(0, len(scans.counts), _SCANS_APART)
        earlier = (newest[:, None] + np.arange(contract.taps) * _SCANS_APART) % len(scans.counts)
        windows.append(contract.scale_window(scans.counts[earlier].astype(np.float32)))
    joined = np.concatenate(windows)
    return joined.reshape(len(joined), *contract.window_shape[1:])
