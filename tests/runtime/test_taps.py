"""Taps of one sensor: contact, the window of their peaks, their numbers, and when they are forgotten."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import EdgeError, UsageError
from edge.perception.contact_options import RuntimeOptions
from edge.perception.tap_tracker import TapTracker

S = 1_000_000_000


def frame(z_counts: float, mark: float = 0.0) -> np.ndarray:
    """Zeroed counts with summed z `z_counts`; x carries a mark to tell frames apart."""
    deformation = np.zeros((3, 4, 4), dtype=np.float32)
    deformation[0] = mark
    deformation[2] = z_counts / 16
    return deformation


def push(tracker, *scan, **how):
    """Return the tracker after a scan."""
    tracker.push(*scan, **how)
    return tracker


def play(tracker, z_counts, start_ns=0, step_ns=S // 100):
    """Return contact, taps used and the number of the tap after each scan."""
    states = (push(tracker, frame(z), start_ns + i * step_ns) for i, z in enumerate(z_counts))
    return [(state.contact, state.taps_used, state.tap) for state in states]


@pytest.mark.parametrize(
    ("taps", "z_counts", "contact", "used", "numbers"),
    [
        # Contact has hysteresis.
        (1, [1499, 1500, 750, 749, 1499, 2000, 800, 1499, 0], "011001110", "011001110", [-1, 0, 0, 0, 0, 1, 1, 1, 1]),
        # Taps grow to K, and are numbered from the first on.
        (2, [0, 2000, 2000, 0, 2000, 2000, 0, 2000, 0], "011011010", "011022020", [-1, 0, 0, 0, 1, 1, 1, 2, 2]),
        # A touch of one scan is shown, but not remembered.
        (3, [3000, 0, 2000], "101", "101", [0, 0, 1]),
        (3, [3000, 3000, 0, 2000, 0, 2000], "110101", "110202", [0, 0, 0, 1, 1, 2]),
    ],
)
def test_contact_and_taps_after_each_scan(taps, z_counts, contact, used, numbers):
    told = play(TapTracker(taps), z_counts)
    assert "".join(str(int(one)) for one, _, _ in told) == contact
    assert "".join(str(count) for _, count, _ in told) == used and [number for _, _, number in told] == numbers


def test_the_window_is_the_current_frame_then_peaks():
    tracker = TapTracker(3)
    for mark, peak in enumerate([3000, 4000, 5000], start=1):
        for z, m in ((2000, 0), (peak, mark), (peak, 7), (2500, 0)):  # an equal frame later is no new peak
            tracker.push(frame(z, m), mark)
        released = push(tracker, frame(0), mark)
        assert not released.window[0].any() and released.taps_used == 0
    mine = frame(2222, 9)
    state = push(tracker, mine, 10)
    mine[...] = 0  # it was copied
    assert state.contact and state.taps_used == 3
    assert state.window.shape == (3, 3, 4, 4) and state.window.dtype == np.float32
    assert state.window[:, 0, 0, 0].tolist() == [9, 3, 2]
    assert state.window[:, 2].sum(axis=(1, 2)).tolist() == [2222, 5000, 4000]
    with pytest.raises(ValueError, match="read-only"):
        state.window[0] = 1


def test_a_peak_starts_anew_and_absent_taps_are_zeros():
    tracker = TapTracker(4)
    play(tracker, [9000, 9000, 0, 2000, 2100, 0])
    state = push(tracker, frame(100, 5), S)
    assert state.window[:, 2].sum(axis=(1, 2)) == pytest.approx([0, 2100, 9000, 0])
    assert not state.window[0].any() and not state.window[3].any()
    assert [(peak.tap, peak.time_ns) for peak in state.peaks] == [(1, 4 * S // 100), (0, 0)]


@pytest.mark.parametrize(
    ("first", "then_ns", "used"),
    [
        ([2000, 2000, 0], 4.92 * S, 2),
        ([2000, 2000, 0], 5.01 * S, 2),  # measured from the last scan in contact, at 0.01 s
        ([2000, 2000, 0], 5.02 * S, 1),
        ([2000, 2000, 0, *[2000] * 400, 0], 8.9 * S, 3),
        ([2000, 2000, *[900] * 900], 100 * S, 1),  # a gap within a tap does not end it
    ],
)
def test_earlier_taps_are_forgotten_after_an_idle_time(first, then_ns, used):
    tracker = TapTracker(4, RuntimeOptions(idle_reset_s=5.0))
    play(tracker, first)
    assert push(tracker, frame(2000), int(then_ns)).taps_used == used
    play(tracker, [2000, 0], 200 * S)
    assert not push(tracker, frame(0), 206 * S).window.any(), "in the window, too"


def test_time_running_backwards_counts_as_no_time():
    for then_s, used in ((5, 2), (7, 1)):
        tracker = TapTracker(2, RuntimeOptions(idle_reset_s=5.0))
        play(tracker, [2000, 2000, 0], start_ns=100 * S)
        tracker.push(frame(0), 1 * S)
        assert push(tracker, frame(2000), then_s * S).taps_used == used


def test_after_a_reset_a_tap_in_progress_is_the_first():
    tracker = TapTracker(4)
    play(tracker, [2000, 2000, 0, 9000, 9000])
    tracker.reset()
    state = push(tracker, frame(1000), S)  # between the thresholds: the tap goes on
    assert state.contact and (state.taps_used, state.tap) == (1, 2)
    tracker.push(frame(1100), S)
    state = push(tracker, frame(0), S)
    assert state.window[1, 2].sum() == pytest.approx(1100)  # not the peak from before the reset
    assert not state.window[2:].any() and state.tap == 2
    tracker.reset()
    assert [number for *_, number in play(tracker, [0, 2000])] == [2, 3], "one that is over keeps its number"


def test_reset_just_before_the_release_leaves_no_tap():
    tracker = TapTracker(2)
    play(tracker, [9000, 9000])
    tracker.reset()
    assert not push(tracker, frame(0), S).window.any()


def test_a_scan_in_doubt_is_no_contact_and_ends_one():
    tracker = TapTracker(2)
    assert not push(tracker, frame(9000), 0, doubted=True).contact
    assert [contact for contact, *_ in play(tracker, [2000, 2000])] == [True, True]
    state = push(tracker, frame(9000), S, doubted=True)
    assert not state.contact and state.window[1, 2].sum() == 2000


def test_taps_that_are_dropped_leave_the_others_in_their_order():
    tracker = TapTracker(4)
    play(tracker, [2000, 2000, 0, 3000, 3000, 0, 4000, 4000, 0])
    tracker.forget({2})
    state = push(tracker, frame(2500), S)
    assert state.taps_used == 3 and state.window[:, 2].sum(axis=(1, 2)).tolist() == [2500, 4000, 2000, 0]
    assert [peak.tap for peak in state.peaks] == [2, 0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"contact_on_counts": 100, "contact_off_counts": 200},
        {"contact_off_counts": 0},
        {"contact_on_counts": float("inf")},
        {"contact_on_counts": float("nan")},
        {"idle_reset_s": 0},
        {"idle_reset_s": float("nan")},
    ],
)
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(UsageError, match="expected"):
        RuntimeOptions(**wrong)
    with pytest.raises(UsageError, match="expected"):
        TapTracker(0)
    assert issubclass(UsageError, EdgeError) and issubclass(UsageError, ValueError)


events = st.one_of(
    st.tuples(st.floats(-5000, 20000, width=32, allow_subnormal=False), st.integers(-(2**62), 2**62)),
    st.tuples(st.sampled_from([0.0, 749.0, 750.0, 1499.0, 1500.0, 3000.0]), st.integers(0, 20 * S)),
    st.just("reset"),
)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 4), st.lists(events, max_size=60))
def test_any_sequence_keeps_the_invariants(taps, sequence):
    tracker = TapTracker(taps)
    contact = False
    for event in sequence:
        if event == "reset":
            tracker.reset()
            continue
        z, time_ns = event
        deformation = frame(z)
        state = push(tracker, deformation, time_ns)
        z = float(deformation[2].sum())
        contact = z >= (750 if contact else 1500)
        assert state.contact == contact
        assert (state.taps_used > 0) == contact and state.taps_used <= taps
        filled = [bool(slot.any()) for slot in state.window]
        assert filled[0] == contact
        assert filled[1:] == sorted(filled[1:], reverse=True), "earlier taps stand together, without a hole"
        if contact:
            assert state.taps_used == sum(filled)
            assert (state.window[0] == deformation).all()
        earlier = state.window[1:, 2].sum(axis=(1, 2))
        assert (earlier[earlier != 0] >= 750).all()
