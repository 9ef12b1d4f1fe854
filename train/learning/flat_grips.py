"""Table by which flat grips give the gains of a sensor: made from simulated sensors, used by `edge-sr doctor`.

python -m train.learning.flat_grips edge/models/grips.npz
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, cast

import joblib
import numpy as np
from numpy.typing import NDArray

from edge.doctor.flat_grip_gains import FEATURES, FlatGripTable, grip_features
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, GAINS
from train.data.grip_ramps import even_gains, flat_grips, read_grips
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import draw_pad

SEED: Final = 9014
_PADS: Final = 300
_READINGS: Final = 5
"""Sensors with other gains, drifts and noise for each pad."""
_RIDGE: Final = 1e-3
"""Share of each feature's variance that is added to it."""
_MIRRORS: Final = range(8)


def grips_of_pad(seed: int, number: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the clean readings of a pad's flat grips, and what its magnets' seats and moments do to the gains."""
    pad = draw_pad(np.random.default_rng([seed, number]))
    gripped = GrippedPad(pad)
    clean = flat_grips(gripped, np.random.default_rng([seed, 7, number]))
    return clean, even_gains(gripped, GrippedPad(replace(pad, seed=None)))


def draw_gains(seed: Sequence[int], spread: float = GAIN_SPREAD) -> NDArray[np.float64]:
    """Draw the gains (3, rows, cols) of a new sensor's chips, cut at two standard deviations."""
    draws = np.random.default_rng(seed).standard_normal(USPA44.scan_shape)
    return 1 + (spread * draws).clip(-2 * spread, 2 * spread)


def log_gains(chips: NDArray[np.floating], seats: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the true log-gains (3, rows, cols) of a sensor; the mean of z is 0."""
    true = np.log(chips) + np.log(seats)
    return true - true[AXES.index("z")].mean()


def fit_table(pads: Sequence[tuple[NDArray[np.float32], NDArray[np.float64]]], seed: int = SEED) -> FlatGripTable:
    """Fit the joint distribution of features and log-gains to the grips of `grips_of_pad`, mirrored and turned."""
    rows = []
    for number, (clean, seats) in enumerate(pads):
        for reading in range(_READINGS):
            chips = draw_gains([seed, number, reading])
            read = read_grips(clean, chips, [seed, number, reading])
            for mirror, true in _mirrored(read, log_gains(chips, seats)):
                features = grip_features(list(mirror))
                if features is not None and np.isfinite(features).all():
                    rows.append(np.concatenate([features, true.ravel()]))
    covariance = np.cov(np.array(rows).T)
    features = np.arange(FEATURES)
    covariance[features, features] *= 1 + _RIDGE
    return FlatGripTable(np.mean(rows, axis=0), covariance, 1.0)


def _mirrored(
    read: NDArray[np.float32], true: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    for mirror in _MIRRORS:
        one, gains = read, true
        if mirror & 1:
            one, gains = one[..., ::-1] * np.array([-1, 1, 1], dtype=np.float32)[:, None, None], gains[..., ::-1]
        if mirror & 2:
            one, gains = one[..., ::-1, :] * np.array([1, -1, 1], dtype=np.float32)[:, None, None], gains[..., ::-1, :]
        if mirror & 4:
            one, gains = one.swapaxes(-1, -2)[:, :, [1, 0, 2]], gains.swapaxes(-1, -2)[[1, 0, 2]]
        yield one, gains


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m train.learning.flat_grips", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("out", type=Path, metavar="OUT.npz")
    parser.add_argument("--pads", type=int, default=_PADS, help=f"simulated pads ({_PADS})")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, -1 for one on each core (-1)")
    options = parser.parse_args(arguments)
    solved = joblib.Parallel(n_jobs=options.jobs)(
        joblib.delayed(grips_of_pad)(SEED, number) for number in range(options.pads)
    )
    table = fit_table(cast(list[tuple[NDArray[np.float32], NDArray[np.float64]]], solved))
    np.savez_compressed(
        options.out,
        allow_pickle=False,
        mean=table.mean.astype(np.float32),
        covariance=table.covariance.astype(np.float32),
        widening=np.float32(table.widening),
    )
    sys.stdout.write(f"{options.out}: {FEATURES} features and {GAINS} gains of {options.pads} pads\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
