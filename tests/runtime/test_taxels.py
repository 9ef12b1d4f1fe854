"""Dead taxels: detected, named, trusted again; and what is not one."""

import os
from pathlib import Path

import numpy as np
import pytest
from chaos_judge import HELD_CYCLES, RATE_HZ
from edge_samples import BASELINE, PERIOD_NS, REST, ROOT

from edge.inference.bundled import demo_recording
from edge.perception.event import joined
from edge.perception.taxel_health import (
    BACK_SCANS,
    FAR_SCANS,
    FROZEN_SCANS,
    FROZEN_SENSOR_SCANS,
    HOLD_NS,
    HOLD_SCANS,
    LONE_COUNTS,
    REST_COUNTS,
    STUCK_SCANS,
    TAXEL_SILENT_SCANS,
    TaxelWatch,
)
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS
from firmware_bridge.zeroing.baseline import Baseline, deformation

RECORDINGS = Path(os.environ.get("TACTILE_RECORDINGS", ROOT / "../shared/recordings/imanlab"))
NOISE_COUNTS = 2.0
SPHERE_SHARE = 0.030
"""Reading of the largest neighbour as a share of the taxel under a sphere of 1.5 mm, simulated."""


class Pad:
    """A watched pad with noise; `faults` change a scan's counts (3, 16) in place."""

    def __init__(self, baseline=BASELINE, seed=0, noise_counts=NOISE_COUNTS):
        self.watch = TaxelWatch((4, 4))
        self._baseline = baseline
        self._series = ScanSeries("4", USPA44)
        self._rng = np.random.default_rng(seed)
        self._noise_counts = noise_counts
        self._number = 0

    def read(self, scans, *faults):
        """Reasons after each of so many scans."""
        told = []
        for _ in range(scans):
            counts = REST + np.rint(self._rng.normal(0, self._noise_counts, REST.shape)).astype(np.int32)
            for fault in faults:
                fault(counts.reshape(3, 16))
            self._number += 1
            self.watch.push(self._series.close(counts, self._number * PERIOD_NS), self._baseline)
            told.append(dict(self.watch.reasons))
        return told


def at(taxel, *readings):
    def fault(counts):
        counts[:, taxel] = readings

    return fault


def silent(taxel):
    return at(taxel, ABSENT, ABSENT, ABSENT)


def pressed(taxel, z_counts, share=0.3):
    """The taxel by so much, the others by a share of it."""

    def press(counts):
        counts[2] += int(share * z_counts)
        counts[2, taxel] += int((1 - share) * z_counts)

    return press


def shifted(taxel, z_counts):
    return pressed(taxel, z_counts, share=0)


@pytest.mark.parametrize(
    ("fault", "reason", "after"),
    [
        (silent(7), "silent", HOLD_SCANS),
        (at(7, 16_000, 16_000, 65535), "saturated", HOLD_SCANS),
        (at(7, 16_100, 16_500, 38_900), "stuck", STUCK_SCANS),
        (shifted(7, -8000), "far", FAR_SCANS - 1),
    ],
)
def test_a_dead_taxel_is_named_after_so_many_scans_and_believed_after_good_ones(fault, reason, after):
    pad = Pad()
    assert not any(pad.read(50))
    assert pad.read(after, fault) == [{}] * after
    assert pad.read(30, fault) == [{7: reason}] * 30
    assert pad.watch.dead.ravel().tolist() == [taxel == 7 for taxel in range(16)]
    back = pad.read(BACK_SCANS + 5)
    assert back[: BACK_SCANS - 1] == [{7: reason}] * (BACK_SCANS - 1)
    assert back[-1] == {}


@pytest.mark.parametrize("reason", ["silent", "stuck"])
def test_one_that_comes_and_goes_does_not_flicker(reason):
    fault = silent(3) if reason == "silent" else at(3, 1, 2, 3)
    pad = Pad()
    pad.read(5)
    pad.read(40, fault)
    for _ in range(10):
        assert pad.read(BACK_SCANS - 2) + pad.read(2, fault) == [{3: reason}] * BACK_SCANS


def test_a_sensor_that_sends_one_scan_for_ever_is_frozen_after_ten():
    pad = Pad(noise_counts=0)
    assert not any(pad.read(FROZEN_SENSOR_SCANS))
    assert pad.read(1) == [dict.fromkeys(range(16), "stuck")]
    assert not pad.watch.may_be_estimated
    assert joined(pad.watch.notes(None)) == "no pattern, the sensor is frozen: its last 10 scans are alike bit for bit"


@pytest.mark.parametrize(
    ("stuck", "after"), [(1, STUCK_SCANS), (8, STUCK_SCANS), (12, STUCK_SCANS), (13, FROZEN_SCANS)]
)
def test_the_stuck_are_found_among_the_few_that_are_left(stuck, after):
    pad = Pad()
    pad.read(5)
    told = pad.read(after + 5, *(at(taxel, 16_000, 16_400, 38_700) for taxel in range(stuck)))
    # A living taxel repeats itself now and then, and with few of them a scan then shows nothing.
    assert not any(told[:after]) and told[-1] == dict.fromkeys(range(stuck), "stuck")
    assert pad.watch.may_be_estimated == (stuck <= 8)


def test_the_dead_do_not_count_among_those_that_should_be_new():
    pad = Pad()
    pad.read(5)
    dead = [silent(taxel) for taxel in range(8)]
    pad.read(STUCK_SCANS, *dead)
    stuck = [at(taxel, 16_000, 16_400, 38_700) for taxel in range(8, 14)]
    assert len(pad.read(STUCK_SCANS + 5, *dead, *stuck)[-1]) == 14


def test_half_of_the_taxels_silent_are_a_wrong_id_map():
    pad = Pad()
    pad.read(TAXEL_SILENT_SCANS, *(silent(taxel) for taxel in range(8)))
    assert not pad.watch.may_be_estimated
    assert joined(pad.watch.notes(None)) == "no pattern, taxel 0, 1, 2, 3, 4, 5, 6, 7 silent: try another --id-map"


def test_a_taxel_alone_far_from_rest_is_not_pressed():
    pad = Pad()
    assert pad.read(FAR_SCANS, shifted(5, 2 * LONE_COUNTS))[-1] == {5: "far"}
    # While something is touched it may be as it should; it is believed once it is seen at rest.
    assert pad.read(50, pressed(5, 3 * REST_COUNTS))[-1] == {5: "far"}
    assert pad.read(BACK_SCANS)[-1] == {}


def test_what_a_dead_taxel_last_read_hides_no_other_one():
    pad = Pad()
    pad.read(5, pressed(7, 8000))
    pad.read(HOLD_SCANS + 1, silent(7))
    assert pad.read(FAR_SCANS, silent(7), shifted(5, 2 * LONE_COUNTS))[-1] == {5: "far", 7: "silent"}


@pytest.mark.parametrize("taxel", [0, 5, 15])
def test_a_small_sphere_on_one_taxel_is_not_a_fault(taxel):
    assert not any(Pad().read(3 * FAR_SCANS, pressed(taxel, 3000, share=SPHERE_SHARE)))


def test_a_taxel_that_was_never_heard_is_waited_for_then_given_up():
    pad = Pad()
    pad.read(1, silent(2))
    assert pad.watch.waiting
    assert pad.read(HOLD_SCANS, silent(2))[-1] == {2: "silent"}
    assert not pad.watch.waiting


def test_a_taxel_without_rest_is_never_believed():
    counts = BASELINE.counts.copy()
    counts[:, 1, 2] = np.nan
    pad = Pad(Baseline.of("4", counts, 0.0, 100, "start-up"))
    assert pad.read(50)[-1] == {6: "unzeroed"}


def test_an_hour_of_noise_raises_nothing():
    """Ten thousand scans stand for it: no taxel came nearer to stuck than four scans in a row."""
    pad = Pad(seed=3)
    assert not any(pad.read(10_000))


def test_what_is_told():
    pad = Pad()
    pad.read(STUCK_SCANS + 3, at(3, 1, 2, 3), silent(7))
    (estimated,) = pad.watch.notes("neighbours")
    assert estimated.kind == "estimated" and estimated.text in (
        "taxel 7 silent, taxel 3 stuck: estimated from their neighbours",
        "taxel 3 stuck, taxel 7 silent: estimated from their neighbours",
    )
    told = [("dead", "no pattern, taxel 3 stuck: it may be broken"), ("dead", "no pattern, taxel 7 silent")]
    assert sorted((note.kind, note.text) for note in pad.watch.notes(None)) == told


def raised(counts, baseline):
    """Reasons over the scans of one recording."""
    watch, series, found = TaxelWatch((4, 4)), ScanSeries("4", USPA44), []
    for number, row in enumerate(counts):
        watch.push(series.close(row.astype(np.int32), number * PERIOD_NS), baseline)
        found.append(dict(watch.reasons))
    return [reasons for reasons in found if reasons]


def test_the_demo_raises_nothing():
    counts = load_recording(demo_recording()).tracks[0].counts
    assert raised(counts, Baseline.from_counts("4", counts[:100], 0.0)) == []


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason=f"no real recordings at {RECORDINGS} (TACTILE_RECORDINGS)")
def test_real_grips_raise_nothing():
    paths = sorted(RECORDINGS.glob("*/xela_*.csv"))
    assert paths
    for path in paths:
        counts = load_recording(path).tracks[0].counts
        # Zeroed in the grip, as a robot may, and where the grip has been let go.
        for rest in (counts[:100], counts[-20:]):
            assert raised(counts, Baseline.from_counts("4", rest, 0.0)) == [], path


def test_readings_over_the_baseline_come_with_it():
    watch, series = TaxelWatch((4, 4)), ScanSeries("4", USPA44)
    scan = series.close(REST + 9, PERIOD_NS)
    assert watch.push(scan, None) is None
    np.testing.assert_array_equal(watch.push(scan, BASELINE), deformation(scan.counts, BASELINE))


def test_one_at_its_end_among_others_that_are_pressed_is_held_from_the_first_scan():
    pad = Pad()
    pad.read(3)

    def press(counts):
        counts[2] += 5000

    def at_the_end(counts):
        counts[2, 5] = 65535

    assert 65535 - BASELINE.counts[2, 1, 1] < 27_000, "as a contact might read"
    pad.read(1, press)
    before = pad.watch.held[2, 1, 1]
    pad.read(1, press, at_the_end)
    assert pad.watch.held[2, 1, 1] == before
    assert "its last reading is held, taxel 5 at the end of its range" in (joined(pad.watch.notes(None)) or "")


def test_no_reading_is_held_for_longer_than_the_judge_of_faults_allows():
    """A pause, the longest that a scan may have, may lie between a reading and the end of its own scan."""
    assert (HOLD_NS + LONGEST_PAUSE_NS) / 1e9 <= HELD_CYCLES / RATE_HZ


@pytest.mark.parametrize(("pause_ns", "held"), [(HOLD_NS, True), (HOLD_NS + 1, False)])
@pytest.mark.parametrize("torn_before", [False, True])
def test_a_reading_from_before_a_pause_is_not_held(pause_ns, held, torn_before):
    """Five scans are 50 ms at 100 Hz, but whole ones may have vanished: what was pressed before is another press."""
    watch, series = TaxelWatch((4, 4)), ScanSeries("4", USPA44)
    missing = REST.copy()
    missing[:, 1, 3] = ABSENT

    def push(number, counts, time_ns):
        watch.push(series.close((counts + number * (counts != ABSENT)).astype(np.int32), time_ns), BASELINE)

    for number in range(3):
        other = REST.copy()
        other[:, 0, 0] = ABSENT if torn_before and number == 1 else REST[:, 0, 0]
        push(number, other, number * PERIOD_NS)
    push(3, missing, 2 * PERIOD_NS + pause_ns)
    assert watch.reasons == ({} if held else {7: "silent"})
