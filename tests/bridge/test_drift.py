"""Drift is followed while nothing touches, and nothing that touches is followed."""

import numpy as np
import pytest
from edge_samples import BASELINE, REST

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline, deformation
from firmware_bridge.zeroing.drift_tracker import COMMON_COUNTS, GAP_NS, OWN_PER_S, STEP_COUNTS, DriftTracker

RATE_HZ = 40
"""Enough for every block, no more than they take."""
NOISE_COUNTS = (2.0, 2.0, 3.0)
TAXELS = np.clip(np.random.default_rng(3).normal(1, 0.25, (3, 4, 4)), 0.5, 1.5)
AXES = np.array([1 / 8, 1 / 8, 1.0])[:, None, None]
NONE_DEAD = np.zeros((4, 4), dtype=bool)


class Pad:
    """A pad whose readings a script moves, and its tracker."""

    def __init__(self, baseline=BASELINE, seed=0):
        self.tracker = DriftTracker(baseline)
        self.baseline = baseline
        self.dead = NONE_DEAD
        self.events = []
        self.notes = []
        self.time_ns = 1_000_000_000
        self._series = ScanSeries("4", USPA44)
        self._rng = np.random.default_rng(seed)

    def play(self, seconds, offset=0.0, contact=False, absent=None):
        """Readings off by `offset` (broadcast to 3, rows, cols), or by what it gives for each time in [s].

        Returns:
            (n, 3, rows, cols) over the moved baseline, without noise: what a user is told wrongly.
        """
        left = []
        for number in range(int(seconds * RATE_HZ)):
            off = offset(number / RATE_HZ) if callable(offset) else offset
            off = np.broadcast_to(off, (3, 4, 4))
            noise = self._rng.normal(0, 1, (3, 4, 4)) * np.array(NOISE_COUNTS)[:, None, None]
            counts = np.rint(np.nan_to_num(self.baseline.counts) + off + noise).astype(np.int32) % 65536
            if absent is not None:
                counts[:, absent] = ABSENT
            scan = self._series.close(counts, self.time_ns)
            self.time_ns += 1_000_000_000 // RATE_HZ
            self.tracker.push(scan, contact, self.dead)
            event = self.tracker.take_event()
            self.events += [event] if event else []
            self.notes += [self.tracker.note] if self.tracker.note not in self.notes[-1:] else []
            left.append(off - self.tracker.counts)
        return np.stack(left)

    @property
    def followed(self):
        return self.tracker.counts


def warm(counts, seconds):
    """Warming up by so many counts of z, by a time constant."""
    return lambda t: counts * (1 - np.exp(-t / seconds)) * AXES * TAXELS


def test_a_pad_that_warms_up_stays_at_zero():
    pad = Pad()
    pad.play(5)
    left = pad.play(600, warm(120, 120))
    assert abs(left.mean(axis=(2, 3))).max() < 4, "while it warms"
    assert abs(left[-1]).max() < 3, "every taxel, in the end"
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 80
    assert pad.events == [] and pad.tracker.summary.common_counts[2] == pytest.approx(120, rel=0.1)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_thousand_counts_a_minute_make_no_contact_and_no_step(sign):
    pad = Pad()
    pad.play(5)
    left = pad.play(60, lambda t: sign * 1000 / 60 * t * AXES * TAXELS)
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 500  # a third of what begins a tap
    assert abs(pad.play(3, sign * 1000.0 * AXES * TAXELS)[-1]).max() < 6
    assert pad.events == []


def test_faster_than_the_cap_is_not_followed():
    pad = Pad()
    pad.play(5)
    pad.play(10, lambda t: np.full((3, 4, 4), 60.0 * t))
    assert pad.followed.max() <= COMMON_COUNTS


def test_a_pad_turned_over_in_the_earths_field_is_followed():
    pad = Pad()
    pad.play(5)
    field = np.array([36.0, -25.0, 30.0])[:, None, None]
    left = pad.play(10, field)
    assert abs(left[-1]).max() < 2 and pad.events == []


def test_a_hold_of_an_hour_is_not_eaten_though_it_creeps_and_warms():
    press = np.zeros((3, 4, 4))
    press[2, 1:3, 1:3] = 900
    pad = Pad()
    pad.play(5)
    before = pad.followed.copy()
    pad.time_ns += 1
    for _ in range(60):  # a minute told by six seconds of scans would be a gap: every minute has its own
        pad.play(10, lambda t: press * (1 + 0.002 * t), contact=True)
    np.testing.assert_array_equal(pad.followed, before)


def test_a_touch_too_light_for_a_tap_is_not_eaten_and_told_of():
    """0.3 N on one taxel, a fifth of what begins a tap, for ten minutes."""
    press = np.zeros((3, 4, 4))
    press[2, 1, 2] = 350
    pad = Pad()
    pad.play(5)
    left = pad.play(600, press)
    assert left[-1, 2, 1, 2] > 347
    (event,) = pad.events
    assert event.startswith(("rest level 35", "rest level 34"))
    assert "above the one before on z (taxel 6) after a touch too light for a tap: free the pad and zero again" in event
    assert pad.tracker.note == event and pad.tracker.summary.step_counts == pytest.approx(350, abs=3)
    left = pad.play(10)
    assert (
        abs(left[-1]).max() < 3 and pad.tracker.note is None and pad.events[1:] == ["rest level is back where it was"]
    )


@pytest.mark.parametrize(("counts_per_s", "most_eaten"), [(0.5, 5.0), (5.0, 3.0), (50.0, 1.0)])
def test_a_press_that_rises_slowly_on_some_taxels_is_not_eaten(counts_per_s, most_eaten):
    pad = Pad()
    pad.play(5)
    press = np.zeros((3, 4, 4))
    press[2, :2, :2] = counts_per_s
    pad.play(min(300 / counts_per_s, 120), lambda t: press * t)
    assert abs(pad.followed).max() < most_eaten


def test_the_known_limit_a_press_as_even_as_drift_is_eaten():
    """Alike on all taxels and below the cap: no scan tells it from drift."""
    pad = Pad()
    pad.play(5)
    left = pad.play(20, lambda t: np.array([0, 0, 10.0 * t])[:, None, None])
    assert abs(left[-1]).max() < 15


def test_what_a_contact_begins_with_is_not_followed():
    """The blocks in which a contact rises count only once the next was free."""
    pad = Pad()
    pad.play(5)
    before = pad.followed.copy()
    rising = np.full((3, 4, 4), 18.0)
    pad.play(0.7, lambda t: rising * t)
    pad.play(1, np.full((3, 4, 4), 500.0), contact=True)
    pad.play(10)
    assert abs(pad.followed - before).max() < 2


@pytest.mark.parametrize("counts", [40, -40])
def test_a_step_after_release_is_flagged_and_not_swallowed(counts):
    pad = Pad()
    pad.play(5)
    pad.play(5, 800.0, contact=True)
    step = np.zeros((3, 4, 4))
    step[2, 3, 1] = counts
    left = pad.play(300, step)
    assert abs(left[-1] - step).max() < 3
    word = "above" if counts > 0 else "below"
    assert len(pad.events) == 1
    assert f" counts {word} the one before on z (taxel 13) after a contact: free the pad and zero" in pad.events[0]


def test_a_step_of_all_taxels_alike_is_flagged_as_such_and_drift_goes_on_to_be_followed():
    pad = Pad()
    pad.play(5)
    pad.play(5, 800.0, contact=True)
    left = pad.play(60, 40 * AXES)
    assert "all taxels alike, as drift or another attitude" in pad.events[0]
    assert abs(left[-1] - 40 * AXES).max() < 4
    left = pad.play(60, lambda t: (40 + t) * AXES)
    assert abs(left[-1] - 40 * AXES).max() < 6, "the step stays, the drift from there does not"
    assert len(pad.events) == 1


def test_a_step_that_recovers_slowly_goes_away_by_itself():
    pad = Pad()
    pad.play(5)
    pad.play(5, 800.0, contact=True)
    step = np.zeros((3, 4, 4))
    step[2, 0, 0] = 60
    left = pad.play(240, lambda t: step * np.exp(-t / 60))
    assert pad.events[-1] == "rest level is back where it was" and pad.tracker.note is None
    assert abs(left[-1]).max() < 4


def test_nothing_is_followed_right_after_a_release():
    pad = Pad()
    pad.play(5)
    pad.play(5, 800.0, contact=True)
    before = pad.followed.copy()
    pad.play(2.0, STEP_COUNTS - 5)
    np.testing.assert_array_equal(pad.followed, before)
    pad.play(5, STEP_COUNTS - 5)
    assert abs(pad.followed - before).max() > STEP_COUNTS - 8 and pad.events == []


@pytest.mark.parametrize("how", ["a gap", "told"])
def test_after_the_link_was_away_rest_is_compared(how):
    pad = Pad()
    pad.play(5)
    if how == "a gap":
        pad.time_ns += 2 * GAP_NS
    else:
        pad.tracker.forget()
    left = pad.play(10, 45.0)
    assert len(pad.events) == 1 and "after a gap" in pad.events[0]
    assert abs(left[-1] - 45).max() < 3


def test_a_stored_baseline_of_a_colder_pad_is_corrected():
    pad = Pad()
    left = pad.play(15, 40 * AXES * TAXELS)
    assert abs(left[-1].mean(axis=(1, 2))).max() < 3 and pad.events == []


def test_a_stored_baseline_that_is_far_off_is_told_of():
    pad = Pad()
    left = pad.play(15, 80.0)
    assert abs(left[-1] - 80).max() < 3
    assert "since it was zeroed" in pad.events[0]


def test_a_dead_taxel_moves_no_other_and_keeps_its_own():
    pad = Pad()
    pad.play(5)
    pad.dead = NONE_DEAD.copy()
    pad.dead[0, 0] = True
    far = np.zeros((3, 4, 4))
    far[:, 0, 0] = 9000
    left = pad.play(60, lambda t: far + 0.5 * t)
    live = ~pad.dead
    assert abs(left[-1][:, live]).max() < 3 and pad.events == []
    assert pad.tracker.summary.own_counts < 3
    assert abs(pad.play(10, 30.0, absent=pad.dead)[-1][:, live]).max() < 3


def test_a_taxel_that_was_not_zeroed_stays_so():
    counts = REST.astype(np.float32)
    counts[:, 2, 2] = np.nan
    pad = Pad(Baseline.of("4", counts, 1000.0, 100, "file"))
    pad.play(5)
    left = pad.play(30, 20.0)
    assert abs(left[-1]).max() < 3
    assert np.isnan(pad.baseline.moved(pad.followed).counts[:, 2, 2]).all()


def test_drift_goes_round_the_circle():
    baseline = Baseline.of("4", np.full((3, 4, 4), 65_500.0), 1000.0, 100, "file")
    pad = Pad(baseline)
    pad.play(5)
    assert abs(pad.play(60, lambda t: np.full((3, 4, 4), 2.0 * t))[-1]).max() < 5
    moved = baseline.moved(pad.followed)
    assert moved.id == baseline.id and not moved.counts.flags.writeable and moved.counts.max() <= 65_536
    scan = np.full((3, 4, 4), (65_500 + 119) % 65_536, dtype=np.int32)
    assert abs(deformation(scan, moved)).max() < 5


def test_noise_moves_nothing():
    pad = Pad()
    left = pad.play(600)
    assert abs(left.mean(axis=(2, 3))).max() < 2.0
    assert abs(left).max() < 5 and pad.events == [] and pad.notes == [None]


def test_of_its_own_a_taxel_is_followed_at_a_creep():
    own = np.zeros((3, 4, 4))
    own[2, 1, 1] = 7
    pad = Pad()
    pad.play(5)
    pad.play(30, own)
    assert 0.5 * 30 * OWN_PER_S < pad.followed[2, 1, 1] < 4
    pad.play(600, own)
    assert pad.followed[2, 1, 1] == pytest.approx(7, abs=2)


def test_a_rest_level_is_not_compared_before_the_pad_is_still():
    pad = Pad()
    pad.play(5)
    pad.play(5, 800.0, contact=True)
    sway = np.zeros((3, 4, 4))
    sway[2, 1, 1] = 40
    pad.play(10, lambda t: sway * (1 + t))
    assert pad.events == []
    pad.play(5, sway * 11)
    assert len(pad.events) == 1 and pad.tracker.summary.step_counts == pytest.approx(440, abs=4)
