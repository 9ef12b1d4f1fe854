"""Kalman fusion of taps with known poses, in a world where its assumptions hold."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from train.data.batches import COUNTS_PER_UNIT
from train.experiments.support.kalman_fusion import KalmanFusion, fit
from train.surfaces.poses import ANGLE_STEP_DEG

PIXEL_MM = 4.7 / 10
LENGTH_MM = 2.0
WAVES = 50
H = 2.35


def waves(rng, count):
    """Return random fields as sums of waves: a function from places (m, 2) in mm to values (count, m)."""
    way = rng.standard_normal((count, WAVES, 2)) / LENGTH_MM
    phase = rng.uniform(0, 2 * np.pi, (count, WAVES, 1))
    return lambda places: 0.2 + 0.1 * np.sqrt(2 / WAVES) * np.cos(way @ places.T + phase).sum(axis=1)


def places(side):
    along = (np.arange(side) + 0.5) / side * 4 * 4.7 - 2 * 4.7
    x, y = np.meshgrid(along, along)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def under(own, pose):
    """Return places of a pad at a pose, by the definition of firmware_bridge.poses.pad_pose."""
    turn = np.radians(pose[2])
    x = np.cos(turn) * own[:, 0] - np.sin(turn) * own[:, 1] + pose[0]
    y = np.sin(turn) * own[:, 0] + np.cos(turn) * own[:, 1] + pose[1]
    return np.stack([x, y], axis=1)


def tapped(fields, pose, rng):
    """Return counts: z of a taxel is the mean of the middle of its place, with some noise."""
    z = fields(under(places(16), pose)).reshape(-1, 4, 4, 4, 4)[:, :, 1:3, :, 1:3].mean(axis=(2, 4))
    counts = np.zeros((len(z), 3, 4, 4), dtype=np.float32)
    counts[:, 2] = COUNTS_PER_UNIT[2] * z + 2 * rng.standard_normal(z.shape)
    return counts


@pytest.fixture(scope="module")
def peer() -> KalmanFusion:
    rng = np.random.default_rng(0)
    fields = waves(rng, 600)
    patterns = fields(places(40)).reshape(-1, 40, 40)
    made = replace(
        make_press_set(600, taps=1),
        patterns=patterns.astype(np.float16),
        counts=tapped(fields, np.zeros(3), rng)[:, None],
    )
    return fit(made, side=8)


def errors(peer, poses, believed=None, count=20):
    rng = np.random.default_rng(1)
    fields = waves(rng, count)
    windows = np.stack([tapped(fields, pose, rng) for pose in poses], axis=1)
    stated = np.zeros((count, len(poses), 5))
    stated[..., :3] = poses if believed is None else believed
    truth = fields(places(40)).reshape(-1, 40, 40)
    return np.sqrt(np.mean((peer(windows, stated) - truth) ** 2))


def test_taps_that_are_shifted_tell_more_than_one_and_than_the_papers_turns(peer):
    shifts = np.array([(0, 0, 0), (H, 0, 0), (0, H, 0), (H, H, 0)], dtype=float)
    turns = np.array([(0, 0, ANGLE_STEP_DEG * k) for k in range(4)])
    one, four, turned = errors(peer, shifts[:1]), errors(peer, shifts), errors(peer, turns)
    assert four < 0.9 * one and four < 0.95 * turned


def test_poses_have_the_axes_and_the_sense_of_turn_that_the_bridge_defines(peer):
    poses = np.array([(0, 0, 0), (2.0, -1.5, 40), (-1.0, 2.5, -60)], dtype=float)
    right = errors(peer, poses)
    assert right < 0.95 * errors(peer, poses[:1])
    for mirrored in ((1, 1, -1), (-1, 1, 1), (1, -1, 1)):
        assert errors(peer, poses, poses * mirrored) > 1.1 * right


def test_a_pose_stated_as_uncertain_counts_less(peer):
    poses = np.array([(0, 0, 0), (H, 0, 0), (0, H, 0)], dtype=float)
    off = poses + np.array([(0, 0, 0), (1.5, -1.0, 0), (-1.5, 1.0, 0)])
    rng = np.random.default_rng(1)
    fields = waves(rng, 20)
    windows = np.stack([tapped(fields, pose, rng) for pose in poses], axis=1)
    truth = fields(places(40)).reshape(-1, 40, 40)

    def error(error_mm):
        stated = np.zeros((20, 3, 5))
        stated[..., :3] = off
        stated[:, 1:, 3] = error_mm
        return np.sqrt(np.mean((peer(windows, stated) - truth) ** 2))

    assert error(1.5) < 0.97 * error(0.0)


def test_one_tap_needs_no_pose_error_and_patterns_are_never_below_zero(peer):
    window = np.full((2, 1, 3, 4, 4), 100, dtype=np.float32)
    found = peer(window, np.zeros((2, 1, 5)))
    assert found.shape == (2, 40, 40) and found.dtype == np.float32 and found.min() >= 0
