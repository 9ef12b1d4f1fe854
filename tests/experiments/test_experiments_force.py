from dataclasses import replace

import numpy as np
import pytest
from experiment_samples import quick_bench

from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS
from train.data.paper_taps import between_frames
from train.experiments import force
from train.experiments.force import (
    CLAIM_N,
    HOLD,
    PRESS,
    RANGE_N,
    RELEASE,
    REST,
    Course,
    Scans,
    contact,
    course_errors,
    loop_percent,
    pressed,
    training_presses,
)
from train.experiments.paper_tables import mixed
from train.experiments.workbench import Method
from train.physics.sensor_noise import NAMES, Nuisances


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return quick_bench(tmp_path_factory)


@pytest.fixture(scope="module")
def sequences(bench):
    return bench.held_out("test").at_scale(10)


@pytest.fixture(scope="module")
def scans(sequences):
    return force.scans_between(sequences, (0.2, 0.4), 3, [1])


def test_forces_lie_within_their_range(sequences, scans):
    # Contacts are flat: force is proportional to the pattern, and the whole press' force and pattern are given.
    whole = sequences.patterns_at(scans.tap, np.ones(len(scans.tap))).sum(axis=(1, 2))
    force_n = sequences.force_n[scans.tap, 0, -1] * scans.patterns.sum(axis=(1, 2)) / whole
    assert (force_n > 0.2 * 0.999).all()
    assert (force_n < 0.4 * 1.001).all()
    assert np.ptp(force_n) > 0.1
    assert np.bincount(scans.tap, minlength=len(sequences)).tolist() == [3] * len(sequences)
    z = scans.windows[:, :, 2].sum(axis=(-2, -1))
    assert (z[:, 1:].min(axis=1) > 4000).all(), "earlier taps have come to their ends: 5 N at 1400 counts a newton"
    assert (z[:, 0] < 3000).all()


def test_a_relative_error_is_that_of_the_scale_and_the_truth_has_none(scans):
    for factor, percent in ((1.1, 10), (0.5, 50), (3.0, 200), (0.0, 100)):
        found = force.errors(_giving(factor * scans.patterns), scans)["relative_percent"]
        np.testing.assert_allclose(found, percent, rtol=1e-4)
    found = force.errors(_giving(scans.patterns), scans)
    assert np.isinf(found["psnr_db"]).all() and (found["relative_percent"] == 0).all()
    np.testing.assert_allclose(found["ssim_own"], 1)
    blurred = (scans.patterns + np.roll(scans.patterns, 2, axis=1)) / 2
    light = force.errors(_giving(blurred), scans)
    heavy = force.errors(_giving(5 * blurred), scans._replace(patterns=5 * scans.patterns))
    for key in ("ssim_own", "relative_percent", "contact_iou"):
        np.testing.assert_allclose(heavy[key], light[key], rtol=1e-4)
    assert (heavy["ssim"] < light["ssim"]).all() and (heavy["psnr_db"] < light["psnr_db"]).all()


def _giving(patterns):
    return Method("given", 1, 0.5, lambda _: (patterns, None))


COURSE = Course(20.0)
NONE = Nuisances().without(*NAMES)
GAINS = replace(NONE, gain_spread=0.075)
RAMP_N = 5.0 * COURSE.share


@pytest.fixture(scope="module")
def four(bench):
    return bench.held_out("test").newest(4)


def z_of(scans):
    return scans.windows[:, 0, 2].sum(axis=(1, 2))


def test_a_course_presses_holds_releases_and_rests():
    assert np.bincount(COURSE.phase).tolist() == [40, 100, 20, 40]
    press, hold, release, rest = (COURSE.share[COURSE.phase == phase] for phase in range(4))
    np.testing.assert_allclose(press, np.arange(1, 41) / 40)
    np.testing.assert_allclose(hold, 1)
    np.testing.assert_allclose(release, np.arange(19, -1, -1) / 20, atol=1e-12)
    np.testing.assert_allclose(rest, 0)
    assert COURSE.time_s[0] == pytest.approx(0.05)  # a step after the pad was free
    assert COURSE.time_s[-1] == pytest.approx(10)


def test_without_nuisances_a_press_and_its_release_read_alike(four):
    scans = pressed(four, 0, COURSE, NONE)
    assert scans.force_n.max() == pytest.approx(5.0, rel=1e-5)
    assert loop_percent(scans.force_n, z_of(scans) / 1400, COURSE) < 0.2  # counts are whole
    np.testing.assert_allclose(scans.volume_mm3 / scans.volume_mm3.max(), scans.force_n / 5.0, atol=1e-5)
    assert (scans.windows[COURSE.phase == REST, 0] == 0).all()
    end = four.share_at_force(np.array([0]), 5.0)
    for tap in range(4):
        clean = between_frames(four.counts[:1, tap], end[:, tap : tap + 1])[0, 0]
        np.testing.assert_allclose(scans.windows[100, tap], np.rint(clean), atol=1)
    assert (scans.windows[:, 1:] == scans.windows[:1, 1:]).all()
    lagging = pressed(four, 0, COURSE, replace(NONE, hysteresis=0.11))
    assert loop_percent(scans.force_n, z_of(lagging) / 1400, COURSE) > 0.5


def test_a_loop_is_the_largest_difference_at_equal_force():
    found = RAMP_N.copy()
    assert loop_percent(RAMP_N, found, COURSE) == pytest.approx(0, abs=1e-9)
    release = COURSE.phase == RELEASE
    found[release] += 0.4 * np.sin(np.pi * RAMP_N[release] / 5)  # widest half-way
    found[(COURSE.phase == HOLD) | (COURSE.phase == REST)] = 99  # neither is part of it
    assert loop_percent(RAMP_N, found, COURSE) == pytest.approx(100 * 0.4 / RANGE_N, rel=0.01)


def figures(found_n, gate):
    """Errors without their labels: common factor, own factor, above the threshold, loop, rest, false, past, missed."""
    return [*course_errors(RAMP_N, found_n, gate, COURSE).values()]


def test_figures_of_a_course_in_closed_form():
    open_, rest = RAMP_N > 1.0, COURSE.phase == REST
    assert figures(RAMP_N, RAMP_N > 0) == pytest.approx([0, 0, 0, 0, 0, 0, 0, 100 / 160])  # the release ends free
    error, own, gated, *_, missed = figures(RAMP_N / 2, open_)
    assert error == pytest.approx(100 * np.sqrt(np.mean((RAMP_N / 2) ** 2)) / RANGE_N)
    assert own == pytest.approx(0, abs=1e-9)
    assert gated == pytest.approx(100 * np.sqrt(np.mean(np.where(open_, RAMP_N / 2, RAMP_N) ** 2)) / RANGE_N)
    assert missed == pytest.approx(100 * (~open_)[~rest].mean())
    error, *_, at_rest, false, past, missed = figures(RAMP_N + 1.01 * CLAIM_N, np.ones(200, dtype=bool))
    assert [error, at_rest] == pytest.approx([101 * CLAIM_N / RANGE_N] * 2)
    assert (false, past, missed) == (100, 100, 0)
    assert figures(RAMP_N + 0.99 * CLAIM_N, open_)[5] == figures(RAMP_N - 1, open_)[5] == 0


def test_the_runtimes_threshold_opens_late_and_closes_later():
    windows = np.zeros((200, 1, 3, 4, 4), dtype=np.float32)
    windows[:, 0, 2] = (1400 * RAMP_N / 16)[:, None, None]
    gate = contact(Scans(windows, RAMP_N, RAMP_N), COURSE)
    z = windows[:, 0, 2].sum(axis=(1, 2))
    press, release = COURSE.phase == PRESS, COURSE.phase == RELEASE
    np.testing.assert_array_equal(gate[press], z[press] >= ON_COUNTS)
    np.testing.assert_array_equal(gate[release], z[release] >= OFF_COUNTS)
    assert gate[COURSE.phase == HOLD].all()
    assert not gate[COURSE.phase == REST].any()


def test_training_presses_go_with_their_forces(bench):
    scans = training_presses(mixed(bench), 40)
    assert scans.windows.shape == (40, 4, 3, 4, 4)
    assert 0.3 * 0.99 < scans.force_n.min() < 2
    assert scans.force_n.max() > 6
    np.testing.assert_allclose(z_of(scans) / scans.force_n, 1450, rtol=0.5)  # some lie on the rim or are dragged
    # A deformation is a force over a stiffness; one figure's may be a few times another's, not more.
    assert np.ptp(np.log(scans.volume_mm3 / scans.force_n)) < np.log(4)
