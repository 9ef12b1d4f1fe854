"""Dead taxels: detected, named, held for a while, trusted again; what is not one; and estimates of their readings."""

from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS
from chaos import HELD_CYCLES, RATE_HZ
from edge_samples import BASELINE, PERIOD_NS, REST, make_scan
from runtime_samples import PRESS, Pushed, make_runtime

from edge.api import USPA44, Baseline, EdgeError, demo_recording
from edge.inference.bundled import TAXELS_FILE
from edge.perception import taxel_health as health
from edge.perception.taxel_health import (
    BACK_SCANS,
    FAR_SCANS,
    HOLD_SCANS,
    STUCK_SCANS,
    TAXEL_SILENT_SCANS,
    filler,
    load_estimator,
    ridged,
)
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS

ESTIMATOR = load_estimator(TAXELS_FILE, (4, 4))


class Pad:
    """A pad with noise; `faults` change a scan's counts (3, 16) in place."""

    def __init__(self, baseline=BASELINE, seed=0, noise_counts=2.0):
        self._runtime = make_runtime(baselines={"4": baseline}, estimator=ESTIMATOR)
        self._series, self._rng, self._noise_counts = ScanSeries("4", USPA44), np.random.default_rng(seed), noise_counts
        self._time_ns = 0

    def push(self, counts, later_ns=PERIOD_NS):
        """Return the reasons after a scan."""
        self._time_ns += later_ns
        self.result = self._runtime.push(self._series.close(counts.astype(np.int32), self._time_ns))
        return dict(self.result.dead)

    def read(self, scans, *faults):
        """Return the reasons after each of so many scans."""
        told = []
        for _ in range(scans):
            counts = np.rint(REST + self._rng.normal(0, self._noise_counts, REST.shape))
            for fault in faults:
                fault(counts.reshape(3, 16))
            told.append(self.push(counts))
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


STUCK = (16_000, 16_400, 38_700)


class TestWatch:
    @pytest.mark.parametrize(
        ("fault", "reason", "after"),
        [
            (silent(7), "silent", HOLD_SCANS),
            (at(7, 16_000, 16_000, 65535), "saturated", HOLD_SCANS),
            (at(7, 16_100, 16_500, 38_900), "stuck", STUCK_SCANS),
            (shifted(7, -8000), "far", FAR_SCANS - 1),
        ],
    )
    def test_a_dead_taxel_is_named_and_believed_after_good_scans(self, fault, reason, after):
        pad = Pad()
        assert not any(pad.read(50) + pad.read(after, fault))
        assert pad.read(30, fault) == [{7: reason}] * 30
        back = pad.read(BACK_SCANS + 5)
        assert back[: BACK_SCANS - 1] == [{7: reason}] * (BACK_SCANS - 1) and back[-1] == {}

    def test_one_that_comes_and_goes_does_not_flicker(self):
        pad = Pad()
        pad.read(45, at(3, 1, 2, 3))
        for _ in range(10):
            assert pad.read(BACK_SCANS - 2) + pad.read(2, at(3, 1, 2, 3)) == [{3: "stuck"}] * BACK_SCANS

    def test_a_sensor_that_repeats_one_scan_is_frozen_after_ten(self):
        pad = Pad(noise_counts=0)
        assert not any(pad.read(health.FROZEN_SENSOR_SCANS))
        assert pad.read(1) == [dict.fromkeys(range(16), "stuck")]
        assert pad.result.state == "incomplete"
        assert pad.result.note == "no pattern, the sensor is frozen: its last 10 scans are alike bit for bit"

    @pytest.mark.parametrize(
        ("stuck", "after"), [(1, STUCK_SCANS), (8, STUCK_SCANS), (12, STUCK_SCANS), (13, health.FROZEN_SCANS)]
    )
    def test_the_stuck_are_found_among_the_few_that_are_left(self, stuck, after):
        pad = Pad()
        pad.read(5)
        told = pad.read(after + 5, *(at(taxel, *STUCK) for taxel in range(stuck)))
        # A living taxel repeats itself now and then, and with few of them a scan then shows nothing.
        assert not any(told[:after]) and told[-1] == dict.fromkeys(range(stuck), "stuck")
        assert (pad.result.filled == "neighbours") == (stuck <= 8)

    def test_the_dead_do_not_count_among_those_that_should_be_new(self):
        pad = Pad()
        pad.read(5)
        dead = [silent(taxel) for taxel in range(8)]
        pad.read(STUCK_SCANS, *dead)
        assert len(pad.read(STUCK_SCANS + 5, *dead, *(at(taxel, *STUCK) for taxel in range(8, 14)))[-1]) == 14

    def test_a_taxel_alone_far_from_rest_is_not_pressed(self):
        pad = Pad()
        assert pad.read(FAR_SCANS, shifted(5, 2 * health.LONE_COUNTS))[-1] == {5: "far"}
        # While something is touched it may be as it should; it is believed once it is seen at rest.
        assert pad.read(50, pressed(5, 3 * health.REST_COUNTS))[-1] == {5: "far"}
        assert pad.read(BACK_SCANS)[-1] == {}

    def test_a_taxel_without_reading_or_rest_is_never_believed(self):
        pad = Pad()
        pad.read(1, silent(2))
        assert pad.result.state == "incomplete" and not pad.result.dead
        assert pad.read(HOLD_SCANS, silent(2))[-1] == {2: "silent"} and pad.result.filled == "neighbours"
        counts = BASELINE.counts.copy()
        counts[:, 1, 2] = np.nan
        assert Pad(Baseline.of("4", counts, 0.0, 100, "start-up")).read(50)[-1] == {6: "unzeroed"}

    def test_neither_a_small_sphere_nor_noise_is_a_fault(self):
        """The sphere's largest neighbour reads 0.030 of it, simulated."""
        assert not any(Pad().read(3 * FAR_SCANS, pressed(5, 3000, share=0.030)))
        assert not any(Pad(seed=3).read(3000))

    def test_no_reading_is_held_for_too_long(self):
        """A pause, the longest that a scan may have, may lie between a reading and the end of its own scan."""
        assert (health.HOLD_NS + LONGEST_PAUSE_NS) / 1e9 <= HELD_CYCLES / RATE_HZ

    @pytest.mark.parametrize(
        ("pause_ns", "held", "torn_before"),
        [*((health.HOLD_NS, True, torn) for torn in (0, 1)), *((health.HOLD_NS + 1, False, torn) for torn in (0, 1))],
    )
    def test_a_reading_from_before_a_pause_is_not_held(self, pause_ns, held, torn_before):
        """Five scans are 50 ms at 100 Hz, but whole ones may have vanished: before was another press."""
        pad = Pad()
        assert not any(pad.read(1) + pad.read(1, *[silent(0)] * torn_before) + pad.read(1))
        torn = REST + 1
        silent(7)(torn.reshape(3, 16))
        assert pad.push(torn, pause_ns) == ({} if held else {7: "silent"})


@pytest.mark.parametrize("path", [demo_recording(), *sorted(REAL_RECORDINGS.glob("*/xela_*.csv"))], ids=str)
def test_neither_the_demo_nor_real_grips_raise_anything(path):
    counts = load_recording(path).tracks[0].counts
    # Zeroed in the grip, as a robot may, and where the grip has been let go.
    for rest in (counts[:100], counts[-20:])[: 1 + (path.suffix == ".csv")]:
        pad = Pad(Baseline.from_counts("4", rest, 0.0))
        assert not any(pad.push(row) for row in counts)


def saturated(pad, counts, press=PRESS, **changes):
    """Return the result of a scan in which taxel 5 reads so much."""
    scan = pad.scan(press, **changes)
    scan.counts[2].flat[5] = counts
    return pad.runtime.push(scan)


class TestRuntime:
    def test_one_silent_taxel_spoils_no_zeroing_but_half_of_them_do(self):
        pad = Pushed(make_runtime(baselines={}), noise=4)
        states = [pad.push(absent=(0,)).state for _ in range(TAXEL_SILENT_SCANS + 100)]
        assert states == ["zeroing"] * (TAXEL_SILENT_SCANS + 98) + ["incomplete"] * 2
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(pad.results[-1].baseline.counts[2])), [0])
        back = [pad.push() for _ in range(2 * BACK_SCANS)][-1]
        assert (back.state, back.dead) == ("incomplete", {0: "unzeroed"})
        assert back.note == "no pattern, taxel 0 not zeroed: zero again"
        pad = Pushed(make_runtime(baselines={}), noise=4)
        assert {pad.push(absent=tuple(range(8))).state for _ in range(400)} == {"zeroing"}

    @pytest.mark.parametrize("stamped", [True, False])
    def test_a_reading_that_came_late_is_held_since_it_was_taken(self, stamped):
        """Readings that a delayed reader fetches together were not taken together."""
        runtime = make_runtime()
        runtime.push(make_scan(0, press_counts=PRESS))
        came_ns, late_ns = 50 * PERIOD_NS, 35 * PERIOD_NS
        late = make_scan(1, press_counts=PRESS, time_ns=came_ns)
        taken = {"device_ns": came_ns - late_ns} if stamped else {"unread_ns": late_ns}
        assert "old when it arrived" in runtime.push(replace(late, **taken)).note
        torn = make_scan(2, press_counts=PRESS, absent=(0, 1), time_ns=came_ns + PERIOD_NS)
        result = runtime.push(replace(torn, device_ns=torn.time_ns if stamped else None))
        assert result.pattern is None and result.dead == {0: "silent", 1: "silent"}

    def test_taxels_that_stay_silent_are_named_with_one_at_its_end(self):
        one, half, ended = Pushed(make_runtime(baselines={})), Pushed(make_runtime(baselines={})), Pushed()
        notes = [one.push(absent=(5,)).note for _ in range(TAXEL_SILENT_SCANS)]
        assert notes[HOLD_SCANS - 1 : HOLD_SCANS + 1] == [None, "no pattern, taxel 5 silent"]
        assert notes[-1] == "no pattern, taxel 5 silent: it may be broken"
        assert [one.push().note for _ in range(BACK_SCANS)][-1] is None
        taxels, why = tuple(range(8, 16)), "taxel 8, 9, 10, 11, 12, 13, 14, 15 silent: try another --id-map"
        for _ in range(TAXEL_SILENT_SCANS):
            note = half.push(absent=taxels).note
            both = saturated(ended, health.RANGE_ENDS[1], press=0, absent=taxels).note
        assert note == f"no pattern, {why}" and "taxel 5 at the end of its range" in both and both.endswith(why)

    @pytest.mark.parametrize("counts", health.RANGE_ENDS)
    def test_a_chip_at_the_end_of_its_range_has_no_reading(self, counts):
        """The last reading is held for a while, as of a silent taxel; then there is no pattern."""
        pad = Pushed()
        pattern = pad.push(PRESS).pattern
        why = "taxel 5 at the end of its range: overloaded, too near a magnet, or broken"
        for _ in range(HOLD_SCANS):
            held = saturated(pad, counts)
            np.testing.assert_array_equal(held.pattern, pattern)
            assert held.notes[0].text == f"its last reading is held, {why}"
        gone = saturated(pad, counts)
        assert (gone.state, gone.pattern, gone.contact, gone.note) == ("incomplete", None, None, f"no pattern, {why}")
        back = [pad.push(PRESS) for _ in range(BACK_SCANS)][-1]
        assert back.state == "contact" and len(back.notes) == 1 and back.dead == {}
        assert [saturated(pad, 65534).state for _ in range(HOLD_SCANS + 2)][-1] == "contact", "a count from the end"


@pytest.mark.parametrize("kind", [0, 1])
def test_the_dead_are_estimated_by_the_kind_of_contact(kind):
    """Without error, where any living taxel determines every dead one: one pattern an axis."""
    shapes, dead = np.random.default_rng(0).uniform(500, 1500, (2, 16)) * [[1], [-1]], np.zeros((4, 4), dtype=bool)
    dead.flat[[1, 6, 11]] = True
    fill = filler(ridged(np.stack([np.kron(np.diag([1.0, 1, 4]), np.outer(shape, shape)) for shape in shapes])), dead)
    counts = np.outer([0.3, -0.2, 2.0], shapes[kind]).astype(np.float32).reshape(3, 4, 4)
    told = fill(np.where(dead, 1e6, counts).astype(np.float32))
    np.testing.assert_allclose(told, counts, rtol=0.02)
    np.testing.assert_array_equal(told[:, ~dead], counts[:, ~dead])


def test_a_file_that_is_missing_or_of_another_grid_is_refused(tmp_path):
    path = tmp_path / "taxels.npz"
    for why in ("No such file", r"covariances are \(1, 47, 47\), expected \(n, 48, 48\)"):
        with pytest.raises(EdgeError, match=rf"taxels\.npz cannot be read .*{why}.*train\.freeze"):
            load_estimator(path, (4, 4))
        np.savez(path, covariances=np.eye(47)[None])


def test_taps_are_forgotten_when_a_taxel_dies_or_is_back():
    """A window never holds readings of an undetected dead taxel, or filled in ones, without a note."""
    pad, dies = Pushed(make_runtime(estimator=ESTIMATOR)), 10 + HOLD_SCANS
    for number, press in enumerate([PRESS, PRESS, 0] * 12):
        pad.push(press, absent=(0,) if 10 <= number <= dies else ())
    used, lives = [result.taps_used for result in pad.results], dies + BACK_SCANS
    assert max(used[dies - 3 : dies]) == 4 and max(used[dies : dies + 3]) == 1
    assert max(used[lives : lives + 3]) == 1 < max(used[lives - 3 : lives])
