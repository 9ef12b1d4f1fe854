"""Presses of stripes of one period each, on pads of their own: finer ones than the pad's layer lets through."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED, one_thread
from train.data.presses import PressSet, join_presses
from train.data.world import press_shapes
from train.families.catalogue import Tapped
from train.families.shape import Height, Lengths, Lie
from train.physics.covers import BARE
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import draw_pad

PERIODS_MM: Final = (2.0, 3.0, 4.0, 6.0)
_DEEP_MM: Final = 1.0
_SEED: Final = 3_000_001


def striped_presses(pads: int, per_pad: int) -> dict[float, FrozenPresses]:
    """Return presses by period, each read by a sensor of its own: bars half a period wide, lying level anyhow."""
    return {
        period_mm: freeze_presses(_pressed(period_mm, pads, per_pad), SEED)
        for period_mm in tracked(PERIODS_MM, "pressing stripes", "period")
    }


@one_thread()
def _pressed(period_mm: float, pads: int, per_pad: int) -> PressSet:
    parts: list[PressSet] = []
    for number in range(pads):
        rng = np.random.default_rng([_SEED, number])
        gripped = GrippedPad(draw_pad(rng))
        x_mm, y_mm = np.broadcast_arrays(*gripped.places_mm)
        lies = [
            Lie(angle_deg=float(rng.uniform(0, 180)), x_mm=float(rng.uniform(0, period_mm))) for _ in range(per_pad)
        ]
        maps = [lie.seen(_bars(period_mm), x_mm, y_mm) for lie in lies]
        tapped = [Tapped(one[None], BARE, np.zeros((1, 3)), np.zeros(1)) for one in maps]
        parts.append(press_shapes(rng, gripped, np.full(per_pad, f"{period_mm:g} mm"), tapped, number))
    return join_presses(parts)


def _bars(period_mm: float) -> Height:
    def height(x: Lengths, y: Lengths) -> NDArray[np.float32]:
        place = x / period_mm
        return np.where(place - np.floor(place) < 0.5, np.float32(0), np.float32(-_DEEP_MM))

    return height
