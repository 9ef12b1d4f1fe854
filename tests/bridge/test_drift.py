"""Drift is followed while nothing touches, and nothing that touches is followed."""

import numpy as np
import pytest
from edge_samples import BASELINE

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline, deformation
from firmware_bridge.zeroing.drift_tracker import DriftTracker

RATE_HZ = 40
"""Enough for every block, no more than they take."""
NOISE_COUNTS = (2.0, 2.0, 3.0)
TAXELS = np.clip(np.random.default_rng(3).normal(1, 0.25, (3, 4, 4)), 0.5, 1.5)
AXES = np.array([1 / 8, 1 / 8, 1.0])[:, None, None]
NONE_DEAD = np.zeros((4, 4), dtype=bool)


class Pad:
    """A pad whose readings a script moves, and its tracker."""

    def __init__(self, baseline=BASELINE):
        self.tracker = DriftTracker(baseline)
        self.baseline = baseline
        self.events = []
        self.notes = []
        self.time_ns = 1_000_000_000
        self._series = ScanSeries("4", USPA44)
        self._rng = np.random.default_rng(0)

    def play(self, seconds, offset=0.0, contact=False):
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
            scan = self._series.close(counts, self.time_ns)
            self.time_ns += 1_000_000_000 // RATE_HZ
            self.tracker.push(scan, contact, NONE_DEAD)
            event = self.tracker.take_event()
            self.events += [event] if event else []
            self.notes += [self.tracker.note] if self.tracker.note not in self.notes[-1:] else []
            left.append(off - self.tracker.counts)
        return np.stack(left)


def settled(baseline=BASELINE):
    pad = Pad(baseline)
    pad.play(5)
    return pad


def press_on(taxels, counts):
    press = np.zeros((3, 16))
    press[2, taxels] = counts
    return press.reshape(3, 4, 4)


def warm(counts, seconds):
    """Warming up by so many counts of z, by a time constant."""
    return lambda t: counts * (1 - np.exp(-t / seconds)) * AXES * TAXELS


def test_a_pad_that_warms_up_stays_at_zero():
    pad = settled()
    left = pad.play(400, warm(120, 80))
    assert abs(left.mean(axis=(2, 3))).max() < 4, "while it warms"
    assert abs(left[-1]).max() < 3, "every taxel, in the end"
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 80
    assert pad.events == [] and pad.tracker.summary.common_counts[2] == pytest.approx(120, rel=0.1)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_thousand_counts_a_minute_make_no_contact_and_no_step(sign):
    pad = settled()
    left = pad.play(60, lambda t: sign * 1000 / 60 * t * AXES * TAXELS)
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 500  # a third of what begins a tap
    assert abs(pad.play(3, sign * 1000.0 * AXES * TAXELS)[-1]).max() < 6
    assert pad.events == []


def test_a_long_hold_is_not_eaten_though_it_creeps_and_warms():
    press = press_on([5, 6, 9, 10], 900)
    pad = settled()
    before = pad.tracker.counts.copy()
    for _ in range(12):
        pad.play(10, lambda t: press * (1 + 0.002 * t), contact=True)
    np.testing.assert_array_equal(pad.tracker.counts, before)


def test_a_touch_too_light_for_a_tap_is_not_eaten_and_told_of():
    """0.3 N on one taxel, a fifth of what begins a tap, for two minutes."""
    press = press_on(6, 350)
    pad = settled()
    left = pad.play(120, press)
    assert left[-1, 2, 1, 2] > 347
    (event,) = pad.events
    assert pad.tracker.note == event and pad.tracker.summary.step_counts == pytest.approx(350, abs=3)
    left = pad.play(10)
    assert abs(left[-1]).max() < 3 and pad.events[1:] == ["rest level is back where it was"]


@pytest.mark.parametrize(("counts_per_s", "most_eaten"), [(0.5, 5.0), (5.0, 3.0), (50.0, 1.0)])
def test_a_press_that_rises_slowly_on_some_taxels_is_not_eaten(counts_per_s, most_eaten):
    pad = settled()
    press = press_on([0, 1, 4, 5], counts_per_s)
    pad.play(min(300 / counts_per_s, 120), lambda t: press * t)
    assert abs(pad.tracker.counts).max() < most_eaten


def test_a_step_that_recovers_slowly_goes_away_by_itself():
    pad = settled()
    pad.play(5, 800.0, contact=True)
    step = press_on(0, 60)
    left = pad.play(240, lambda t: step * np.exp(-t / 60))
    assert pad.events[-1] == "rest level is back where it was" and pad.tracker.note is None
    assert abs(left[-1]).max() < 4


def test_drift_goes_round_the_circle():
    baseline = Baseline.of("4", np.full((3, 4, 4), 65_500.0), 1000.0, 100, "file")
    pad = settled(baseline)
    assert abs(pad.play(60, lambda t: np.full((3, 4, 4), 2.0 * t))[-1]).max() < 5
    moved = baseline.moved(pad.tracker.counts)
    assert moved.id == baseline.id and not moved.counts.flags.writeable and moved.counts.max() <= 65_536
    scan = np.full((3, 4, 4), (65_500 + 119) % 65_536, dtype=np.int32)
    assert abs(deformation(scan, moved)).max() < 5


def test_noise_moves_nothing():
    pad = Pad()
    left = pad.play(200)
    assert abs(left.mean(axis=(2, 3))).max() < 2.0
    assert abs(left).max() < 5 and pad.events == [] and pad.notes == [None]
