"""Check of earlier taps with poses, learnt from presses with a closed form: a bump of the object under a pad."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose
from train.data.press_batches import stated_poses
from train.data.presses import PressSet
from train.learning.checks import fit_tap_network, pair_features, relative, strong_taps, tap_check

TAPS = 4
WIDE_MM = 4.0
FALSE_ALARMS = 0.05
FLAT = np.array([0.0, 0.0, 1.0])[:, None, None]


def bumps(count: int, seed: int) -> PressSet:
    """Return sequences of taps at any poses over bumps, newest first."""
    rng = np.random.default_rng([seed, 1])
    made = make_press_set(count, TAPS, seed)
    poses = np.concatenate([rng.uniform(-3, 3, (count, TAPS, 2)), rng.uniform(-45, 45, (count, TAPS, 1))], axis=2)
    poses[:, 0] = 0
    along = (np.arange(4) - 1.5) * USPA44.pitch_mm
    turn = np.radians(poses[..., 2])[..., None, None]
    x = poses[..., 0, None, None] + np.cos(turn) * along - np.sin(turn) * along[:, None]
    y = poses[..., 1, None, None] + np.sin(turn) * along + np.cos(turn) * along[:, None]
    bump = rng.uniform(-5, 5, (2, count, 1, 1, 1))
    z = 3000 * np.exp(-((x - bump[0]) ** 2 + (y - bump[1]) ** 2) / (2 * WIDE_MM**2))
    return replace(made, counts=(z[:, :, None] * FLAT).astype(np.float32), poses=poses.astype(np.float32))


def test_relative_poses_are_those_that_a_pad_is_seen_at():
    rng = np.random.default_rng(3)
    newest, earlier = (np.stack([*rng.uniform(-5, 5, (2, 20)), rng.uniform(-200, 200, 20)], axis=1) for _ in "ab")
    seen = [PadPose(*one.tolist()).seen_from(PadPose(*new.tolist())) for new, one in zip(newest, earlier, strict=True)]
    assert relative(newest, earlier) == pytest.approx(
        np.array([(one.x_mm, one.y_mm, one.turn_deg) for one in seen]), abs=1e-4
    )


@pytest.fixture(scope="module")
def network():
    return fit_tap_network(bumps(300, 0), seed=0, steps=300)


def shares_caught(network, presses, spoil):
    """Return the share of earlier taps that a check at a share of false alarms catches, after `spoil` of a pair."""
    check = tap_check(network, bumps(300, 1), FALSE_ALARMS, seed=2)
    rng = np.random.default_rng(5)
    readings, poses = strong_taps(presses, 5)
    pose = poses[:, 1]
    stated = stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1), (0.2, 1.0))
    pair, stated = spoil(readings[:, :2], stated)
    return float((np.array(network(pair_features(pair, stated))) > check.limit).mean())


def test_right_taps_are_seldom_dropped_and_wrong_ones_mostly(network):
    presses = bumps(300, 9)

    def off_by(x_mm, turn_deg):
        return lambda pair, stated: (pair, stated + np.array([[0] * 5, [x_mm, 0, turn_deg, 0, 0]], np.float32))

    assert shares_caught(network, presses, lambda pair, stated: (pair, stated)) < 2 * FALSE_ALARMS
    assert shares_caught(network, presses, off_by(5.0, 0.0)) > 0.5
    foreign = shares_caught(network, presses, lambda pair, stated: (np.stack([pair[:, 0], pair[::-1, 1]], 1), stated))
    assert foreign > 0.5
