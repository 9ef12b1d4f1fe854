"""Regions of a pattern, and half widths at several levels."""

import numpy as np
import pytest

from edge.inference.intervals import REGIONS, half_widths_mm, near_pixels, regions


def test_regions_lie_around_the_contact():
    pattern = np.zeros((1, 40, 40), dtype=np.float32)
    pattern[0, 10:20, 10:20] = 0.2
    region = regions(pattern, 0.3, 4)[0]
    assert [REGIONS[region[15, x]] for x in (15, 11, 10, 9, 8, 6, 5)] == [
        *("inside", "inside", "edge", "edge", "near", "near", "far"),
    ]
    counts = np.bincount(region.ravel(), minlength=4).tolist()
    assert counts == [64, 144 - 64, 18 * 18 - 144, 1600 - 18 * 18]


def test_the_pads_own_rim_is_no_edge():
    everywhere = np.full((1, 8, 8), 0.1, dtype=np.float32)
    assert (regions(everywhere, 0.3, 2) == REGIONS.index("inside")).all()


def test_nothing_touched_is_far_from_everything():
    assert (regions(np.zeros((2, 8, 8), dtype=np.float32), 0.3, 2) == REGIONS.index("far")).all()


@pytest.mark.parametrize(("scale", "pixels"), [(10, 4), (20, 9), (4, 2), (2, 1)])
def test_near_is_two_millimetres(scale, pixels):
    assert near_pixels(scale, 4.7) == pixels


def test_half_widths_have_the_factor_of_their_region():
    levels = {"50": [0.5, 0.6, 0.7, 0.8], "90": [1.6, 1.6, 1.6, 1.6]}
    region = np.array([[[0, 1], [2, 3]]])
    deviations = np.full((1, 2, 2), 0.1, dtype=np.float32)
    np.testing.assert_allclose(half_widths_mm(levels, "50", deviations, region), [[[0.05, 0.06], [0.07, 0.08]]])
    np.testing.assert_allclose(half_widths_mm(levels, "90", deviations, region), 0.16, rtol=1e-6)
