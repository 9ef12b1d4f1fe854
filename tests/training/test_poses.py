import numpy as np
import pytest

from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import (
    HELD_OUT_RADIUS_MM,
    POSITION_STEP_MM,
    SURFACE_REACH_MM,
    TARGET_ANGLES_DEG,
    TEST_POSITION,
    VALIDATION_POSITION,
    paper_taps_of,
    position_mm,
    random_poses,
)


def test_the_nine_positions_are_a_grid_from_the_top_left():
    grid = np.array([position_mm(i) for i in range(9)]).reshape(3, 3, 2)
    assert np.allclose(np.diff(grid[..., 0], axis=1), POSITION_STEP_MM)
    assert np.allclose(np.diff(grid[..., 1], axis=0), -POSITION_STEP_MM)
    assert tuple(grid[1, 1]) == (0, 0)


@pytest.mark.parametrize(("split", "position"), [("test", TEST_POSITION), ("validation", VALIDATION_POSITION)])
def test_a_split_has_the_papers_targets_each_tap_turned_back_one_more_step(split, position):
    names, poses = paper_taps_of(split, SURFACES)
    assert len(names) == 72 and set(names) == set(SURFACES)
    assert {(pose.x_mm, pose.y_mm) for pose in poses} == {position_mm(position)}
    turns = np.array([pose.angle_deg for pose in poses]).reshape(72, 7)
    assert set(turns[:, 0]) == set(TARGET_ANGLES_DEG) and (np.diff(turns, axis=1) == -5).all()
    # The paper's own sequence: its 30 deg pose follows 25, 20, ..., 0.
    assert turns[1].tolist() == [30, 25, 20, 15, 10, 5, 0]
    assert paper_taps_of(split, SURFACES, 2)[1] == [pose for i, pose in enumerate(poses) if i % 7 < 2]
    assert paper_taps_of(split, SURFACES[:1], 2, 20.0)[1][1].angle_deg == -20


@pytest.mark.parametrize(
    ("taps", "step", "complaint"), [(0, 5, "0 taps"), (8, 5, "8 taps"), (2, 181, "181"), (2, -1, "-1")]
)
def test_schedules_that_cannot_be_are_refused(taps, step, complaint):
    with pytest.raises(ValueError, match=complaint):
        paper_taps_of("test", SURFACES, taps, step)


def test_random_poses_are_seeded_wide_and_away_from_the_held_out_positions():
    drawn = random_poses(np.random.default_rng(1), 3000)
    x_mm, y_mm, angle_deg = np.array([(p.x_mm, p.y_mm, p.angle_deg) for p in drawn]).T
    for position in (TEST_POSITION, VALIDATION_POSITION):
        held_out = position_mm(position)
        distance_mm = np.hypot(x_mm - held_out[0], y_mm - held_out[1])
        assert HELD_OUT_RADIUS_MM < distance_mm.min() < HELD_OUT_RADIUS_MM + 0.1
    for along in (x_mm, y_mm):
        assert 0.97 * SURFACE_REACH_MM < np.abs(along).max() <= SURFACE_REACH_MM
    assert np.allclose(np.histogram(angle_deg, 12, (0, 360))[0], 250, atol=70)
    assert random_poses(np.random.default_rng(1), 3000) == drawn != random_poses(np.random.default_rng(2), 3000)
