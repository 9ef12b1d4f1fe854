"""Separate contacts of a pattern, and what happens to each from scan to scan."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_contract, make_scan
from scipy import ndimage

from edge.api import Patch, PatchEvents, Result, patches
from edge.perception.pattern_description import wrench_of

CONTRACT = make_contract(scale=10, contact_level=0.5)
PIXEL_MM = 0.47
ACROSS_MM = (np.arange(40) - 19.5) * PIXEL_MM
X_MM, Y_MM = np.meshgrid(ACROSS_MM, ACROSS_MM)


def result_of(pattern, traction=None, **more):
    wrench = None if traction is None else wrench_of(traction, 18.8 / traction.shape[-1])
    given = {"scan": make_scan(), "source": "device", "model": "m", "state": "contact", "contact": True, **more}
    return Result(pattern=pattern.astype(np.float32), traction=traction, wrench=wrench, **given)


def disc(x_mm, y_mm, radius_mm, depth_mm=1.0):
    return depth_mm * (np.hypot(X_MM - x_mm, Y_MM - y_mm) <= radius_mm)


def test_two_contacts_have_areas_centres_and_their_shares_of_the_force():
    traction = np.zeros((3, 8, 8), dtype=np.float32)
    traction[2, :, :4], traction[2, :, 4:], traction[0, :, 4:] = 2, 6, 3
    big, small = patches(result_of(disc(5, 0, 3) + disc(-5, 1, 2), traction, trusted=True), CONTRACT)
    for one, place, radius_mm in ((big, (5, 0), 3), (small, (-5, 1), 2)):
        assert one.centre_mm == pytest.approx(place, abs=0.1) and one.trusted
        assert one.area_mm2 == pytest.approx(np.pi * radius_mm**2, rel=0.05)
        assert one.size_mm == pytest.approx((2 * radius_mm,) * 2, rel=0.05), "four deviations of a disc are its width"
        assert one.normal == pytest.approx((0, 0, 1), abs=1e-3)
    total = np.array(result_of(disc(0, 0, 1), traction).wrench.force_n)
    assert np.add(big.force_n, small.force_n) == pytest.approx(total)
    assert big.shear_ratio == pytest.approx(0.5) and small.shear_ratio == 0


def test_a_bar_has_an_axis_and_a_tilted_face_its_normal():
    along, across = X_MM * np.cos(0.5) + Y_MM * np.sin(0.5), Y_MM * np.cos(0.5) - X_MM * np.sin(0.5)
    (bar,) = patches(result_of((abs(along) < 6) & (abs(across) < 1)), CONTRACT)
    assert bar.long_axis_deg == pytest.approx(np.degrees(0.5), abs=1) and bar.force_n is None is bar.shear_ratio
    assert bar.size_mm[0] > 4 * bar.size_mm[1]
    (face,) = patches(result_of((1 + 0.02 * X_MM) * disc(0, 0, 4)), CONTRACT)
    assert face.normal == pytest.approx(np.array([-0.02, 0, 1]) / np.hypot(0.02, 1), abs=1e-3)


def test_without_a_pattern_there_is_none_and_specks_are_none():
    assert patches(result_of(np.zeros((40, 40))), CONTRACT) == []
    assert patches(replace(result_of(np.zeros((40, 40))), pattern=None), CONTRACT) == []
    assert len(patches(result_of(disc(3, 0, 4) + disc(-8, -8, 0.5)), CONTRACT)) == 1


def test_areas_are_those_that_are_connected_by_edges():
    rng = np.random.default_rng(1)
    for _ in range(50):
        mask = rng.random((40, 40)) < rng.uniform(0.2, 0.8)
        labels, count = ndimage.label(mask)
        sizes = np.bincount(labels.ravel())[1:]
        expected = sorted(sizes[sizes >= 0.05 * mask.sum()] * PIXEL_MM**2)
        assert count and sorted(one.area_mm2 for one in patches(result_of(mask), CONTRACT)) == pytest.approx(expected)


def told(events, results):
    return [(one.kind, one.number) for result in results for one in events(result)]


def test_a_contact_begins_moves_and_ends_once():
    events, held = PatchEvents(CONTRACT), result_of(disc(-5, 0, 2))
    free = result_of(np.zeros((40, 40)), state="idle", contact=False)
    assert told(events, [held, held]) == [] and told(events, [held, held]) == [("begin", 1)]
    assert told(events, [result_of(disc(-5 + 0.25 * step, 0, 2)) for step in range(9)]) == [("move", 1)] * 2
    both = result_of(disc(-3, 0, 2) + disc(5, 5, 2))
    assert told(events, [both] * 3) == [("begin", 2)]
    assert told(events, [free, free, both]) == [], "missing for two results is no end"
    lost = [replace(both, state="dropped"), replace(both, trusted=False), replace(both, contact=None)]
    assert told(events, lost) == []
    assert told(events, [free] * 3) == [("end", 1), ("end", 2)] and told(events, [free] * 3) == []
    assert told(events, [held, free, held, free, held]) == [], "a flicker is no contact"


def test_a_slip_is_told_once_until_it_has_stuck_again():
    def sheared(ratio):
        traction = np.zeros((3, 8, 8), dtype=np.float32)
        traction[2], traction[0] = 5, 5 * ratio
        return result_of(disc(0, 0, 3), traction)

    events = PatchEvents(CONTRACT, slip_ratio=0.6)
    ratios = [0.1, 0.1, 0.1, 0.61, 0.7, 0.55, 0.61, 0.4, 0.61]
    got = [[one.kind for one in events(sheared(ratio))] for ratio in ratios]
    assert got == [[], [], ["begin"], ["slip"], [], [], [], [], ["slip"]]
    assert isinstance(events(sheared(0.1)), list) and isinstance(patches(sheared(0.1), CONTRACT)[0], Patch)
