"""Linear map of several taps: at the places of a schedule, in any order and direction."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from train.errors import DatasetError
from train.experiments.support.linear_taps import _follow, fit_linear_taps
from train.learning.posed_tap_check import relative
from train.surfaces.tap_schedules import SCHEDULES


@pytest.fixture(scope="module")
def squares():
    """Presses whose four taps are half a pitch apart, each kind of square and each order."""
    presses, rng = make_press_set(96, taps=4), np.random.default_rng(0)
    poses = np.stack([SCHEDULES["half-pitch"](rng, 4) for _ in range(96)]).astype(np.float32)
    return replace(presses, poses=poses)


def stated(poses):
    return np.concatenate([poses, np.zeros((*poses.shape[:2], 2))], axis=2)


def test_neither_the_order_of_earlier_taps_nor_a_mirror_changes_what_is_found(squares):
    fitted = fit_linear_taps(squares, "half-pitch")
    windows, poses = squares.counts[:8], stated(squares.poses[:8])
    found = fitted(windows, poses)
    shuffled = [0, 3, 1, 2]
    assert np.allclose(fitted(windows[:, shuffled], poses[:, shuffled]), found, atol=1e-5)
    image, elsewhere = windows[..., ::-1] * np.array([-1, 1, 1])[:, None, None], poses * [-1, 1, -1, 1, 1]
    assert np.allclose(fitted(image, elsewhere), found[..., ::-1], atol=1e-5)
    image, elsewhere = windows[..., ::-1, :] * np.array([1, -1, 1])[:, None, None], poses * [1, -1, -1, 1, 1]
    assert np.allclose(fitted(image, elsewhere), found[..., ::-1, :], atol=1e-5)
    off = poses + np.array([0.4, -0.4, 2, 0, 0]) * (np.arange(4) > 0)[:, None]
    assert np.array_equal(fitted(windows, off), found), "errors of poses do not matter"


def test_only_sequences_of_the_schedule_are_fitted(squares):
    mixed = replace(squares, poses=squares.poses.copy(), patterns=squares.patterns.copy())
    mixed.poses[:48, 1, 0] += 0.5
    mixed.patterns[:48] = 1000
    found = fit_linear_taps(mixed, "half-pitch")(squares.counts, stated(squares.poses))
    assert np.abs(found).mean() < 5 * np.abs(squares.patterns).mean()
    with pytest.raises(DatasetError, match="no sequences of 4 taps turns"):
        fit_linear_taps(squares, "turns")


def test_each_tap_of_a_square_may_be_the_newest(squares):
    poses = squares.poses[:, [2, 0, 1, 3]]
    seen = np.stack([relative(poses[:, 0], poses[:, tap]) for tap in range(4)], axis=1)
    assert _follow(seen, "half-pitch").all() and not _follow(seen, "turns").any()
    seen[:, 2, 1] += 0.5
    assert not _follow(seen, "half-pitch").any()


def test_turned_taps_keep_their_order_whatever_their_poses_are_off(squares):
    poses = np.tile(SCHEDULES["turns"](np.random.default_rng(0), 4), (96, 1, 1)).astype(np.float32)
    fitted = fit_linear_taps(replace(squares, poses=poses), "turns")
    windows, off = squares.counts[:4], stated(poses[:4]) - [0.5, 0.5, 0, 0, 0]
    found = fitted(windows, stated(poses[:4]))
    assert np.array_equal(fitted(windows, off * (np.arange(4) > 0)[:, None]), found)
    assert not np.allclose(fitted(windows[:, [0, 2, 1, 3]], stated(poses[:4])), found)
