"""Colours of a picture of a map."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

# A few stops of viridis, which reads the same to the colour-blind and grows steadily lighter.
STOPS: Final = np.array(
    [
        *((68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142)),
        *((31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37)),
    ],
    dtype=np.float64,
)


def colours(shares: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return colours (..., 3), red, green and blue in 0..255, of shares (...) in 0..1."""
    positions = np.linspace(0, 1, len(STOPS))
    channels = [np.interp(shares, positions, STOPS[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).astype(np.float64)
