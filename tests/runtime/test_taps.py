"""Taps of one sensor: contact, their numbers, the peaks of the earlier ones, and when they are forgotten."""

import numpy as np
import pytest

from edge.api import UsageError
from edge.perception.run_options import RuntimeOptions
from edge.perception.taps import TapTracker

S = 1_000_000_000
PERIOD_NS = S // 100


def make_tracker(taps, idle_reset_s=5.0):
    return TapTracker(taps, RuntimeOptions(idle_reset_s=idle_reset_s))


def push(tracker, z_counts, time_ns=0, mark=0.0):
    """Push a frame of that summed z, told from others by a mark."""
    tracker.push(np.full((3, 4, 4), mark, dtype=np.float32), z_counts, time_ns, time_ns)
    return tracker


def play(tracker, z_counts, start_ns=0):
    """Return contact, number of taps and of the newest tap after each scan, in three columns."""
    states = (push(tracker, z, start_ns + at * PERIOD_NS) for at, z in enumerate(z_counts))
    told = [(int(one.contact), one.contact * (1 + len(one.peaks)), one.tap) for one in states]
    return ["".join(map(str, column)) for column in zip(*told, strict=True)]


@pytest.mark.parametrize(
    ("taps", "z_counts", "contact", "used", "numbers"),
    [
        # Contact has hysteresis.
        (1, [1500, 750, 749, 1499, 2000, 800, 1499, 0], "11001110", "11001110", "00001111"),
        # Taps grow to K, and are numbered from the first on.
        (2, [2000, 2000, 0, 2000, 2000, 0, 2000, 0], "11011010", "11022020", "00011122"),
        # A touch of one scan is shown, but not remembered.
        (3, [3000, 3000, 0, 2000, 0, 2000], "110101", "110202", "000112"),
    ],
)
def test_contact_and_taps_after_each_scan(taps, z_counts, contact, used, numbers):
    tracker = make_tracker(taps)
    assert push(tracker, 1499).tap == -1
    assert play(tracker, z_counts) == [contact, used, numbers]


def test_earlier_taps_are_known_by_their_peaks():
    tracker = make_tracker(3)
    for mark, peak in enumerate([3000, 9000, 5000], start=1):
        for at, (z, here) in enumerate(((2000, 0), (peak, mark), (peak, 7), (2500, 0), (0, 0))):
            push(tracker, z, 10 * mark + at, here)  # an equal frame later is no new peak
    told = [(peak.tap, peak.time_ns, peak.readings[0, 0, 0]) for peak in tracker.peaks]
    assert told == [(2, 31, 3), (1, 21, 2)]
    mine = np.full((3, 4, 4), 9, dtype=np.float32)
    tracker.push(mine, 2222, 50, 50)
    mine[...] = 0
    assert (tracker.newest == 9).all(), "it was copied"
    tracker.forget({1})
    assert [peak.tap for peak in tracker.peaks] == [1]


@pytest.mark.parametrize(
    ("first", "then_ns", "used"),
    [
        ([2000, 2000, 0], 5.01 * S, "2"),  # measured from the last scan in contact, at 0.01 s
        ([2000, 2000, 0], 5.02 * S, "1"),
        ([2000, 2000, 0, *[2000] * 400, 0], 8.9 * S, "3"),
        ([2000, 2000, *[900] * 900], 100 * S, "1"),  # a gap within a tap does not end it
    ],
)
def test_earlier_taps_are_forgotten_after_an_idle_time(first, then_ns, used):
    tracker = make_tracker(4)
    play(tracker, first)
    assert play(tracker, [2000], int(then_ns))[1] == used
    play(tracker, [2000, 0], 200 * S)
    assert push(tracker, 0, 206 * S).peaks == ()


def test_time_running_backwards_counts_as_no_time():
    for then_s, used in ((5, "2"), (7, "1")):
        tracker = make_tracker(2)
        play(tracker, [2000, 2000, 0], 100 * S)
        push(tracker, 0, 1 * S)
        assert play(tracker, [2000], then_s * S)[1] == used


def test_after_a_reset_a_tap_in_progress_is_the_first():
    tracker = make_tracker(4)
    play(tracker, [2000, 2000, 0, 9000, 9000])
    tracker.reset()
    for z, mark in ((1000, 1), (1100, 2)):  # between the thresholds: the tap goes on
        assert (push(tracker, z, S, mark).contact, tracker.tap, tracker.peaks) == (True, 2, ())
    (peak,) = push(tracker, 0, S).peaks
    assert (peak.tap, peak.readings[0, 0, 0]) == (2, 2), "not the peak from before the reset"
    tracker.reset()
    assert play(tracker, [0, 2000])[2] == "23", "one that is over keeps its number"
    tracker.reset()
    assert push(tracker, 0, S).peaks == (), "one that ends at once is none"


def test_settings_that_cannot_be_are_refused():
    counts = ({"contact_on_counts": 100}, {"contact_on_counts": float("inf")}, {"contact_off_counts": 0})
    for wrong in (*counts, {"idle_reset_s": 0}, {"idle_reset_s": float("nan")}):
        with pytest.raises(UsageError, match="expected"):
            RuntimeOptions(**wrong)
