"""A non-negative pressure explains a press on its own pad, with drag and from several taps."""

import numpy as np
import pytest

from edge.evaluation.metrics import psnr_db
from train.experiments.nonnegative import NonnegativeInverse
from train.physics.contact import BARE
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import Pad

SHIFT_MM, TURN_DEG = 2.35, 60


@pytest.fixture(scope="module")
def pressed():
    """A dome beside the middle: by the pad, by one that is shifted and turned, and once more with drag."""
    gripped = GrippedPad(Pad())
    x_mm, y_mm = gripped.places_mm
    cosine, sine = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    moved = (SHIFT_MM + cosine * x_mm - sine * y_mm, sine * x_mm + cosine * y_mm)
    heights_mm = np.stack([-(np.hypot(x - 3, y + 2) ** 2) / 12 for x, y in ((x_mm, y_mm), moved, (x_mm, y_mm))])
    slides_mm = np.array([[0.0, 0.0], [0.0, 0.0], [0.3, 0.1]])
    return gripped.press(heights_mm, np.full(3, 0.4), slides_mm, np.zeros(3), np.full(3, 0.6), [BARE] * 3)


@pytest.fixture(scope="module")
def inverse():
    return NonnegativeInverse(Pad(), gain_error=0.02)


def found_db(inverse, pressed, taps, poses):
    return float(
        psnr_db(inverse(pressed.counts[taps], np.array(poses, dtype=float))[None], pressed.patterns[:1], 0.5)[0]
    )


def test_a_press_is_found_where_it_is_and_as_deep(inverse, pressed):
    assert found_db(inverse, pressed, [0], [(0, 0, 0)]) > 30
    pattern = inverse(pressed.counts[:1], np.zeros((1, 3)))
    assert pattern.min() >= 0 and pattern.max() == pytest.approx(0.4, rel=0.3)


def test_drag_is_no_other_press(inverse, pressed):
    assert np.abs(pressed.counts[2] - pressed.counts[0]).max() > 100
    assert found_db(inverse, pressed, [2], [(0, 0, 0)]) > 29


def test_an_earlier_tap_helps_only_from_where_it_was(inverse, pressed):
    right = found_db(inverse, pressed, [0, 1], [(0, 0, 0), (SHIFT_MM, 0, TURN_DEG)])
    for wrong in ((-SHIFT_MM, 0, TURN_DEG), (SHIFT_MM, 0, -TURN_DEG)):
        assert right > 30 and right > found_db(inverse, pressed, [0, 1], [(0, 0, 0), wrong]) + 3
