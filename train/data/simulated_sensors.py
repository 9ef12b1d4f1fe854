"""Simulated sensors whose pads, gains and nuisances are all drawn: what a learner of gains is measured on."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES, USPA44
from train.data.presses import PressSet
from train.data.world import World
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import Pad, draw_pad
from train.physics.sensor_noise import Nuisances, read_windows

CALIBRATION: Final = World(count=4800, per_pad=200, seed=9014)
"""Sensors by which bias and intervals of learned gains are set."""


def sensor_of(world: World, number: int) -> tuple[Pad, NDArray[np.float64]]:
    """Return a sensor's pad and the gains (3, rows, cols) of its chips."""
    spread = Nuisances().gain_spread
    chips = spread * np.random.default_rng([world.seed, 1, number]).standard_normal(USPA44.scan_shape)
    return draw_pad(np.random.default_rng([world.seed, number])), 1 + chips.clip(-2 * spread, 2 * spread)


def true_log_gains(pad: Pad, chips: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return log-gains (channels,): of chips and of what seats and moments do under an even load; z's mean is 0."""
    seats = even_gains(GrippedPad(pad), GrippedPad(replace(pad, seed=None)))
    true = np.log(chips) + np.log(seats)
    return (true - true[AXES.index("z")].mean()).ravel()


def contacts_of(presses: PressSet, world: World, number: int) -> NDArray[np.float32]:
    """Return the contacts (n, 3, rows, cols) of a sensor of a world, as it reads them.

    Sets number their pads with gaps, in the order in which they were drawn.
    """
    mine = presses.pick(presses.pad == np.unique(presses.pad)[number])
    clean = mine.counts[:, 0] * sensor_of(world, number)[1].astype(np.float32)
    return read_windows(clean[None, :, None], 1.0, Nuisances().without("gain_spread"), [world.seed, number])[0]


def even_gains(gripped: GrippedPad, perfect: GrippedPad) -> NDArray[np.float64]:
    """Return what the seats and moments of a pad's magnets do to z under an even load, (rows, cols)."""
    even = np.full((1, 1, gripped.size, gripped.size), 0.02, dtype=np.float32)
    z = AXES.index("z")
    return gripped.skin.frames(even)[0, 0, z].astype(np.float64) / perfect.skin.frames(even)[0, 0, z]
