"""Test sets by the severity of one nuisance; the other nuisances and every other draw stay the same."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Final

import numpy as np

from edge.evaluation.test_set import FrozenSet
from train.data.dataset import Sequences
from train.data.generation_config import SEED
from train.experiments.support.workbench import Workbench
from train.freeze import SCALE, freeze
from train.physics.sensor_noise import LARGEST_COUNTS, Nuisances
from train.surfaces.poses import ANGLE_STEP_DEG, TARGET_ANGLES_DEG

TAPS: Final = 4
"""Taps of the longest window evaluated here."""
_DEFAULT: Final = Nuisances()


@dataclass(frozen=True, slots=True)
class Sweep:
    """One nuisance and its severities.

    Attributes:
        name: of the nuisance.
        unit: of its severity.
        severities: from the weakest to the strongest nuisance.
        default: severity at which all other sweeps are evaluated.
        frozen: function from a severity to its frozen set.
    """

    name: str
    unit: str
    severities: tuple[float, ...]
    default: float
    frozen: Callable[[float], FrozenSet]


def plain_set(bench: Workbench) -> FrozenSet:
    """Return the test set with every nuisance at its default."""
    return freeze(bench.held_out("test"), _DEFAULT, SEED, scale=SCALE)


def all_sweeps(bench: Workbench, plain: FrozenSet) -> list[Sweep]:
    """Return the sweeps over the test sequences of a workbench; `plain` is their set with the defaults."""
    clean = bench.held_out("test").at_scale(SCALE)

    def changed(**fields: object) -> FrozenSet:
        return freeze(clean, replace(_DEFAULT, **fields), SEED, scale=SCALE)

    def of(field: str, name: str, unit: str, *severities: float) -> Sweep:
        return Sweep(name, unit, severities, getattr(_DEFAULT, field), lambda severity: changed(**{field: severity}))

    def saturated(share: float) -> FrozenSet:
        return changed(saturation_counts=tuple(limit * share for limit in LARGEST_COUNTS))

    def of_other_surface(wrong: float) -> FrozenSet:
        return freeze(mistaken(clean, int(wrong)), _DEFAULT, SEED, scale=SCALE)

    def misplaced(times: float) -> FrozenSet:
        mm, deg = times * _DEFAULT.pose_error_mm, times * _DEFAULT.pose_error_deg
        solved = bench.held_out("test", pose_error_mm=mm, pose_error_deg=deg)
        return freeze(solved, _DEFAULT, SEED, scale=SCALE)

    def turned(angle_step_deg: float) -> FrozenSet:
        return freeze(bench.held_out("test", angle_step_deg=angle_step_deg), _DEFAULT, SEED, scale=SCALE)

    return [
        of("noise_counts", "noise", "counts", 0, 2, 4, 8, 16, 32),
        of("thermal_drift_counts", "thermal drift", "counts", 0, 22.5, 45, 90, 180, 360),
        of("earth_field_counts", "earth field", "counts", 0, 9, 18, 36, 72, 144),
        of("gain_spread", "gain spread", "share", 0, 0.0375, 0.075, 0.15, 0.25, 0.35),
        of("cross_talk", "cross-talk", "share", 0, 0.025, 0.05, 0.1, 0.2, 0.4),
        of("hysteresis", "hysteresis", "share", 0, 0.05, 0.11, 0.2, 0.4),
        Sweep("dead taxels", "of 16", (0, 1, 2, 3, 4, 6, 8), 0, partial(with_dead_taxels, plain)),
        of("stuck_taxels", "stuck taxels", "chance", 0, 1 / 16, 1 / 8, 1 / 4),
        Sweep("saturation", "of the range", (inf, 1, 0.4, 0.2, 0.1, 0.05), 1, saturated),
        of("torn_scans", "torn scans", "chance", 0, 0.1, 0.33, 0.67, 1),
        Sweep("lost scans", "chance", (0, 0.1, 0.25, 0.5, 0.75), 0, partial(with_lost_scans, plain)),
        Sweep("pose error", "times", (0, 0.5, 1, 2, 4, 8), 1, lambda n: plain if n == 1 else misplaced(n)),
        Sweep(
            "angle between taps",
            "deg",
            (0, 2, 5, 10, 15),
            ANGLE_STEP_DEG,
            lambda deg: plain if deg == ANGLE_STEP_DEG else turned(deg),
        ),
        Sweep("taps of another surface", f"of {TAPS - 1}", (0, 1, 2, 3), 0, of_other_surface),
        Sweep("earlier taps in reverse", "of 1", (0, 1), 0, lambda back: in_reverse(plain) if back else plain),
    ]


def with_dead_taxels(frozen: FrozenSet, dead: float) -> FrozenSet:
    """Return the set with exactly `dead` taxels at rest on each tap's sensor; fewer are a subset of more."""
    rows, cols = frozen.newest.shape[-2:]
    rank = np.random.default_rng([SEED, 1]).random((len(frozen.surface), rows * cols)).argsort(axis=1)
    alive = (rank >= dead).reshape(-1, rows, cols)
    return replace(
        frozen,
        newest=frozen.newest * alive[frozen.tap][:, None],
        earlier=frozen.earlier * alive[:, None, None],
    )


def with_lost_scans(frozen: FrozenSet, chance: float) -> FrozenSet:
    """Return the set with random scans replaced by the scan before; the first frame of a tap is never lost."""
    came = np.random.default_rng([SEED, 2]).random(len(frozen)) >= chance
    came |= np.diff(frozen.tap, prepend=-1) != 0
    latest = np.maximum.accumulate(np.where(came, np.arange(len(frozen)), 0))
    return replace(frozen, newest=frozen.newest[latest])


def mistaken(sequences: Sequences, wrong: int) -> Sequences:
    """Return sequences whose oldest `wrong` of TAPS taps are on another surface, as after the robot has moved on."""
    counts, force_n = sequences.counts.copy(), sequences.force_n.copy()
    oldest = slice(TAPS - wrong, TAPS)
    # Surfaces change slowest, so at this distance lies the next surface, at the same position and angle.
    other = np.roll(np.arange(len(sequences)), -len(TARGET_ANGLES_DEG))
    for array in (counts, force_n):
        array[:, oldest] = array[other, oldest]
    return replace(sequences, counts=counts, force_n=force_n)


def in_reverse(frozen: FrozenSet) -> FrozenSet:
    """Return the set with the earlier ones of TAPS taps in reverse order, oldest first."""
    earlier = frozen.earlier.copy()
    earlier[:, : TAPS - 1] = frozen.earlier[:, TAPS - 2 :: -1]
    return replace(frozen, earlier=earlier)
