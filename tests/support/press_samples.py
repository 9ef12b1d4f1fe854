"""Sets of presses with closed forms, for tests of learning."""

import numpy as np

from train.data.presses import PressSet
from train.physics.pad_draws import INPUTS


def make_press_set(count=12, taps=2, seed=0) -> PressSet:
    """Return readings and truths in proportion to the indentation, of as many pads as there are fours."""
    rng = np.random.default_rng(seed)
    depth_mm = rng.uniform(0.1, 0.5, count).astype(np.float32)
    across = (np.arange(40) - 19.5) / 10
    dome = np.exp(-(across[:, None] ** 2 + across**2))
    traction = rng.standard_normal((count, 3, 8, 8))
    constants = rng.uniform(-1, 1, (count, len(INPUTS))).astype(np.float32)
    counts = 2000 * rng.uniform(-1, 1, (count, taps, 3, 4, 4)) * depth_mm[:, None, None, None, None]
    turn_deg = np.tile(5.0 * np.arange(taps, dtype=np.float32), (count, 1))
    return PressSet(
        family=np.array(["flat", "dome", "glyph"])[np.arange(count) % 3],
        pad=np.arange(count) // 4,
        constants=constants,
        counts=counts.astype(np.float32),
        angle_deg=-turn_deg,
        poses=np.stack([0 * turn_deg, 0 * turn_deg, turn_deg], axis=2),
        patterns=(dome * depth_mm[:, None, None]).astype(np.float16),
        touching=np.broadcast_to(dome > 0.5, (count, 40, 40)).copy(),
        traction_kpa=(50 * traction * depth_mm[:, None, None, None]).astype(np.float16),
        force_n=np.stack([0 * depth_mm, 0 * depth_mm, 40 * depth_mm], axis=1),
        twist_nmm=rng.normal(0, 10, count).astype(np.float32),
        indentation_mm=depth_mm,
        config={"made": "by hand", "seed": seed},
    )
