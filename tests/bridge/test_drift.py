"""Drift of a pad with noise is followed while nothing touches, and nothing that touches is followed."""

import numpy as np
import pytest
from edge_samples import BASELINE

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline, deformation
from firmware_bridge.zeroing.drift_tracker import DriftTracker

PERIOD_NS = 25_000_000
"""Enough scans for every block, no more than they take."""
NOISE_COUNTS = np.array([2.0, 2.0, 3.0])[:, None, None]
TAXELS = np.clip(np.random.default_rng(3).normal(1, 0.25, (3, 4, 4)), 0.5, 1.5)
AXES = np.array([1 / 8, 1 / 8, 1.0])[:, None, None]
PRESS = np.zeros((3, 4, 4))
PRESS[2, :2, :2] = 1
NONE_DEAD = np.zeros((4, 4), dtype=bool)


def played(seconds, offset, baseline=BASELINE):
    """Return a tracker after five seconds at rest, what it told meanwhile, and what was left of the readings.

    Readings are off by what `offset` gives for each time after that in [s]; what is left of it over the moved baseline,
    without noise, (n, 3, 4, 4), is what a user is told wrongly.
    """
    tracker, series, rng = DriftTracker(baseline), ScanSeries("4", USPA44), np.random.default_rng(0)
    told, left = [], []
    for number in range(-200, int(seconds * 40)):
        off = np.broadcast_to(offset(number / 40) if number >= 0 else 0, (3, 4, 4))
        noise = rng.normal(0, 1, (3, 4, 4)) * NOISE_COUNTS
        counts = np.rint(baseline.counts + off + noise).astype(np.int32) % 65536
        tracker.push(series.close(counts, (number + 1000) * PERIOD_NS), False, NONE_DEAD)
        told += filter(None, [tracker.take_event()])
        left.append(off - tracker.counts)
    return tracker, told, np.stack(left[200:])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_pad_that_warms_up_stays_at_zero(sign):
    tracker, told, left = played(400, lambda t: sign * 120 * (1 - np.exp(-t / 80)) * AXES * TAXELS)
    assert abs(left.mean(axis=(2, 3))).max() < 4, "while it warms"
    assert abs(left[-1]).max() < 3, "every taxel, in the end"
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 80
    assert told == [] and tracker.summary.common_counts[2] == pytest.approx(sign * 120, rel=0.1)


def test_a_touch_too_light_for_a_tap_is_not_eaten_and_told_of():
    """0.3 N on each of four taxels for two minutes, and gone for ten seconds."""
    _, told, left = played(130, lambda t: 350 * PRESS * (t < 120))
    assert left[119 * 40, 2, 1, 1] > 347 and abs(left[-1]).max() < 3
    assert len(told) == 2 and told[1] == "rest level is back where it was"


@pytest.mark.parametrize(("counts_per_s", "most_eaten"), [(0.5, 5.0), (5.0, 3.0), (50.0, 1.0)])
def test_a_press_that_rises_slowly_on_some_taxels_is_not_eaten(counts_per_s, most_eaten):
    tracker, _, _ = played(min(300 / counts_per_s, 120), lambda t: counts_per_s * t * PRESS)
    assert abs(tracker.counts).max() < most_eaten


def test_drift_goes_round_the_circle():
    baseline = Baseline.of("4", np.full((3, 4, 4), 65_500.0), 1000.0, 100, "file")
    tracker, _, left = played(60, lambda t: 2.0 * t, baseline)
    moved = baseline.moved(tracker.counts)
    assert abs(left[-1]).max() < 5 and moved.counts.max() <= 65_536
    assert abs(deformation(np.full((3, 4, 4), (65_500 + 119) % 65_536, dtype=np.int32), moved)).max() < 5
