import numpy as np
import pytest

from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import (
    HELD_OUT_RADIUS_MM,
    POSITION_STEP_MM,
    SURFACE_REACH_MM,
    TARGET_ANGLES_DEG,
    as_poses,
    paper_targets,
    position_mm,
    positions_of,
    random_targets,
    turned_back,
)


def test_the_nine_positions_are_a_grid_from_the_top_left():
    grid = np.array([position_mm(i) for i in range(9)]).reshape(3, 3, 2)
    assert np.allclose(np.diff(grid[..., 0], axis=1), POSITION_STEP_MM)
    assert np.allclose(np.diff(grid[..., 1], axis=0), -POSITION_STEP_MM)
    assert tuple(grid[1, 1]) == (0, 0)


def test_splits_by_position_share_nothing_and_have_the_papers_sizes():
    assert sorted(positions_of("train") + positions_of("validation") + positions_of("test")) == list(range(9))
    sizes = {split: len(paper_targets(positions_of(split))) for split in ("train", "validation", "test")}
    assert sizes == {"train": 504, "validation": 72, "test": 72}
    test = paper_targets(positions_of("test"))
    assert {(pose.x_mm, pose.y_mm) for pose in test.poses} == {position_mm(0)}
    assert set(test.surfaces) == set(SURFACES)
    assert {pose.angle_deg for pose in test.poses} == set(TARGET_ANGLES_DEG)


def test_every_k_has_the_same_targets_and_each_tap_is_turned_back_one_more_step():
    targets = paper_targets(positions_of("validation"))
    seven = turned_back(targets, 7)
    for taps in range(1, 8):
        assert np.array_equal(turned_back(targets, taps), seven[:, :taps])
    assert np.array_equal(seven[:, 0], [(p.x_mm, p.y_mm, p.angle_deg) for p in targets.poses])
    assert (np.diff(seven[..., 2], axis=1) == -5).all()
    assert (np.diff(seven[..., :2], axis=1) == 0).all()
    # The paper's own sequence: its 30 deg pose follows 25, 20, ..., 0.
    at_30 = seven[seven[:, 0, 2] == 30][0, :, 2]
    assert at_30.tolist() == [30, 25, 20, 15, 10, 5, 0]
    assert (np.diff(turned_back(targets, 2, 20.0)[..., 2], axis=1) == -20).all()


@pytest.mark.parametrize(
    ("taps", "step", "complaint"), [(0, 5, "0 taps"), (8, 5, "8 taps"), (2, 181, "181"), (2, -1, "-1")]
)
def test_schedules_that_cannot_be_are_refused(taps, step, complaint):
    with pytest.raises(ValueError, match=complaint):
        turned_back(paper_targets([0]), taps, step)


def test_random_poses_are_seeded_wide_and_away_from_the_held_out_positions():
    drawn = random_targets(np.random.default_rng(1), 3000)
    x_mm, y_mm, angle_deg = np.array([(p.x_mm, p.y_mm, p.angle_deg) for p in drawn.poses]).T
    for position in (*positions_of("test"), *positions_of("validation")):
        held_out = position_mm(position)
        distance_mm = np.hypot(x_mm - held_out[0], y_mm - held_out[1])
        assert HELD_OUT_RADIUS_MM < distance_mm.min() < HELD_OUT_RADIUS_MM + 0.1
    for along in (x_mm, y_mm):
        assert 0.97 * SURFACE_REACH_MM < np.abs(along).max() <= SURFACE_REACH_MM
    assert np.allclose(np.histogram(angle_deg, 12, (0, 360))[0], 250, atol=70)
    again = random_targets(np.random.default_rng(1), 3000)
    assert again == drawn
    assert random_targets(np.random.default_rng(2), 3000) != drawn


def test_poses_come_back_from_their_array():
    assert as_poses(turned_back(paper_targets([4], ["C"]), 1)) == [Pose(0.0, 0.0, angle) for angle in TARGET_ANGLES_DEG]
