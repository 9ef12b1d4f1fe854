"""Drift, warming and old baselines, which look like a touch, are no contact; what begins as a touch is one."""

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS
from edge_samples import BASELINE, PERIOD_NS, REST, FakeLink, FakeModel
from runtime_samples import Pushed, make_runtime
from trust_samples import make_trusted_contract

from edge.api import USPA44, Baseline, Source, Stream, open_runtime
from edge.perception.run_options import RuntimeOptions
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries

TAKEN = replace(BASELINE, origin="start-up")
ROW, COL = np.mgrid[-1.5:2:1, -1.5:2:1] / 1.5
GRIP = np.zeros((3, 4, 4))
"""A flat grip: as even as real ones, whose taxels differ from their median by 0.55 of it and more."""
GRIP[2] = 700 + 300 * ROW + 60 * COL
GRIP[0] = -180 + 60 * ROW
LOCAL = np.zeros((3, 4, 4))
LOCAL[2, 1, 1:3] = 1500
CORNER = np.zeros((3, 4, 4))
CORNER[2, :2, :3] = 700  # six taxels: fewer rest than show that the pad was free
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


class Pad(Pushed):
    """A sensor that reads what it is told to."""

    def __init__(self, baseline=BASELINE, **options):
        model = FakeModel(make_trusted_contract())
        super().__init__(make_runtime(model, baselines={"4": baseline}, options=RuntimeOptions(**options)), noise=4)

    def read(self, seconds, felt=0.0):
        """Return the results of readings over the rest level, or of what it gives for each time in [s]."""
        at = (lambda number: felt(number * PERIOD_NS / 1e9)) if callable(felt) else felt
        return self.play(max(1, round(seconds * 1e9 / PERIOD_NS)), at)


def states(results):
    return {result.state for result in results}


def doubted(results):
    assert states(results) == {"baseline_in_doubt"}, states(results)
    assert {(one.contact, one.trusted, one.untrusted_reason) for one in results} == {(None, False, "baseline")}
    assert all(one.area_mm2 is one.next_tap is one.wrench is one.centroid_mm is None for one in results)
    assert all("baseline in doubt" in str(one.note) and "zero again" in str(one.note) for one in results)
    return str(results[0].note)


@pytest.mark.parametrize("seed", range(6))
def test_an_old_baseline_is_in_doubt_from_the_first_scan(seed):
    for hours in (4, 22):
        doubted(Pad().read(0.3, drift_field(seed, hours)))
    assert states(Pad().read(0.3, drift_field(seed, 1))) <= {"idle", "baseline_in_doubt"}, "of an hour's drift"


@pytest.mark.parametrize("counts", [-900, -60, 60, 100, 900])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_common_change_of_any_size_sign_and_axis_is_in_doubt(counts, axis):
    felt = np.zeros((3, 4, 4))
    felt[axis] = counts * (1 + 0.2 * ROW)
    note = doubted(Pad().read(0.3, felt))
    assert f"{'xyz'[axis]} {counts:+d}"[:3] in note and "(baseline 60 s old)" in note


FREE, HELD, DOUBT = {"idle"}, {"contact"}, {"baseline_in_doubt"}
FIELD = np.zeros((3, 4, 4))
FIELD[2] = 300 * (1 + 0.2 * COL)


@pytest.mark.parametrize(
    ("baseline", "told", "why"),
    [
        # A grip from a rest that was seen is a contact, which ends as one, and is one again where it is tightened.
        (BASELINE, [(0.0, FREE), (GRIP, HELD), (GRIP * 0.6, HELD), (GRIP * 0.04, FREE), (GRIP, HELD)], None),
        (BASELINE, [(0.0, FREE), (GRIP, HELD), (GRIP * 0.15, DOUBT), (GRIP, HELD)], ""),
        # A recording that begins gripped is one with its own baseline alone.
        (TAKEN, [(GRIP, HELD)], None),
        (BASELINE, [(GRIP, DOUBT), (0.0, FREE), (GRIP, HELD)], ""),
        # A local press needs no rest before it, not even where it begins a grip, but for an old baseline.
        (BASELINE, [(LOCAL, HELD)], None),
        (BASELINE, [(CORNER, HELD), (GRIP, HELD)], None),
        # Nor does drift explain one that is loosened, as it does a grip.
        (BASELINE, [(0.0, FREE), (CORNER, HELD), (CORNER * 0.3, HELD)], None),
        (BASELINE, [(LOCAL + drift_field(0, 4), DOUBT)], ""),
        # All taxels alike at once are a field and no touch.
        (BASELINE, [(0.0, FREE), (FIELD, DOUBT), (0.0, FREE)], "alike"),
        # A baseline that was taken under load shows at the release, and the pad was not seen at rest since.
        (TAKEN, [(0.0, FREE), (-GRIP, DOUBT)], "it was taken while something pressed"),
        (TAKEN, [(0.0, FREE), (-GRIP, DOUBT), (GRIP, DOUBT), (0.0, FREE)], ""),
    ],
)
def test_what_is_felt_is_a_contact_or_in_doubt(baseline, told, why):
    pad = Pad(baseline)
    for felt, expected in told:
        assert states(pad.read(0.4, felt)[15:]) == expected, pad.kinds
        if expected == DOUBT:
            assert why in doubted(pad.results[-25:])
    doubts = why is not None
    assert set(pad.kinds) == {*["baseline_doubted"] * doubts, *["baseline_cleared"] * (doubts and told[-1][1] != DOUBT)}


def test_what_a_release_leaves_is_no_contact():
    """A pad that warmed by 3 K under a grip, and cools by a time constant of ten seconds."""
    pad = Pad()
    pad.read(0.5)
    assert states(pad.read(2, lambda t: GRIP * min(t / 0.1, 1))[5:]) == HELD
    left = pad.read(20, lambda t: WARM * np.exp(-t / 5))
    assert states(left[:12]) <= HELD | DOUBT and states(left[12:]) == DOUBT | FREE
    assert "after a release" in str(left[12].note) and states(left[-300:]) == FREE
    assert states(pad.read(1, GRIP)) == HELD


@pytest.mark.parametrize("follow_drift", [True, False])
@pytest.mark.parametrize("counts_per_s", [10, 20, -20])
def test_drift_that_creeps_over_the_threshold_is_no_contact(counts_per_s, follow_drift):
    pad = Pad(follow_drift=follow_drift)
    pad.read(1)
    shape = np.array([0, 0, 1])[:, None, None] * PADS
    crept = pad.read(200 / abs(counts_per_s), lambda t: counts_per_s * t * shape)
    assert states(crept) <= FREE | DOUBT
    if counts_per_s > 0 and not follow_drift:
        assert crept[-1].state == "baseline_in_doubt" and "rose slowly" in str(crept[-1].note)
        assert states(pad.read(0.5, GRIP * 2)) == HELD, "drift does not explain it any more"


OTHER = np.random.default_rng(9).integers(150, 700, (3, 4, 4))


@pytest.mark.parametrize("lost", [True, False])
@pytest.mark.parametrize(
    ("before", "felt", "state"),
    [(0.0, 0.0, FREE), (GRIP, GRIP, HELD), (0.0, GRIP, DOUBT), (0.0, OTHER, DOUBT), (0.0, -OTHER, DOUBT)],
)
def test_after_an_outage_rest_levels_are_compared(before, felt, state, lost):
    pad = Pad()
    pad.read(0.5)
    pad.read(0.2, before)
    if lost:
        pad.runtime.lose_touch()
    else:
        pad.number += 6000
    assert states(pad.read(0.5, felt)) == state
    assert ("another pad" in str(pad.results[-1].note)) == (state == DOUBT and np.mean(felt) > 0)
    pad.read(0.2)
    assert states(pad.read(0.2, GRIP)) == HELD


def test_a_free_pad_in_doubt_is_zeroed_without_force():
    pad, field = Pad(), drift_field(1, 4)
    pad.read(0.5, field)
    pad.runtime.zero()
    last = pad.read(1.5, field)[-1]
    assert last.state == "idle" and last.baseline.origin == "demand" and last.note is None
    assert states(pad.read(0.5, field + GRIP)) == HELD


def test_what_is_in_doubt_is_no_earlier_tap_and_teaches_nothing():
    pad = Pad()
    for _ in range(3):
        pad.read(0.2, GRIP)
        pad.read(0.2, GRIP + drift_field(2, 22))
    assert states(pad.results) == DOUBT
    held = pad.results[10]
    assert held.pattern is not None and held.taps_used == 1 and held.traction is None
    pad.read(0.2)
    assert {one.taps_used for one in pad.read(0.2, GRIP)} == {1}
    assert {one.drift.common_counts for one in pad.results[:-1]} == {(0.0, 0.0, 0.0)}


def test_a_scan_in_doubt_that_is_overtaken_stays_in_doubt():
    pad = Pad()
    scans = [replace(pad.scan(), counts=(BASELINE.counts + GRIP).astype(np.int32)) for _ in range(2)]
    assert pad.runtime.take(scans[0]) == []
    (overtaken,) = pad.runtime.take(scans[1])
    assert (overtaken.state, overtaken.trusted, overtaken.pattern) == ("baseline_in_doubt", False, None)


TRIALS = sorted(REAL_RECORDINGS.glob("*/"))
REST_ROWS = 30


@pytest.mark.skipif(not TRIALS, reason=f"no recordings in {REAL_RECORDINGS} (set TACTILE_RECORDINGS)")
class TestRealGrips:
    """Four trials of two sensors: three gripped throughout, the last released at its end."""

    def played(self, counts, rest, origin="file"):
        baseline, series = Baseline.of("4", rest, 1000.0, REST_ROWS, origin), ScanSeries("4", USPA44)
        runtime = make_runtime(FakeModel(make_trusted_contract()), baselines={"4": baseline})
        return [runtime.push(series.close(row, n * 16_750_000)) for n, row in enumerate(counts)]

    def counts(self, trial, finger):
        return load_recording(trial / f"xela_sensor{finger}.csv").tracks[0].counts

    @pytest.mark.parametrize("finger", [1, 2])
    def test_with_the_baseline_of_another_trial_nothing_is_a_contact(self, finger):
        for trial, other in itertools.permutations(TRIALS, 2):
            counts = self.counts(other, finger)
            lowest = np.median(counts[np.argsort(counts[:, 2].sum(axis=(1, 2)))[:REST_ROWS]], axis=0)
            for rest in (lowest, lowest - 1350)[: 1 + (trial == TRIALS[0])]:
                results = self.played(self.counts(trial, finger), rest)
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


@pytest.mark.parametrize(
    ("age_s", "state"), [(1.0, "contact"), (5 * 3600.0, "baseline_in_doubt"), (math.nan, "baseline_in_doubt")]
)
def test_a_baseline_that_a_program_has_kept_is_stored_as_well(age_s, state):
    """It was taken by this very program, but nobody has seen since that the pad rests near it."""
    baseline = Baseline.from_counts("4", np.stack([REST.astype(int)] * 9), time.time() - age_s)
    series = ScanSeries("4", USPA44)
    scans = [series.close((REST + GRIP).astype(np.int32) + number, number * PERIOD_NS) for number in range(5)]
    with Source(FakeLink([[scan] for scan in scans])) as source:
        *_, last = Stream(source, open_runtime(FakeModel(), source, baselines={"4": baseline}))
    assert last.state == state
