import numpy as np
import pytest

from firmware_bridge.geometry import USPA44
from train.dataset import (
    ANGLE_STEP_DEG,
    FRAMES,
    MAX_TAPS,
    SET_FORCE_N,
    TEST_POSITION,
    VALIDATION_POSITION,
    freeze,
    held_out_poses,
    position_mm,
    quarter_turns,
    random_poses,
    solve_sequences,
    training_batches,
)
from train.depth import Pose
from train.freeze import demo_recording
from train.simulation import MAX_INDENTATION_MM, SimulatedSensor
from train.skin import NEWTONS_PER_COUNT_Z, Nuisances

QUIET = Nuisances(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def sensor():
    return SimulatedSensor()


@pytest.fixture(scope="module")
def solved(sensor):
    return solve_sequences(sensor, *random_poses(np.random.default_rng(0), 36))


def test_the_nine_positions_are_a_grid():
    assert len({position_mm(i) for i in range(9)}) == 9
    assert position_mm(4) == (0, 0)
    assert position_mm(0)[0] < 0 < position_mm(0)[1]


def test_training_keeps_away_from_the_held_out_positions():
    _, poses = random_poses(np.random.default_rng(1), 2000)
    for held_out in (TEST_POSITION, VALIDATION_POSITION):
        x_mm, y_mm = position_mm(held_out)
        assert min(np.hypot(pose.x_mm - x_mm, pose.y_mm - y_mm) for pose in poses) > 1.0


def test_held_out_poses_are_every_surface_at_four_angles():
    names, poses = held_out_poses(TEST_POSITION)
    assert len(names) == 72
    assert {(p.x_mm, p.y_mm) for p in poses} == {position_mm(TEST_POSITION)}
    assert {p.angle_deg for p in poses} == {0, 30, 60, 90}


def test_a_sequence_ends_at_its_pose_and_was_turned_step_by_step(sensor):
    pose = Pose(1.0, -0.5, 40.0)
    sequence = solve_sequences(sensor, ["T"], [pose])
    earlier = sensor.tap(["T"], [Pose(1.0, -0.5, 40.0 - 2 * ANGLE_STEP_DEG)])
    newest = sensor.tap(["T"], [pose])
    assert np.allclose(sequence.readings[0, 0], newest.readings[0], rtol=1e-2, atol=5)
    assert np.allclose(sequence.readings[0, 2], earlier.readings[0], rtol=1e-2, atol=5)
    assert np.allclose(sequence.patterns[0], newest.patterns[0])


def test_a_tap_ends_at_its_force_or_at_the_deepest(solved):
    light, firm = solved.end_mm(np.full((36, MAX_TAPS), 0.5)), solved.end_mm(np.full((36, MAX_TAPS), 1e3))
    assert np.allclose(light * solved.force_n_per_mm, 0.5)
    assert (firm == np.float32(MAX_INDENTATION_MM)).all()


def test_a_pose_off_the_figure_is_refused(sensor):
    with pytest.raises(ValueError, match="misses the figure of surface 'I'"):
        sensor.tap(["L", "I"], [Pose(0, 0, 0), Pose(17, 0, 0)])


def test_turning_the_pad_is_what_quarter_turns_say(sensor):
    here, turned = sensor.tap(["P"] * 2, [Pose(1.0, 2.0, 10.0), Pose(1.0, 2.0, -80.0)]), None
    turned, pattern = quarter_turns(here.readings[:1], here.patterns[:1], 1)
    # The grid's own edges differ by a cell here and there.
    assert np.corrcoef(pattern.ravel(), here.patterns[1].ravel())[0, 1] > 0.995
    assert np.corrcoef(turned.ravel(), here.readings[1].ravel())[0, 1] > 0.995
    same, _ = quarter_turns(here.readings[:1], here.patterns[:1], 4)
    assert np.allclose(same, here.readings[:1])


def test_batches_are_seeded_and_newest_first(solved):
    def first(seed, nuisances):
        return next(training_batches(solved, np.random.default_rng(seed), nuisances, USPA44, 8, SET_FORCE_N))

    windows, patterns = first(3, Nuisances())
    again, _ = first(3, Nuisances())
    assert (windows == again).all()
    assert (windows != first(4, Nuisances())[0]).any()
    assert windows.shape == (8, MAX_TAPS, 3, 4, 4)
    assert patterns.shape == (8, 40, 40)
    assert patterns.max() <= MAX_INDENTATION_MM
    quiet, _ = first(3, QUIET)
    force_n = quiet[:, :, 2].sum(axis=(2, 3)) * NEWTONS_PER_COUNT_Z
    assert (
        force_n[:, 0] < 1.2 * force_n[:, 1:].max(axis=1)
    ).all()  # the newest tap is on its way, the others at their end


def test_frozen_frames_rise_to_the_set_force_and_share_their_earlier_taps(sensor):
    frozen = freeze(sensor, TEST_POSITION, QUIET, 5)
    force_n = frozen.force_n.reshape(-1, FRAMES)
    assert (np.diff(force_n, axis=1) > 0).all()
    assert np.allclose(force_n[:, 0] / force_n[:, -1], 0.3, atol=1e-3)
    assert force_n.max() == pytest.approx(5.0, rel=1e-3)
    newest = frozen.newest.reshape(72, FRAMES, 3, 4, 4)
    assert np.allclose(newest[:, -1] * 0.3, newest[:, 0], atol=1)
    assert (
        freeze(sensor, TEST_POSITION, Nuisances(), 5).sha256() == freeze(sensor, TEST_POSITION, Nuisances(), 5).sha256()
    )


def test_the_demo_rests_long_enough_to_zero_and_taps_four_times(sensor):
    demo = demo_recording(sensor)
    tap = demo["tap"]
    assert (tap[:120] == -1).all()
    assert [int(np.count_nonzero(np.diff((tap == k).astype(int)) == 1)) for k in range(4)] == [1, 1, 1, 1]
    assert np.diff(demo["angles_deg"]).tolist() == [5, 5, 5]
    rest = np.median(demo["counts"][:120], axis=0)
    force = (demo["counts"][:, 2] - rest[2]).sum(axis=(1, 2))
    assert force[tap < 0].max() < 200
    assert force.max() > 3000
    assert demo["counts"].min() >= 0
    assert demo["counts"].max() <= 65535
