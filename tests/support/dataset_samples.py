"""Sequences of taps in closed form."""

import numpy as np

from train.data.dataset import Sequences
from train.physics.simulated_sensor import FRAMES

SHARES = np.arange(1, FRAMES + 1) / FRAMES
ALONG = (np.arange(80) - 39.5) / 20
RADIUS = np.hypot(ALONG[:, None], ALONG)


def make_sequences(count=6, taps=4, maps=1, seed=0) -> Sequences:
    """Return presses in closed form: force k d^1.5, counts c d, patterns exp(-r^2) d, wider with d if maps > 1."""
    rng = np.random.default_rng(seed)
    end_mm = rng.uniform(0.2, 0.5, (count, taps))
    indentation_mm = end_mm[..., None] * SHARES
    slope = rng.uniform(-3000, 6000, (count, taps, 1, 3, 4, 4))
    shares = np.ones(1) if maps == 1 else SHARES
    return Sequences(
        surfaces=np.array(["small square", "C", "glyph:123456"])[np.arange(count) % 3],
        poses=rng.uniform(-3, 3, (count, taps, 3)),
        counts=(slope * indentation_mm[..., None, None, None]).astype(np.float32),
        force_n=(rng.uniform(20, 30, (count, taps, 1)) * indentation_mm**1.5).astype(np.float32),
        indentation_mm=indentation_mm.astype(np.float32),
        unit_patterns=np.exp(-(RADIUS**2) / shares[:, None, None])[None].repeat(count, 0).astype(np.float16),
        touching=(shares[:, None, None] > RADIUS)[None].repeat(count, 0),
        seed=seed,
        config={"made": "by hand", "steps": [1, 2.5]},
    )
