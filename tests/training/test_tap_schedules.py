"""Schedules of taps: newest first, within reach, each as its name states."""

import numpy as np
import pytest

from train.surfaces.poses import (
    HALF_PITCH_MM,
    HELD_OUT_RADIUS_MM,
    MAX_TAPS,
    NEAR_DEG,
    NEAR_MM,
    PLACES_MM,
    REACH_MM,
    SCHEDULES,
    SURFACE_REACH_MM,
    random_poses,
)


@pytest.mark.parametrize("name", SCHEDULES)
def test_every_schedule_stays_within_reach(name):
    for seed in range(30):
        poses = SCHEDULES[name](np.random.default_rng(seed), MAX_TAPS)
        assert poses.shape == (MAX_TAPS, 3) and not poses[0].any()
        assert np.hypot(*poses[:, :2].T).max() <= REACH_MM + 1e-9
        assert SCHEDULES[name](np.random.default_rng(seed), 1).shape == (1, 3)


def test_half_pitch_taps_make_the_grid_twice_as_fine_first():
    for seed in range(10):
        places = SCHEDULES["half-pitch"](np.random.default_rng(seed), MAX_TAPS)[:, :2] / HALF_PITCH_MM
        assert len({tuple(place) for place in places.round(6).tolist()}) == MAX_TAPS
        four = {tuple(place) for place in np.abs(places[:4]).round(6).tolist()}
        assert four == {(0, 0), (1, 0), (0, 1), (1, 1)}


def test_turns_are_the_papers_and_near_poses_are_near():
    assert np.allclose(SCHEDULES["turns"](np.random.default_rng(0), 3), [[0, 0, 0], [0, 0, 5], [0, 0, 10]])
    poses = np.concatenate([SCHEDULES["near"](np.random.default_rng(seed), MAX_TAPS) for seed in range(40)])
    assert 0.9 * NEAR_MM < np.hypot(*poses[:, :2].T).max() <= NEAR_MM
    assert 0.9 * NEAR_DEG < np.abs(poses[:, 2]).max() <= NEAR_DEG


def test_random_poses_keep_away_from_held_out_positions():
    drawn = np.array(random_poses(np.random.default_rng(1), 3000))
    for place_mm in PLACES_MM.values():
        distance_mm = np.hypot(*(drawn[:, :2] - place_mm).T)
        assert HELD_OUT_RADIUS_MM < distance_mm.min() < HELD_OUT_RADIUS_MM + 0.1
    assert (np.abs(drawn[:, :2]).max(axis=0) > 0.97 * SURFACE_REACH_MM).all() and np.ptp(drawn[:, 2]) > 350
    assert np.abs(drawn[:, :2]).max() <= SURFACE_REACH_MM
