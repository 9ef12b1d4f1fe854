"""Hysteresis: a share of every reading lags, as in a spring parallel to one Maxwell element.

With c the elastic reading, a reading is (1 - share) c + share q with dq/dt = (c - q) / relaxation_s.

Source: the standard linear solid, a spring parallel to one Maxwell element.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from train.errors import TrainError

_LEAST_SHARE: Final = 0.01
_RELAXATION_S: Final = (0.2, 5.0)


class NuisanceError(TrainError, ValueError):
    """Invalid nuisances, or readings that they cannot act on."""


def frame_weights(
    frame: NDArray[np.float64],
    frames: int,
    step_s: NDArray[np.float64],
    share: NDArray[np.float64],
    relaxation_s: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the weight of each frame of a press in a reading at any moment of it, in closed form.

    Readings are linear between frames: a sum of ramps that start at the frames, so a frame's weight is the second
    difference of the responses to ramps, and that of the lagging share is t - tau (1 - exp(-t / tau)).

    Args:
        frame: moments of n sensors' K taps, (n, K, m), in frames since the pad was free.
        frames: of a press; the first one is a step after the pad was free.
        step_s: time from frame to frame, (n, K), in [s].
        share: lagging share, (n,).
        relaxation_s: (n,), above 0 where a share lags, in [s].

    Returns:
        (n, K, m, frames).
    """
    ramp = np.maximum(frame[..., None] - np.arange(frames + 2), 0)
    if share.any():
        rate = (step_s / relaxation_s[:, None])[..., None, None]
        ramp += share[:, None, None, None] * np.expm1(-rate * ramp) / rate
    return np.diff(ramp, n=2).astype(np.float32)


def draw_lag(rng: np.random.Generator, largest: float, n: int) -> NDArray[np.float64]:
    """Return the lagging share, up to `largest`, and the relaxation time in [s] of n sensors, (2, n)."""
    share = rng.uniform(min(_LEAST_SHARE, largest), largest, n)
    low, high = np.log(_RELAXATION_S)
    return np.stack([share, np.exp(rng.uniform(low, high, n))])
