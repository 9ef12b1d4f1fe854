import numpy as np
import pytest

from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED, free_stretch


def scans(*levels, seed=3):
    """Return counts of (count, press) parts, with the noise of a still pad; a press of None moves all the time."""
    rng, parts = np.random.default_rng(seed), []
    for count, press in levels:
        part = 30000 + rng.normal(0, 3, (count, 3, 4, 4))
        part[:, 2] += np.linspace(200, 3000, count)[:, None, None] if press is None else press
        parts.append(part)
    return np.concatenate(parts).round().astype(np.int32)


def test_the_freest_still_scans_are_taken_wherever_they_are():
    counts = scans((120, None), (150, 1000), (80, None), (60, 0), (40, None))
    stretch = free_stretch(counts)
    assert stretch.rows[0] >= 349 and stretch.rows[-1] < 411 and len(stretch.rows) == FEWEST_RECORDED
    baseline = stretch.baseline("4", 5.0)
    assert np.abs(baseline.counts - 30000).max() < 3
    assert (baseline.scans, baseline.origin) == (len(stretch.rows), "recording")
    assert not stretch.opens and stretch.touched


def test_a_still_grip_is_not_free():
    """Still for longer than any other part, and loaded: the pad is free elsewhere, if never for long enough."""
    with pytest.raises(BaselineRefusedError, match=r"nowhere free and still for 30 scans.*"):
        free_stretch(scans((200, 1000), (40, None), (FEWEST_RECORDED - 5, 0), (40, None)))


def recovering(scans, counts, seed=3):
    """Counts of a pad that recovers by so many counts a taxel on z after a grip."""
    rng = np.random.default_rng(seed)
    grip = 30000 + rng.normal(0, 2, (40, 3, 4, 4))
    grip[:, 2] += 600 + 20 * np.sin(np.arange(40))[:, None, None]
    free = 30000 + rng.normal(0, 2, (scans, 3, 4, 4))
    free[:, 2] += counts * np.linspace(1, 0, scans)[:, None, None]
    return np.concatenate([grip, free]).round().astype(np.int32)


def test_where_a_pad_only_recovers_its_freest_scans_are_taken():
    stretch = free_stretch(recovering(38, 40))
    assert stretch.touched and not stretch.opens and stretch.rows.tolist() == list(range(48, 78))
    assert stretch.within_counts == pytest.approx(16, abs=5)
    assert np.abs(stretch.baseline("4", 5.0).counts - 30000).max() < 16 + 8
    assert free_stretch(recovering(200, 40)).within_counts is None, "still at its end"
    with pytest.raises(BaselineRefusedError, match="nowhere free and still"):
        free_stretch(recovering(38, 200))


def test_a_free_beginning_is_where_a_live_run_zeroes():
    stretch = free_stretch(scans((110, 2), (50, None), (100, 0)))
    assert stretch.opens and stretch.rows.tolist() == list(range(100)) and stretch.touched


def test_without_a_contact_nothing_shows_that_a_pad_is_free():
    assert not free_stretch(scans((40, 8), (60, 0), (40, 60))).touched  # 960 counts in all
    assert free_stretch(scans((40, 8), (60, 0), (5, 100))).touched
    assert not free_stretch(scans((40, 8), (60, 0), (4, 100), (40, 0))).touched  # damaged


def test_repeated_and_incomplete_scans_are_no_samples():
    counts = np.repeat(scans((FEWEST_RECORDED - 1, 0)), 4, axis=0)
    with pytest.raises(BaselineRefusedError, match="29 whole new scans"):
        free_stretch(counts)
    counts = scans((60, 0), (60, None))
    counts[5, :, 1, 1] = ABSENT
    assert 5 not in free_stretch(counts).rows
