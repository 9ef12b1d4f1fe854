"""Presses as sensors with gains of their own have read them: a set to evaluate on, never to learn from."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from firmware_bridge.scans.pad_constants import Pad
from train.data.press_batches import read_presses
from train.data.presses import PressSet, load_presses
from train.physics.gripped import MAX_INDENTATION_MM
from train.physics.pad_draws import input_scale, known_numbers
from train.physics.sensor_noise import NAMES, Nuisances

WIDE_TEST: Final = Path(__file__).with_name("wide-test.npz")  # every family on pads of its own; it selects nothing
_USUAL: Final = Nuisances()
_BEFORE_GAIN: Final = ("pose_error_mm", "pose_error_deg", "hysteresis", "cross_talk", "gain_spread")


@dataclass(frozen=True, slots=True)
class FrozenPresses:
    """Readings of n sequences of presses."""

    presses: PressSet  # their counts are the readings, whole and zeroed
    gains: NDArray[np.float32]  # (n, 3, rows, cols) of each sequence's sensor

    def __len__(self) -> int:
        return len(self.presses)

    def windows(self, taps: int, *, gains_known: bool = False) -> NDArray[np.float32]:
        """Return windows (n, taps, 3, rows, cols) in zeroed counts, divided by the sensors' gains if `gains_known`."""
        windows = self.presses.with_taps(taps).counts
        return windows / self.gains[:, None] if gains_known else windows

    def pads(self, *, known: bool) -> NDArray[np.float32]:
        """Return the pad inputs of a network, (n, `pad_draws.KNOWN`): all constants and gains, or none."""
        flags = np.full(self.presses.constants.shape, known)
        return known_numbers(self.presses.constants, flags, flags[:, 0])

    def pad(self, index: int, *, gains: bool = False) -> Pad:
        """Return the pad of a sequence as a sensor file holds it, with its sensor's gains if asked for."""
        scaled = self.presses.constants[index].tolist()
        values = {name: c + spread * v for (name, c, spread), v in zip(input_scale(), scaled, strict=True)}
        own = tuple(self.gains[index].ravel().tolist())
        return Pad(**values, gains=own, gain_half_widths=(0.0,) * len(own)) if gains else Pad(**values)

    def patterns(self) -> NDArray[np.float32]:
        """Return the truth, (n, H, W) in [mm]."""
        return self.presses.patterns.astype(np.float32)

    def pick(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> "FrozenPresses":
        """Return the sequences at the indices."""
        return FrozenPresses(self.presses.pick(index), self.gains[index])

    def as_frozen_set(self) -> FrozenSet:
        """Return the set as the runtime's evaluation has it: one frame a tap, of turns at one place alone."""
        turned = self.presses.only_turned()
        patterns = turned.patterns.astype(np.float32)
        depth_mm = turned.indentation_mm
        return FrozenSet(
            newest=turned.counts[:, 0].astype(np.int16),
            earlier=turned.counts[:, 1:].astype(np.int16),
            tap=np.arange(len(turned), dtype=np.int16),
            indentation_mm=depth_mm,
            force_n=turned.force_n[:, 2],
            unit_patterns=(patterns / depth_mm[:, None, None]).astype(np.float16),
            touched=turned.touching,
            surface=turned.family,
            angle_deg=turned.angle_deg[:, 0],
            full_scale_mm=MAX_INDENTATION_MM,
        )


def freeze_presses(presses: PressSet, seed: int, nuisances: Nuisances = _USUAL) -> FrozenPresses:
    """Read every sequence once, each with a different sensor, whose gains act where they do in sensor_noise."""
    before = nuisances.without(*(name for name in NAMES if name not in _BEFORE_GAIN), "gain_spread")
    after = nuisances.without(*_BEFORE_GAIN)
    gains = _gains(seed, presses, nuisances.gain_spread)
    felt = replace(presses, counts=read_presses(presses, before, seed))
    felt = replace(felt, counts=felt.counts * gains[:, None])
    config = {"presses": dict(presses.config), "read with seed": seed, "gain spread": nuisances.gain_spread}
    return FrozenPresses(replace(felt, counts=read_presses(felt, after, seed), config=config), gains)


def load_frozen_presses(path: Path = WIDE_TEST) -> FrozenPresses:
    """Load a set that `FrozenPresses.presses.save` has written."""
    presses = load_presses(path)
    return FrozenPresses(presses, _gains(presses.config["read with seed"], presses, presses.config["gain spread"]))


def _gains(seed: int, presses: PressSet, spread: float) -> NDArray[np.float32]:
    shape = (len(presses), *presses.counts.shape[2:])
    draws = np.random.default_rng([seed, 5]).standard_normal(shape, dtype=np.float32)
    return 1 + np.float32(spread) * draws.clip(-2, 2)
