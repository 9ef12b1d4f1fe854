from dataclasses import replace

import numpy as np
import pytest

from edge.perception.contact_options import ON_COUNTS
from firmware_bridge.pad_geometry import USPA44
from train.physics.sensor_noise import (
    LARGEST_COUNTS,
    NAMES,
    Nuisances,
    apply_nuisances,
    frame_weights,
    jitter_poses,
    read_windows,
)
from train.surfaces.depth_image import Pose

NONE = Nuisances().without(*NAMES)
STRONG = Nuisances(
    hysteresis=0.5,
    cross_talk=0.3,
    gain_spread=0.2,
    thermal_drift_counts=3e4,
    earth_field_counts=2e4,
    noise_counts=1e4,
    saturation_counts=(1e5, 1e5, 3e5),
    dead_taxels=0.1,
)
"""Strong enough that another draw of any one is no rounding error."""
ACTING = tuple(name for name in NAMES if not name.startswith("pose"))
ANGLES_DEG = np.array([0.0, 5.0, 90.0])


def alone(nuisances, name):
    return replace(NONE, **{name: getattr(nuisances, name)})


def presses(n=5, taps=3, frames=8, counts=1e5):
    peak = np.random.default_rng(1).uniform(-counts, 3 * counts, (n, taps, 1, 3, 4, 4))
    return (peak * np.linspace(1 / frames, 1, frames)[:, None, None, None] ** 1.5).astype(np.float32)


def zeros(n=5, taps=3, frames=8):
    return np.zeros((n, taps, frames, 3, 4, 4), dtype=np.float32)


@pytest.mark.parametrize("off", [None, *ACTING])
def test_each_acts_by_itself_and_in_its_turn(off):
    """All at once is one after the other, each run alone: so no draw depends on what else is on."""
    nuisances = STRONG.without(off) if off else STRONG
    together = apply_nuisances(presses(), nuisances, 7, angle_deg=ANGLES_DEG)
    in_turn = presses()
    for name in ACTING:
        in_turn = apply_nuisances(in_turn, alone(nuisances, name), 7, angle_deg=ANGLES_DEG)
    assert np.abs(together - in_turn).max() <= 4
    changed = np.abs(together - apply_nuisances(presses(), STRONG, 7, angle_deg=ANGLES_DEG)).max()
    assert (changed > 100) == (off is not None)


def test_the_seed_alone_decides():
    def read(seed):
        return apply_nuisances(presses(), STRONG, seed)

    assert np.array_equal(read(4), read(np.random.SeedSequence(4)))
    assert (read(4) != read(5)).any()
    first, second = np.random.SeedSequence(4).spawn(2)
    assert (read(first) != read(second)).any()
    assert (read(first) != read(4)).any()


def test_all_off_only_rounds_and_leaves_its_input_alone():
    clean = presses(counts=40.0)
    kept = clean.copy()
    assert np.array_equal(apply_nuisances(clean, NONE, 0), np.rint(clean))
    readings = apply_nuisances(clean, STRONG, 0)
    assert np.array_equal(clean, kept)
    assert readings.dtype == np.float32
    assert np.array_equal(readings, np.rint(readings))


def test_noise_is_as_large_as_it_says():
    readings = apply_nuisances(zeros(50), alone(Nuisances(), "noise_counts"), 0)
    assert readings.std() == pytest.approx(np.sqrt(2.0**2 + 1 / 12), rel=0.02)
    assert abs(readings.mean()) < 0.05


def test_gains_belong_to_a_sensor_and_are_cut():
    clean = np.full_like(zeros(400, 2, 3), 1e6)
    gains = apply_nuisances(clean, alone(Nuisances(), "gain_spread"), 0) / 1e6
    assert (gains == gains[:, :1, :1]).all()
    assert gains.std() == pytest.approx(0.075, rel=0.06)  # the cut takes 4 % of it
    assert np.abs(gains - 1).max() == pytest.approx(0.15, abs=1e-5)
    assert len(np.unique(gains[0, 0, 0])) > 40


def test_cross_talk_shows_in_the_four_neighbours_and_nowhere_else():
    clean = zeros(200)
    clean[..., 2, 1, 2] = 1e5
    readings = apply_nuisances(clean, alone(STRONG, "cross_talk"), 0)[..., 2, :, :]
    share = (readings.sum(axis=(-2, -1)) - 1e5) / 1e5
    assert (share == share[:, :1, :1]).all()
    assert 0 <= share.min() < 0.01
    assert 0.29 < share.max() <= 0.3
    neighbours = np.array([(0, 2), (2, 2), (1, 1), (1, 3)])
    quarter = readings[..., neighbours[:, 0], neighbours[:, 1]]
    assert np.allclose(quarter, share[..., None] / 4 * 1e5, atol=1)
    readings[..., neighbours[:, 0], neighbours[:, 1]] = 0
    assert (readings[..., 1, 2] == 1e5).all()
    assert np.count_nonzero(readings) == readings[..., 0, 0].size


def test_drift_is_common_mostly_along_z_and_lasts():
    drift = apply_nuisances(zeros(2000, 2, 2), alone(STRONG, "thermal_drift_counts"), 0)
    assert (drift == drift[:, :1, :1]).all()
    per_sensor = drift[:, 0, 0]
    common = per_sensor.mean(axis=(-2, -1))
    assert common.std(axis=0) == pytest.approx(3e4 * np.array([1 / 8, 1 / 8, 1.0]), rel=0.06)
    within = (per_sensor / common[..., None, None])[np.abs(common) > 1000].std(axis=(-2, -1))
    assert within.mean() == pytest.approx(0.25, rel=0.1)
    assert np.abs(np.corrcoef(common.T)[np.triu_indices(3, 1)]).max() < 0.1


def test_a_drift_of_two_deviations_is_no_contact():
    assert 2 * Nuisances().thermal_drift_counts < ON_COUNTS / USPA44.taxel_count


def test_the_earths_field_stands_still_while_the_pad_turns():
    angles = np.array([0.0, 90.0, 180.0, 270.0, 37.0, 360.0])
    earth = apply_nuisances(zeros(3000, 6, 2), alone(STRONG, "earth_field_counts"), 0, angle_deg=angles)
    assert (earth == earth[:, :, :1, :, :1, :1]).all()  # every taxel feels the same
    vector = earth[:, :, 0, :, 0, 0]
    assert np.array_equal(vector[:, 0], vector[:, 5])
    assert np.ptp(vector[..., 2], axis=1).max() == 0
    field = vector[..., :2] - (vector[:, :1, :2] + vector[:, 2:3, :2]) / 2  # half a turn takes the field's sign
    x, y = np.moveaxis(field, -1, 0)
    assert np.allclose(np.hypot(x, y), np.hypot(x, y)[:, :1], atol=3)
    # What lies to the pad's right, it finds below (along its rows) once it has turned to the left.
    assert np.allclose((x[:, 1], y[:, 1]), (-y[:, 0], x[:, 0]), atol=3)
    turn = np.angle((x + 1j * y)[:, 4] / (x + 1j * y)[:, 0], deg=True)
    assert np.allclose(turn[np.hypot(x, y)[:, 0] > 2000], 37.0, atol=0.2)
    # Two attitudes at random: mean square sqrt(2) times the field's length, nothing longer than twice it.
    length = np.linalg.norm(vector[:, 0], axis=-1)
    assert np.sqrt((length**2).mean()) == pytest.approx(2e4 * np.sqrt(2), rel=0.03)
    assert length.max() <= 4e4 + 2


def test_readings_end_where_the_range_ends():
    clean = presses()
    readings = apply_nuisances(clean, alone(Nuisances(), "saturation_counts"), 0)
    for axis, limit in enumerate(LARGEST_COUNTS):
        assert np.array_equal(readings[:, :, :, axis], np.rint(np.clip(clean[:, :, :, axis], -limit, limit)))
    assert np.array_equal(np.unique(np.abs(readings).max(axis=(0, 1, 2, 4, 5))), np.unique(LARGEST_COUNTS))


def test_dead_taxels_read_rest_for_as_long_as_the_sensor_lives():
    readings = apply_nuisances(presses(400) + 1e6, alone(STRONG, "dead_taxels"), 0)
    dead = readings == 0
    assert (dead == dead[:, :1, :1, :1]).all()
    assert dead.mean() == pytest.approx(0.1, abs=0.02)
    assert len({sensor.tobytes() for sensor in dead[:, 0, 0, 0]}) > 100


def maxwell(readings, time_s, share, relaxation_s):
    """Apply hysteresis step by step; the update is exact for readings linear in time, and q begins in equilibrium."""
    steps = np.maximum(np.diff(time_s) / relaxation_s, 1e-12)
    keep, mean = np.exp(-steps), -np.expm1(-steps) / steps
    lagging = np.array(readings, dtype=np.float64)
    for now in range(1, len(lagging)):
        k, m = keep[now - 1], mean[now - 1]
        lagging[now] = k * lagging[now - 1] + (m - k) * readings[now - 1] + (1 - m) * readings[now]
    return (1 - share) * readings + share * lagging


@pytest.mark.parametrize("relaxation", [1e-9, 0.05, 1.0, 30.0, 1e9])
def test_closed_form_and_steps_are_the_same_hysteresis(relaxation):
    rng = np.random.default_rng(0)
    frames, step_s, share = 16, 0.07, 0.3
    press = rng.normal(size=(frames, 5))
    moments = np.array([0.0, 0.25, 1.0, 1.5, 7.0, 15.9, 16.0])
    weights = frame_weights(
        moments[None, None], frames, np.array([[step_s]]), np.array([share]), np.array([relaxation])
    )
    times = np.union1d(np.arange(frames + 1.0), moments)
    course = np.stack([np.interp(times, np.arange(frames + 1), np.concatenate([[0], p])) for p in press.T], axis=1)
    stepped = maxwell(course, times * step_s, share, relaxation)
    assert np.allclose(weights[0, 0] @ press, stepped[np.searchsorted(times, moments)], atol=1e-5)


def test_sensors_differ_in_their_hysteresis():
    clean = np.full_like(zeros(400, 1, 4), 1e6) * np.linspace(0.25, 1, 4, dtype=np.float32)[:, None, None, None]
    only = alone(Nuisances(), "hysteresis")
    slow = apply_nuisances(clean, only, 0, tap_s=1e4) / clean
    assert np.allclose(slow, 1, atol=1e-3)
    quick = 1 - apply_nuisances(clean, only, 0, tap_s=1e-6)[:, 0, -1] / 1e6
    assert (quick == quick[:, :1, :1, :1]).all()
    assert 0.01 <= quick.min() < 0.012
    assert 0.108 < quick.max() <= 0.11 + 1e-6


def test_a_window_holds_the_frames_asked_for():
    clean = presses()
    quiet = STRONG.without("noise_counts")
    every = apply_nuisances(clean, quiet, 5, angle_deg=ANGLES_DEG)
    frame = np.random.default_rng(0).integers(8, size=(5, 3))
    window = read_windows(clean, (frame + 1) / 8, quiet, 5, angle_deg=ANGLES_DEG)
    picked = np.take_along_axis(every, frame[:, :, None, None, None, None], axis=2)[:, :, 0]
    assert np.abs(window - picked).max() <= 1
    halfway = read_windows(clean, 4.5 / 8, NONE, 5)
    assert np.abs(halfway - (clean[:, :, 3] + clean[:, :, 4]) / 2).max() <= 0.51
    assert not read_windows(clean, 0.0, NONE, 5).any()


def test_poses_are_missed_by_as_much_as_it_says():
    poses = [Pose(1.0, -2.0, 30.0)] * 4000
    hit = np.array([(p.x_mm, p.y_mm, p.angle_deg) for p in jitter_poses(np.random.default_rng(0), poses, Nuisances())])
    assert hit.mean(axis=0) == pytest.approx((1.0, -2.0, 30.0), abs=0.05)
    assert hit.std(axis=0) == pytest.approx((0.2, 0.2, 1.0), rel=0.07)
    assert jitter_poses(np.random.default_rng(0), poses, NONE) == poses
