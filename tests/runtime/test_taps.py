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


def play(tracker, z_counts, start_ns=0, step_ns=S // 100):
    return [tracker.push(frame(z), start_ns + i * step_ns) for i, z in enumerate(z_counts)]


def test_contact_has_hysteresis():
    tracker = TapTracker(1, RuntimeOptions(1500, 750))
    got = [tracker.push(frame(z), i).contact for i, z in enumerate([1499, 1500, 750, 749, 1499, 2000, 800, 1499, 0])]
    assert got == [False, True, True, False, False, True, True, True, False]


def test_window_shows_current_frame_then_peaks_newest_first():
    tracker = TapTracker(3)
    for mark, peak in enumerate([3000, 4000, 5000], start=1):
        for z, m in ((2000, 0), (peak, mark), (2500, 0), (0, 0)):
            state = tracker.push(frame(z, m), mark)
    state = tracker.push(frame(2222, 9), 10)
    assert state.contact and state.taps_used == 3
    assert state.window.shape == (3, 3, 4, 4) and state.window.dtype == np.float32
    assert state.window[:, 0, 0, 0].tolist() == [9, 3, 2]
    assert state.window[:, 2].sum(axis=(1, 2)).tolist() == [2222, 5000, 4000]


def test_the_oldest_tap_falls_out():
    tracker = TapTracker(4)
    for peak in (2000, 3000, 4000, 5000, 6000):
        state = play(tracker, [peak, peak, 0])[-1]
    assert state.window[:, 2].sum(axis=(1, 2)).tolist() == [0, 6000, 5000, 4000]


def test_taps_used_grows_to_k_and_is_zero_without_contact():
    tracker = TapTracker(2)
    used = [state.taps_used for state in play(tracker, [0, 2000, 2000, 0, 2000, 2000, 0, 2000, 2000, 0])]
    assert used == [0, 1, 1, 0, 2, 2, 0, 2, 2, 0]


def test_absent_taps_are_zeros_and_slot_zero_is_empty_without_contact():
    tracker = TapTracker(4)
    play(tracker, [2000, 3000, 0])
    state = tracker.push(frame(100, 5), S)
    assert not state.window[0].any()
    assert state.window[1, 2].sum() == 3000
    assert not state.window[2:].any()


def test_a_later_equal_frame_does_not_replace_the_peak():
    tracker = TapTracker(2)
    for z, mark in ((3000, 1), (3000, 2), (2999, 3), (0, 0)):
        state = tracker.push(frame(z, mark), 0)
    assert state.window[1, 0, 0, 0] == 1


def test_peak_starts_anew_with_each_tap():
    tracker = TapTracker(2)
    state = play(tracker, [9000, 9000, 0, 2000, 2100, 0])[-1]
    assert state.window[1, 2].sum() == pytest.approx(2100)


def test_a_touch_of_one_scan_is_shown_but_not_remembered():
    tracker = TapTracker(3)
    states = play(tracker, [3000, 0, 2000])
    assert [state.taps_used for state in states] == [1, 0, 1]
    assert [state.taps_used for state in play(TapTracker(3), [3000, 3000, 0, 2000, 0, 2000])] == [1, 1, 0, 2, 0, 2]


def test_idle_longer_than_the_timeout_forgets_earlier_taps():
    for idle_s, used in ((4.9, 2), (5.0, 2), (5.1, 1)):
        tracker = TapTracker(4, RuntimeOptions(idle_reset_s=5.0))
        tracker.push(frame(2000), 0)
        tracker.push(frame(2000), 0)
        tracker.push(frame(0), 1)
        assert tracker.push(frame(2000), int(idle_s * S)).taps_used == used


def test_idle_is_measured_from_the_last_scan_in_contact():
    tracker = TapTracker(4, RuntimeOptions(idle_reset_s=5.0))
    play(tracker, [2000, 2000, 0])
    play(tracker, [2000] * 7 + [0], start_ns=4 * S, step_ns=S)  # ends at 10 s
    assert tracker.push(frame(2000), 14 * S).taps_used == 3


def test_idle_forgets_in_the_window_too():
    tracker = TapTracker(2, RuntimeOptions(idle_reset_s=5.0))
    play(tracker, [2000, 2000, 0])
    assert not tracker.push(frame(0), 6 * S).window.any()


def test_time_running_backwards_counts_as_no_time():
    tracker = TapTracker(2, RuntimeOptions(idle_reset_s=5.0))
    play(tracker, [2000, 2000, 0], start_ns=100 * S)
    tracker.push(frame(0), 1 * S)
    assert tracker.push(frame(2000), 5 * S).taps_used == 2
    tracker = TapTracker(2, RuntimeOptions(idle_reset_s=5.0))
    play(tracker, [2000, 2000, 0], start_ns=100 * S)
    tracker.push(frame(0), 1 * S)
    assert tracker.push(frame(2000), 7 * S).taps_used == 1


def test_a_gap_within_a_tap_does_not_end_it():
    tracker = TapTracker(2)
    play(tracker, [2000, 2000, 0])
    tracker.push(frame(2000), S)
    state = tracker.push(frame(2000), 100 * S)
    assert state.contact and state.taps_used == 2


def test_reset_forgets_all_and_a_tap_in_progress_becomes_the_first():
    tracker = TapTracker(4)
    play(tracker, [2000, 2000, 0, 9000, 9000])
    tracker.reset()
    state = tracker.push(frame(1000), S)  # between the thresholds: the tap goes on
    assert state.contact and state.taps_used == 1
    tracker.push(frame(1100), S)
    state = tracker.push(frame(0), S)
    assert state.window[1, 2].sum() == pytest.approx(1100)  # not the peak from before the reset
    assert not state.window[2:].any()


def test_reset_just_before_the_release_leaves_no_tap():
    tracker = TapTracker(2)
    play(tracker, [9000, 9000])
    tracker.reset()
    assert not tracker.push(frame(0), S).window.any()


def test_nothing_is_allocated_and_the_window_is_read_only():
    tracker = TapTracker(2)
    first, second = play(tracker, [2000, 2000])
    assert first.window is second.window
    with pytest.raises(ValueError, match="read-only"):
        first.window[0] = 1


def test_a_frame_is_copied():
    tracker = TapTracker(2)
    mine = frame(2000, 7)
    tracker.push(mine, 0)
    state = tracker.push(mine, 1)
    mine[...] = 0
    assert state.window[0, 0, 0, 0] == 7
    assert tracker.push(frame(0), 2).window[1, 0, 0, 0] == 7


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


@settings(max_examples=200, deadline=None)
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
        state = tracker.push(deformation, time_ns)
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
