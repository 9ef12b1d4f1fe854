"""Drift, warming and old baselines, which look like a touch, are no contact; what begins as a touch is one."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS
from edge_samples import BASELINE, PERIOD_NS, FakeModel
from runtime_samples import make_runtime
from trust_samples import make_trusted_contract

from edge.perception.contact_options import RuntimeOptions
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline

NOISE_COUNTS = 2.5
TAKEN = replace(BASELINE, origin="start-up")
ROW, COL = np.mgrid[-1.5:2:1, -1.5:2:1] / 1.5
GRIP = np.zeros((3, 4, 4))
"""A flat grip: as even as real ones, whose taxels differ from their median by .55 of it and more."""
GRIP[2] = 700 + 300 * ROW + 60 * COL
GRIP[0] = -180 + 60 * ROW
LOCAL = np.zeros((3, 4, 4))
LOCAL[2, 1, 1:3] = 1500
PADS = np.clip(np.random.default_rng(3).normal(1, 0.25, (4, 4)), 0.5, 1.5)
WARM = np.zeros((3, 4, 4))
WARM[2] = 120 * PADS


def drift_field(seed, hours):
    """Change of a rest level with the statistics of the public recordings: common, smooth across the pad, and own."""
    rng = np.random.default_rng(seed)
    field = rng.normal(0, 60, 3)[:, None, None] + rng.normal(0, 10, (3, 4, 4)) + rng.normal(0, 12, (3, 1, 1)) * ROW
    common, smooth, own = {1: (60, 20, 60), 4: (430, 120, 200), 22: (1000, 200, 220)}[hours]
    field[2] = rng.choice([-1, 1]) * common + rng.normal(0, smooth) * ROW + rng.normal(0, smooth) * COL
    field[2] += rng.normal(0, own, (4, 4))
    return field


class Pad:
    """A sensor that reads what it is told to, and its runtime; keeps the results."""

    def __init__(self, baseline=BASELINE, model=None, **options):
        self.runtime = make_runtime(
            model or FakeModel(make_trusted_contract()), baselines={"4": baseline}, options=RuntimeOptions(**options)
        )
        self.results = []
        self._rng = np.random.default_rng(0)
        self._series = ScanSeries("4", USPA44)
        self._time_ns = PERIOD_NS

    def read(self, seconds, felt=0.0):
        """Return the results of readings over the rest level, or of what it gives for each time in [s]."""
        begun = len(self.results)
        for number in range(max(1, round(seconds * 1e9 / PERIOD_NS))):
            now = felt(number * PERIOD_NS / 1e9) if callable(felt) else felt
            counts = BASELINE.counts + now + self._rng.normal(0, NOISE_COUNTS, (3, 4, 4))
            scan = self._series.close(np.rint(counts).astype(np.int32), self._time_ns)
            self.results.append(self.runtime.push(scan))
            self._time_ns += PERIOD_NS
        return self.results[begun:]

    def away(self, seconds):
        self._time_ns += round(seconds * 1e9)


def states(results):
    return {result.state for result in results}


def doubted(results):
    assert states(results) == {"baseline_in_doubt"}, states(results)
    assert {(one.contact, one.trusted, one.untrusted_reason) for one in results} == {(None, False, "baseline")}
    assert all(one.area_mm2 is one.next_tap is one.wrench is one.centroid_mm is None for one in results)
    assert all("baseline in doubt" in str(one.note) and "zero again" in str(one.note) for one in results)
    return str(results[0].note)


@pytest.mark.parametrize("hours", [4, 22])
@pytest.mark.parametrize("seed", range(12))
def test_a_free_pad_with_an_old_baseline_is_in_doubt_from_the_first_scan(hours, seed):
    doubted(Pad().read(0.5, drift_field(seed, hours)))


@pytest.mark.parametrize("seed", range(12))
def test_of_an_hours_drift_no_scan_is_a_contact(seed):
    assert states(Pad().read(0.5, drift_field(seed, 1))) <= {"idle", "baseline_in_doubt"}


@pytest.mark.parametrize("counts", [-900, -60, 60, 100, 900])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_common_change_of_any_size_sign_and_axis_is_in_doubt(counts, axis):
    felt = np.zeros((3, 4, 4))
    felt[axis] = counts * (1 + 0.2 * ROW)
    note = doubted(Pad().read(0.5, felt))
    assert f"{'xyz'[axis]} {counts:+d}"[:3] in note and "(baseline 60 s old)" in note


def test_a_grip_from_a_rest_that_was_seen_is_a_contact_and_ends_as_one():
    pad = Pad()
    assert states(pad.read(0.5)) == {"idle"}
    held = pad.read(2, lambda t: GRIP * min(t / 0.1, 1))[5:]
    assert states(held) == {"contact"}
    assert states(pad.read(2, lambda t: GRIP * max(0.04 - t / 10, 0))) == {"idle"}
    assert all(result.event is None for result in pad.results)


def test_a_recording_that_begins_gripped_is_one_with_its_own_baseline_alone():
    assert states(Pad(TAKEN).read(0.5, GRIP)) == {"contact"}
    pad = Pad()
    doubtful = pad.read(0.5, GRIP)
    doubted(doubtful)
    assert doubtful[-1].pattern is not None and doubtful[-1].taps_used == 1 and doubtful[-1].traction is None
    assert states(pad.read(0.5)) == {"idle"} and states(pad.read(0.5, GRIP)) == {"contact"}
    events = [event.kind for result in pad.results for event in result.events]
    assert events == ["baseline_doubted", "baseline_cleared"]


def test_a_local_press_needs_no_rest_before_it():
    assert states(Pad().read(0.5, LOCAL)) == {"contact"}
    assert states(Pad().read(0.5, LOCAL + drift_field(0, 4))) == {"baseline_in_doubt"}


def test_what_a_release_leaves_is_no_contact():
    """A pad that warmed by 3 K under a grip, and cools by a time constant of ten seconds."""
    pad = Pad()
    pad.read(0.5)
    pad.read(3, GRIP)
    left = pad.read(30, lambda t: WARM * np.exp(-t / 10))
    assert states(left[:12]) <= {"contact", "baseline_in_doubt"} and states(left[12:]) == {"baseline_in_doubt", "idle"}
    assert "after a release" in str(left[12].note) and states(left[-500:]) == {"idle"}
    assert states(pad.read(1, GRIP)) == {"contact"}


def test_a_grip_that_is_loosened_and_tightened_is_a_contact_again():
    pad = Pad()
    pad.read(0.5)
    pad.read(0.5, GRIP)
    assert states(pad.read(0.5, GRIP * 0.6)) == {"contact"}
    assert states(pad.read(0.5, GRIP * 0.15)[15:]) == {"baseline_in_doubt"}
    assert states(pad.read(0.5, GRIP)) == {"contact"}


@pytest.mark.parametrize("follow_drift", [True, False])
@pytest.mark.parametrize("counts_per_s", [5, 10, 20, -20])
def test_drift_that_creeps_over_the_threshold_is_no_contact(counts_per_s, follow_drift):
    pad = Pad(follow_drift=follow_drift)
    pad.read(1)
    crept = pad.read(
        min(200 / abs(counts_per_s), 40), lambda t: counts_per_s * t * np.array([0, 0, 1])[:, None, None] * PADS
    )
    assert states(crept) <= {"idle", "baseline_in_doubt"}
    if counts_per_s > 0 and not follow_drift:
        assert crept[-1].state == "baseline_in_doubt" and "rose slowly" in str(crept[-1].note)
        assert states(pad.read(0.5, GRIP * 2)) == {"contact"}, "drift does not explain it any more"


def test_a_press_slower_than_drift_is_a_contact_where_it_is_local():
    pad = Pad(follow_drift=False)
    pad.read(1)
    assert states(pad.read(20, lambda t: LOCAL * t / 20)) == {"idle", "contact"}


def test_all_taxels_alike_at_once_are_a_field_and_no_touch():
    pad = Pad()
    pad.read(0.5)
    felt = np.zeros((3, 4, 4))
    felt[2] = 300 * (1 + 0.2 * COL)
    note = doubted(pad.read(0.5, felt))
    assert "alike" in note and states(pad.read(0.5)) == {"idle"}


def test_a_baseline_that_was_taken_under_load_shows_at_the_release():
    pad = Pad(TAKEN)
    pad.read(0.5)
    note = doubted(pad.read(0.5, -GRIP))
    assert "far below the baseline on all taxels" in note and "while something pressed" in note
    doubted(pad.read(0.5, GRIP)), "the pad was not seen at rest since"
    assert states(pad.read(0.5)) == {"idle"}


def test_after_an_outage_rest_levels_are_compared():
    other = np.random.default_rng(9).integers(150, 700, (3, 4, 4))
    for felt, state in ((0.0, "idle"), (GRIP, "contact"), (other, "baseline_in_doubt"), (-other, "baseline_in_doubt")):
        for forget in (lambda pad: pad.runtime.lose_touch(), lambda pad: pad.away(60)):
            pad = Pad()
            pad.read(0.5)
            pad.read(0.2, GRIP if state == "contact" else 0.0)
            forget(pad)
            assert states(pad.read(0.5, felt)) == {state}
            assert ("another pad" in str(pad.results[-1].note)) == (felt is other)


def test_a_grip_that_began_during_an_outage_is_in_doubt_until_its_release():
    pad = Pad()
    pad.read(0.5)
    pad.runtime.lose_touch()
    doubted(pad.read(0.5, GRIP))
    assert states(pad.read(0.2)) == {"idle"} and states(pad.read(0.2, GRIP)) == {"contact"}


def test_a_free_pad_in_doubt_is_zeroed_without_force():
    pad, field = Pad(), drift_field(1, 4)
    pad.read(0.5, field)
    pad.runtime.zero()
    last = pad.read(1.5, field)[-1]
    assert last.state == "idle" and last.baseline.origin == "demand" and last.note is None
    assert states(pad.read(0.5, field + GRIP)) == {"contact"}


def test_what_is_in_doubt_is_no_earlier_tap_and_teaches_nothing():
    pad = Pad()
    for _ in range(3):
        pad.read(0.2, GRIP)
        pad.read(0.2, GRIP + drift_field(2, 22))
    assert states(pad.results) == {"baseline_in_doubt"}
    pad.read(0.2)
    assert {one.taps_used for one in pad.read(0.2, GRIP)} == {1}
    assert {one.drift.common_counts for one in pad.results[:-1]} == {(0.0, 0.0, 0.0)}


def test_a_scan_in_doubt_that_is_overtaken_stays_in_doubt():
    pad = Pad()
    scan, newer = (pad._series.close((BASELINE.counts + GRIP).astype(np.int32), n * PERIOD_NS) for n in (1, 2))
    assert pad.runtime.take(scan) == []
    (overtaken,) = pad.runtime.take(newer)
    assert (overtaken.state, overtaken.trusted, overtaken.pattern) == ("baseline_in_doubt", False, None)


TRIALS = sorted(REAL_RECORDINGS.glob("*/"))
REST_ROWS = 30


@pytest.mark.skipif(not TRIALS, reason=f"no recordings in {REAL_RECORDINGS} (set TACTILE_RECORDINGS)")
class TestRealGrips:
    """Four trials of two sensors: three gripped throughout, the last released at its end."""

    def played(self, counts, rest, origin="file"):
        baseline = Baseline.of("4", rest, 1000.0, REST_ROWS, origin)
        runtime = make_runtime(FakeModel(make_trusted_contract()), baselines={"4": baseline})
        series = ScanSeries("4", USPA44)
        return [runtime.push(series.close(row, n * 16_750_000)) for n, row in enumerate(counts)]

    @staticmethod
    def counts(trial, finger):
        return load_recording(trial / f"xela_sensor{finger}.csv").tracks[0].counts

    @staticmethod
    def lowest(counts):
        return np.median(counts[np.argsort(counts[:, 2].sum(axis=(1, 2)))[:REST_ROWS]], axis=0)

    @pytest.mark.parametrize("finger", [1, 2])
    def test_with_the_baseline_of_another_trial_nothing_is_a_contact(self, finger):
        for trial, other in itertools.permutations(TRIALS, 2):
            counts = self.counts(trial, finger)
            for rest in (self.lowest(self.counts(other, finger)), self.lowest(self.counts(other, finger)) - 1350):
                results = self.played(counts, rest)
                assert states(results) == {"baseline_in_doubt"}, (trial.name, other.name)
                assert not any(one.trusted for one in results)

    @pytest.mark.parametrize("finger", [1, 2])
    def test_a_grip_is_a_contact_whole_and_its_free_end_is_none(self, finger):
        counts = self.counts(TRIALS[-1], finger)
        z = counts[:, 2].sum(axis=(1, 2))
        release = int(np.argmax(z < (z[0] + z[-1]) / 2))
        rest = np.median(counts[-REST_ROWS:], axis=0)
        forwards = self.played(counts, rest, "start-up")
        assert states(forwards[:release]) == {"contact"} and states(forwards[release + 5 :]) == {"idle"}
        backwards = self.played(counts[::-1], rest)[::-1]
        assert states(backwards[:release]) == {"contact"} and states(backwards[release + 5 :]) == {"idle"}
