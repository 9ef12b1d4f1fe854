"""Nuisances that real sensors add to the physics: named, seeded with independent streams, each can be switched off.

The order is that of the signal's path: the pad lags (hysteresis), neighbours are visible (cross-talk), the chip has its
gain; a warming pad and the earth's field add to it; then noise, the end of the range, dead taxels, whole counts.

Of the lag: with c the elastic reading, a reading is (1 - share) c + share q with dq/dt = (c - q) / relaxation_s: the
standard linear solid, a spring parallel to one Maxwell element.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import inf
from typing import Final, Self
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import GAIN_SPREAD
from train.surfaces.depth_image import Pose

Seed = int | Sequence[int]

LARGEST_COUNTS: Final = (1400.0, 1400.0, 13500.0)  # the data sheet's range of x and y, and z observed in a grasp
TAP_S: Final = (0.2, 2.5)  # bounds of a press' duration, in [s]: a fast robot, and the press of the paper's Fig. 15.


@dataclass(frozen=True, slots=True, kw_only=True)
class Nuisances:
    """Strength of each nuisance, with defaults observed on devices in the field; 0 is off, for saturation infinity.

    Spreads are standard deviations, cut at two of them. One sensor reads all taps of a window.
    """

    pose_error_mm: float = 0.2  # of a tap's x and y, for a hand-mounted gripper; the paper's robot has 0.03 mm
    pose_error_deg: float = 1.0
    hysteresis: float = 0.11  # largest share of a reading that lags, from 0.01: data sheet 1.1 %, in the field to 11 %
    # Largest share of a reading that shows in its four neighbours beyond that of the nominal magnets: 5 % corresponds
    # to half a millimetre of magnet height, by the dipole's law.
    cross_talk: float = 0.05
    gain_spread: float = GAIN_SPREAD  # of a chip axis' gain about 1: +-15 % observed
    # Of z since the last zeroing; x and y an eighth of it; common to all taxels but for a quarter. A drift of 94 reads
    # as a contact: users who zero again after warming up (120 counts per 3.5 K) see no more than two deviations.
    thermal_drift_counts: float = 45.0
    # Length of the earth's field, zeroed at another attitude: the rests of one sensor differed by 25 counts in two.
    earth_field_counts: float = 18.0
    noise_counts: float = 2.0  # at rest: 1.7 to 2.6 measured
    saturation_counts: tuple[float, float, float] = LARGEST_COUNTS
    dead_taxels: float = 0.0  # probability that a taxel always reads its rest level: about 5 %

    def without(self, *names: str) -> Self:
        """Return these nuisances with the named ones off."""
        off = {"saturation_counts": (inf, inf, inf)}
        return replace(self, **{name: off.get(name, 0.0) for name in names})


NAMES: Final = tuple(field.name for field in fields(Nuisances))  # names of all nuisances in the order in which they act


def apply_nuisances(
    clean: NDArray[np.float32],
    nuisances: Nuisances,
    seed: Seed,
    tap_s: ArrayLike | None = None,
    angle_deg: ArrayLike = 0.0,
) -> NDArray[np.float32]:
    """Return the readings of n sensors in their K taps, (n, K, F, 3, rows, cols) in whole zeroed counts.

    Those without nuisances are alike, newest tap first; frames are evenly spaced in time, the first one a step after
    the pad was free. Durations and turns of the pad are broadcast to (n, K); without `tap_s` durations are drawn. Every
    nuisance draws from a stream of its own, so switching one off changes no other.
    """
    n, taps, frames, *scan = clean.shape

    def stream(name: str) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(crc32(name.encode()),)))

    lag = np.zeros((2, n))
    if nuisances.hysteresis:
        rng = stream("hysteresis")
        lag[0] = rng.uniform(min(0.01, nuisances.hysteresis), nuisances.hysteresis, n)
        lag[1] = log_uniform(rng, 0.2, 5.0, (n,))
    duration_s = log_uniform(stream("tap_s"), *TAP_S, (n, taps)) if tap_s is None else np.asarray(tap_s)
    weights = frame_weights(frames, np.broadcast_to(duration_s, (n, taps)) / frames, *lag)
    flat = clean.reshape(n, taps, frames, -1).astype(np.float32, copy=False)
    counts = (weights @ flat).reshape(n, taps, -1, *scan)

    if nuisances.cross_talk:
        largest = stream("cross_talk").random((n, 1, 1, 1, 1), dtype=np.float32) * np.float32(nuisances.cross_talk)
        flat = counts.reshape(n, taps, -1, len(AXES), scan[1] * scan[2])
        counts = (flat + largest * (flat @ neighbours(scan[1], scan[2]))).reshape(counts.shape)
    if nuisances.gain_spread:
        counts *= 1 + np.float32(nuisances.gain_spread) * _cut_normal(stream("gain_spread"), (n, 1, 1, *scan))
    if nuisances.thermal_drift_counts:
        drift = nuisances.thermal_drift_counts * _draw_drift(stream("thermal_drift_counts"), n, scan)
        counts += drift[:, None, None]
    if nuisances.earth_field_counts:
        turn = np.broadcast_to(np.radians(np.asarray(angle_deg, dtype=np.float64)), (n, taps))
        earth = nuisances.earth_field_counts * _draw_earth(stream("earth_field_counts"), turn)
        counts += earth[:, :, None, :, None, None]
    if nuisances.noise_counts:
        noise = stream("noise_counts").standard_normal(clean.shape, dtype=np.float32)
        counts += np.float32(nuisances.noise_counts) * noise
    limit = np.array(nuisances.saturation_counts, dtype=np.float32)[:, None, None]
    np.clip(counts, -limit, limit, out=counts)
    if nuisances.dead_taxels:
        dead = stream("dead_taxels").random((n, 1, 1, 1, *scan[1:])) < nuisances.dead_taxels
        counts = np.where(dead, np.float32(0), counts)
    return np.rint(counts)


def jitter_poses(rng: np.random.Generator, poses: Sequence[Pose]) -> list[Pose]:
    """Return the true poses of a sensor that was commanded to these poses."""
    usual = Nuisances()
    off = _cut_normal(rng, (len(poses), 3))
    off *= (usual.pose_error_mm, usual.pose_error_mm, usual.pose_error_deg)
    return [Pose(*true) for true in (np.array(poses) + off).tolist()]


def _draw_drift(rng: np.random.Generator, n: int, scan: Sequence[int]) -> NDArray[np.float32]:
    """Draw drifts (n, 3, rows, cols) in deviations of z."""
    common = _cut_normal(rng, (n, len(AXES), 1, 1)) * np.array([1 / 8, 1 / 8, 1.0])[:, None, None]
    return (common * (1 + 0.25 * _cut_normal(rng, (n, *scan)))).astype(np.float32)


def _draw_earth(rng: np.random.Generator, turn: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the change of a field of length 1 since zeroing at any attitude, (n, K, 3) in the axes of turned pads."""
    field, zeroed = rng.standard_normal((2, len(turn), 3))
    field /= np.linalg.norm(field, axis=-1, keepdims=True)
    zeroed /= np.linalg.norm(zeroed, axis=-1, keepdims=True)
    along_x, along_y, along_z = field.T[..., None]
    # The pad faces the surface: seen from above its x turns with the pose, its y points to the right of its x.
    x = along_x * np.cos(turn) + along_y * np.sin(turn)
    y = along_x * np.sin(turn) - along_y * np.cos(turn)
    z = np.broadcast_to(-along_z, turn.shape)
    return (np.stack([x, y, z], axis=-1) - zeroed[:, None]).astype(np.float32)


def frame_weights(
    frames: int,
    step_s: NDArray[np.float64],
    share: NDArray[np.float64],
    relaxation_s: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the weight (n, K, frames, frames) of each frame of a press in the reading at every frame, in closed form.

    Frames are one step of `step_s` (n, K) apart, the first one a step after the pad was free. Readings are linear
    between frames: a sum of ramps that start at the frames, so a frame's weight is the second difference of the
    responses to ramps, and that of the lagging share (n,) is t - tau (1 - exp(-t / tau)), tau the relaxation (n,).
    """
    ramp = np.maximum(np.arange(1.0, frames + 1)[:, None] - np.arange(frames + 2), 0)
    ramp = np.broadcast_to(ramp, (*step_s.shape, *ramp.shape))
    if share.any():
        rate = (step_s / relaxation_s[:, None])[..., None, None]
        ramp = ramp + share[:, None, None, None] * np.expm1(-rate * ramp) / rate
    return np.diff(ramp, n=2).astype(np.float32)


def log_uniform(rng: np.random.Generator, low: float, high: float, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Draw numbers whose logarithms are uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high), shape))


def _cut_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.clip(rng.standard_normal(shape, dtype=np.float32), -2, 2)


def neighbours(rows: int, cols: int) -> NDArray[np.float32]:
    """Return the share of a taxel's outflow that reaches another, (taxels, taxels): a quarter over each edge."""
    row, col = np.divmod(np.arange(rows * cols), cols)
    return ((abs(row[:, None] - row) + abs(col[:, None] - col)) == 1).astype(np.float32) / 4
