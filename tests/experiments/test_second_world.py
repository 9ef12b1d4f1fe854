"""The second world obeys the closed forms of a half-space; and a non-negative pressure explains a press."""

import numpy as np
import pytest

from edge.evaluation.metrics import psnr_db
from firmware_bridge.pad_geometry import USPA44
from train.experiments.nonnegative import NonnegativeInverse
from train.experiments.second_world import movement, places, pressed
from train.physics.contact import BARE
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import Pad

CELLS, RADIUS_MM, DEPTH_MM = 34, 4.0, 0.3
CELL_MM = USPA44.width_mm / CELLS


def test_a_flat_round_punch_has_its_force_and_its_surface():
    """Force 4 G a d / (1 - nu), and outside of it a sinking of (2 d / pi) asin(a / r)."""
    away_mm, pixel_mm = (np.hypot(*places(*grid)) for grid in ((CELLS, USPA44.width_mm), (40, 4 * USPA44.pitch_mm)))
    pressure, sunk_mm = pressed(np.where(away_mm < RADIUS_MM, 0.0, 5.0), DEPTH_MM)
    assert pressure.sum() * CELL_MM**2 == pytest.approx(4 * RADIUS_MM * DEPTH_MM / (2 * np.pi), rel=0.02)
    inside, outside = pixel_mm < RADIUS_MM - 0.5, pixel_mm > RADIUS_MM + 0.5
    assert sunk_mm[inside] == pytest.approx(DEPTH_MM, abs=0.01)
    expected_mm = 2 * DEPTH_MM / np.pi * np.arcsin(RADIUS_MM / pixel_mm[outside])
    assert sunk_mm[outside] == pytest.approx(expected_mm, rel=0.05)


def test_a_ball_is_let_go_of_where_it_would_pull():
    """Hertz: force (4 / 3 pi) sqrt(R) d^1.5 within sqrt(R d)."""
    away_mm = np.hypot(*places(CELLS, USPA44.width_mm))
    pressure, _ = pressed(away_mm**2 / 80, DEPTH_MM)
    assert pressure.sum() * CELL_MM**2 == pytest.approx(4 / (3 * np.pi) * 40**0.5 * DEPTH_MM**1.5, rel=0.03)
    assert away_mm[pressure > 0].max() == pytest.approx((40 * DEPTH_MM) ** 0.5, abs=CELL_MM)


def test_a_point_below_an_even_round_load_sinks_by_closed_form():
    """On the axis ((1 - nu) (s - z) + z (1 - z / s) / 2) / G for a pressure of 1, s the distance of the load's rim."""
    poisson, z = 0.45, 2.5
    taxel_mm = USPA44.taxel_centres_mm()[5]
    load = np.hypot(*(places(CELLS, USPA44.width_mm)[axis] - taxel_mm[axis] for axis in (0, 1))) < RADIUS_MM
    found = movement(1.0, poisson, z)[0, :, 5] @ load
    rim = np.hypot(RADIUS_MM, z)
    assert found[2] == pytest.approx((1 - poisson) * (rim - z) + z * (1 - z / rim) / 2, rel=0.02)
    assert abs(found[:2]).max() < 0.02 * found[2]


def test_drag_moves_points_its_own_way_and_answers_to_pressure():
    """At the surface a drag sinks a point as far as a pressure moves it against the drag (reciprocity)."""
    moved = movement(1.0, 0.4, 1e-3)
    assert (moved[1, 0] > 0).all() and (moved[2, 1] > 0).all()
    far = np.hypot(moved[0, 0], moved[0, 1]) < 0.01
    for axis in (0, 1):
        assert moved[1 + axis, 2][far] == pytest.approx(-moved[0, axis][far], abs=1e-4)


SHIFT_MM, TURN_DEG = 2.35, 60


def test_a_pressure_explains_a_press_its_drag_and_its_taps():
    """A dome beside the middle: by the pad, by one that is shifted and turned, and once more with drag."""
    gripped, inverse = GrippedPad(Pad()), NonnegativeInverse(Pad(), gain_error=0.02)
    x_mm, y_mm = gripped.places_mm
    cosine, sine = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    moved = (SHIFT_MM + cosine * x_mm - sine * y_mm, sine * x_mm + cosine * y_mm)
    heights_mm = np.stack([-(np.hypot(x - 3, y + 2) ** 2) / 12 for x, y in ((x_mm, y_mm), moved, (x_mm, y_mm))])
    slides_mm = np.array([[0.0, 0.0], [0.0, 0.0], [0.3, 0.1]])
    done = gripped.press(heights_mm, np.full(3, 0.4), slides_mm, np.zeros(3), np.full(3, 0.6), [BARE] * 3)

    def found_db(taps, *poses):
        pattern = inverse(done.counts[taps], np.array([(0, 0, 0), *poses], dtype=float))
        assert pattern.min() >= 0
        return float(psnr_db(pattern[None], done.patterns[:1], 0.5)[0])

    assert found_db([0]) > 30
    assert np.abs(done.counts[2] - done.counts[0]).max() > 100
    assert found_db([2]) > 29, "drag is no other press"
    right = found_db([0, 1], (SHIFT_MM, 0, TURN_DEG))
    assert right > 30
    for wrong in ((-SHIFT_MM, 0, TURN_DEG), (SHIFT_MM, 0, -TURN_DEG)):
        assert right > found_db([0, 1], wrong) + 3
