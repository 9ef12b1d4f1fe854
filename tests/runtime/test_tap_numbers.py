"""Taps are numbered from 0, and no two alike."""

import numpy as np

from edge.perception.tap_tracker import TapTracker


def push(tracker: TapTracker, z_counts: float, number: int) -> int:
    deformation = np.zeros((3, 4, 4), dtype=np.float32)
    deformation[2] = z_counts / 16
    return tracker.push(deformation, number * 10_000_000).tap


def test_taps_are_numbered_from_the_first_on():
    tracker = TapTracker(2)
    numbers = [push(tracker, z_counts, n) for n, z_counts in enumerate([0, 2000, 2000, 0, 0, 2000, 0, 2000, 2000])]
    assert numbers == [-1, 0, 0, 0, 0, 1, 1, 2, 2]


def test_a_tap_in_progress_has_a_new_number_after_a_reset_and_one_that_is_over_keeps_its_own():
    tracker = TapTracker(2)
    assert [push(tracker, 2000, 0), push(tracker, 0, 1), push(tracker, 2000, 2)] == [0, 0, 1]
    tracker.reset()
    assert [push(tracker, 2000, 3), push(tracker, 0, 4)] == [2, 2]
    tracker.reset()
    assert [push(tracker, 0, 5), push(tracker, 2000, 6)] == [2, 3]
