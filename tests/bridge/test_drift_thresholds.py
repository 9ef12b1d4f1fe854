"""The drift tracker at its thresholds: one count below and above, on a pad without noise, block by block."""

from functools import partial

import numpy as np
import pytest
from edge_samples import BASELINE, REST
from numpy.typing import ArrayLike

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift, DriftTracker

PERIOD_NS = 62_500_000
"""Eight scans last half a second: the shortest block of the fewest scans."""
NONE_DEAD = np.zeros((4, 4), dtype=bool)
SETTLED = [False] * 5


class Blocks:
    """A tracker, and whole blocks of scans for it."""

    def __init__(self, baseline=BASELINE, dead=NONE_DEAD):
        self.tracker = DriftTracker(baseline)
        self.time_ns = 7_000_000_000
        self.contact, self.dead = False, dead
        self._rest = np.nan_to_num(baseline.counts).astype(np.int32)
        self._series = ScanSeries("4", USPA44)
        self.push()

    def push(self, offset: ArrayLike = 0, after_ns=PERIOD_NS, absent=None):
        self.time_ns += after_ns
        counts = (self._rest + np.asarray(offset, dtype=np.int32)) % 65536
        if absent is not None:
            counts[:, absent] = ABSENT
        return self.tracker.push(self._series.close(counts, self.time_ns), self.contact, self.dead)

    def block(self, *offsets, **options):
        """Push eight scans, with these offsets by turns, and return what the last one gave; the others give False."""
        turns = offsets or (0,)
        answers = [self.push(turns[number % len(turns)], **options) for number in range(8)]
        assert answers[:-1] == [False] * 7
        return answers[-1]

    def blocks(self, number, offset: ArrayLike = 0):
        return [self.block(offset) for _ in range(number)]

    def touched(self, offset: ArrayLike = 0):
        """A contact, and what five blocks after it answer."""
        self.contact = True
        self.push(900)
        self.contact = False
        self.push(offset)
        return self.blocks(5, offset)

    @property
    def event(self):
        return self.tracker.take_event() or ""

    @property
    def step(self):
        return self.tracker.summary.step_counts


def resting(**options):
    pad = Blocks(**options)
    assert pad.blocks(5) == SETTLED
    return pad


def of_z(common: float = 0, *, taxel=0, own: float = 0):
    """So many counts on z of all taxels, and more on one."""
    counts = np.zeros((3, 16))
    counts[2] = common
    counts[2, taxel] += own
    return counts.reshape(3, 4, 4)


def on_axes(x, y, z):
    return np.broadcast_to(np.array([x, y, z])[:, None, None], (3, 4, 4))


def test_a_new_tracker_has_moved_nothing():
    tracker = DriftTracker(BASELINE)
    assert tracker.summary == Drift((0, 0, 0), 0, 0) and not tracker.counts.any()
    assert tracker.note is None and tracker.take_event() is None


def test_after_five_blocks_it_is_followed_one_block_late():
    pad = Blocks()
    assert pad.blocks(7) == [*SETTLED, True, True]
    assert pad.block(on_axes(2, -3, 6)) is True and not pad.tracker.counts.any()
    assert pad.block(on_axes(2, -3, 6)) is True
    np.testing.assert_allclose(pad.tracker.counts, on_axes(2, -3, 6), atol=1e-5)
    assert pad.tracker.summary.common_counts == pytest.approx((2, -3, 6), abs=1e-5)
    assert pad.tracker.summary.own_counts == pytest.approx(0, abs=1e-5) and pad.step == 0


@pytest.mark.parametrize("sign", [1, -1])
def test_of_common_drift_twenty_counts_a_second_are_followed(sign):
    pad, ahead = resting(), of_z(sign * 25)
    got = []
    for _ in range(5):
        assert pad.block(ahead) is True
        got.append(float(pad.tracker.counts[2, 1, 1]))
    assert got == pytest.approx([0, sign * 10, sign * 20, sign * 25, sign * 25], abs=1e-4)


@pytest.mark.parametrize(
    ("ahead", "followed"),
    [
        (of_z(50), True),
        (of_z(51), False),
        (of_z(own=10), True),
        (of_z(own=11), False),
        (of_z(-20, own=22), True),
        (of_z(-20, own=24), False),
        (of_z(4, own=12), True),
        (of_z(4, own=13), False),
    ],
)
def test_what_is_ahead_is_followed_up_to_a_touch(ahead, followed):
    pad = resting()
    assert pad.block(ahead) is followed
    assert pad.blocks(6) == ([True] * 6 if followed else [*SETTLED, True])


def test_what_was_followed_of_a_touch_is_dropped():
    pad = resting()
    assert [pad.block(of_z(6)), pad.block(of_z(6, own=200))] == [True, False]
    pad.blocks(6)
    assert not pad.tracker.counts.any()


def test_a_touch_too_light_for_a_tap_is_the_cause_of_a_step():
    pad = resting()
    assert pad.blocks(6, of_z(taxel=6, own=-200)) == [False] * 5 + [True]
    expected = (
        "rest level 200 counts below the one before on z (taxel 6) after a touch too light for a tap: "
        "free the pad and zero again"
    )
    assert pad.tracker.note == pad.event == expected
    assert not pad.event and pad.step == -200


@pytest.mark.parametrize("sign", [1, -1])
def test_a_taxel_has_its_share_of_the_common_rate_and_creeps(sign):
    """By hand: of 20 counts/s a quarter of the way each half second, less the noise, times the share, and the creep."""
    pad = resting()
    pad.block(of_z(own=9 * sign))
    pad.block(of_z(10 * sign, own=9 * sign))
    creep, first, second = 0.05 * 0.5, 0.5 * (0.65 * 4.8 + 0.05), 0.5 * (0.65 * 8.55 + 0.05)
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(sign * creep, abs=1e-4)
    pad.block(of_z(20 * sign, own=9 * sign))
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(sign * (10 + creep + first), abs=1e-3)
    pad.block(of_z(20 * sign, own=9 * sign))
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(sign * (20 + creep + first + second), abs=1e-3)
    assert pad.tracker.summary.own_counts == pytest.approx(creep + first + second, abs=1e-3)
    np.testing.assert_allclose(pad.tracker.counts[2, 1:], 20 * sign, atol=1e-4)
    before = pad.tracker.counts[2, 0, 0]
    pad.push(of_z(20 * sign, own=9 * sign), after_ns=6_000_000_000)
    pad.blocks(7, of_z(20 * sign, own=9 * sign))
    assert pad.tracker.counts[2, 0, 0] - before == pytest.approx(sign * creep, abs=1e-4), "the rate is forgotten"


def test_where_scans_are_rare_a_block_lasts_longer():
    pad, ahead = resting(), of_z(8, own=9)
    every = partial(pad.block, ahead, after_ns=500_000_000)
    assert [every(), every()] == [True, True]
    assert pad.tracker.counts[2, 3, 3] == pytest.approx(8, abs=1e-4)
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(8 + 4 * (0.65 * 1.8 + 0.05), abs=1e-3)


def test_scans_closer_than_the_sample_period_are_left_out():
    pad = Blocks()
    for block in range(7):
        answers = [pad.push(0 if number % 2 else 900, after_ns=12_500_000) for number in range(1, 42)]
        assert answers == [False] * 40 + [block > 4]
    assert not pad.tracker.counts.any() and pad.step == 0


def test_a_block_is_the_middle_half_of_its_scans():
    pad = resting()
    assert pad.block(400, 0, -800, of_z(taxel=2, own=4)) is True
    pad.block()
    np.testing.assert_allclose(pad.tracker.counts, of_z(taxel=2, own=0.025), atol=1e-4)


@pytest.mark.parametrize(("gap_ns", "goes_on"), [(0, True), (5_000_000_000, True), (5_000_000_001, False), (-1, False)])
def test_a_gap_is_a_pause_or_time_that_goes_back(gap_ns, goes_on):
    pad = resting()
    assert pad.push(after_ns=gap_ns) is False
    answers = [pad.push() for _ in range(9)]
    assert any(answers) is goes_on


def test_scans_without_a_living_taxel_do_not_count():
    dead = NONE_DEAD.copy()
    dead[1, 2] = True
    pad = resting(dead=dead)
    assert pad.block(absent=dead) is True
    assert pad.block(absent=np.arange(16).reshape(4, 4) == 5) is False
    assert [pad.push() for _ in range(8)] == [False] * 7 + [True], "and none of those was kept"


@pytest.mark.parametrize(
    ("change", "still"),
    [
        (of_z(17), True),
        (of_z(-18), False),
        (of_z(own=7), True),
        (of_z(own=8), False),
        (of_z(10, own=13), True),
        (of_z(10, own=14), False),
        (of_z(-2, own=8), True),
        (of_z(-2, own=9), False),
    ],
)
def test_a_pad_is_still_while_blocks_differ_by_little(change, still):
    pad, level = Blocks(), np.zeros((3, 4, 4))
    answers = []
    for number in range(8):
        answers.append(pad.block(level + 100))
        level = level + change
        assert bool(pad.event) is (still and number == 4)
        if still and number == 4:
            break
    assert answers == ([False] * 4 + [True] if still else [False] * 8)


def test_a_restless_block_begins_the_wait_again():
    pad = Blocks()
    pad.blocks(4)
    assert pad.blocks(5, of_z(own=40)) == [False] * 4 + [True]


@pytest.mark.parametrize(("own", "kept", "told"), [(8, 0, False), (9, 9, False), (15, 15, False), (-16, -16, True)])
def test_a_step_of_one_taxel_is_kept_and_told_of(own, kept, told):
    pad = resting()
    assert pad.touched(of_z(taxel=7, own=own)) == [False] * 4 + [told]
    assert pad.step == kept
    assert pad.event == (pad.tracker.note or "")
    assert pad.tracker.note == (
        "rest level 16 counts below the one before on z (taxel 7) after a contact: free the pad and zero again"
        if told
        else None
    )
    before = pad.tracker.counts
    pad.blocks(2, of_z(taxel=7, own=own))
    assert pad.tracker.counts[2, 1, 3] - before[2, 1, 3] == pytest.approx(0 if kept else 0.025, abs=1e-4)


def test_a_silent_common_change_is_followed_and_not_kept():
    pad = resting()
    assert pad.touched(of_z(15, own=-9)) == SETTLED and pad.step == -9
    pad.blocks(3, of_z(15, own=-9))
    assert pad.tracker.counts[2, 3, 3] == pytest.approx(15, abs=1e-4)


@pytest.mark.parametrize(
    ("level", "kept"),
    [
        (of_z(50), 0),
        (of_z(51), 51),
        (of_z(8, own=12), 0),
        (of_z(8, own=13), 21),
        (of_z(7, own=11), 18),
        (on_axes(0, 0, 20) + 7 * of_z(own=1)[::-1], 0),
        (on_axes(0, 0, 20) + 8 * of_z(own=1)[::-1], 20),
    ],
)
def test_since_zeroing_a_pad_may_have_drifted_by_fifty_counts(level, kept):
    pad = Blocks()
    answers = pad.blocks(5, level)
    assert pad.step == kept and answers == [False] * 4 + [kept > 0]
    assert kept == 0 or "since it was zeroed" in pad.event


@pytest.mark.parametrize(("low", "kept"), [(7, 18.5), (8, 0)])
def test_half_of_a_step_is_not_yet_common(low, kept):
    """7.5 counts of all taxels, as a mean of sevens and eights, or 8."""
    pad = Blocks()
    for _ in range(5):
        pad.block(of_z(low, own=11), of_z(8, own=11))
    assert pad.step == kept


def test_all_taxels_alike_are_named_by_what_they_have_in_common():
    pad = resting()
    assert pad.touched(on_axes(3, -40, 30) + of_z(own=5))[-1] is True
    assert pad.event == (
        "rest level 40 counts below the one before on y (all taxels alike, as drift or another attitude) "
        "after a contact: free the pad and zero again"
    )


def test_a_known_step_is_told_of_again_where_it_has_changed():
    pad = resting()
    pad.touched(of_z(own=40))
    assert pad.event
    assert pad.touched(of_z(own=40)) == SETTLED and not pad.event, "the same"
    assert pad.touched(of_z(own=55))[-1] is True and not pad.event, "another note, and no event"
    assert pad.touched(of_z(own=71))[-1] is True and pad.event == pad.tracker.note
    assert pad.touched()[-1] is True and pad.event == "rest level is back where it was"
    assert pad.tracker.note is None and pad.step == 0 and not pad.event
    assert pad.touched() == SETTLED and not pad.event


def test_a_silent_step_that_grows_is_told_of():
    pad = resting()
    assert pad.touched(of_z(own=12)) == SETTLED
    assert pad.touched(of_z(own=20))[-1] is True and "rest level 20 counts above" in pad.event


def test_a_change_of_dead_taxels_and_a_gap_are_causes():
    for how, gap_ns, cause in [
        ("dead", PERIOD_NS, "after a taxel was out"),
        ("away", 6_000_000_000, "after a gap"),
        ("forgotten", PERIOD_NS, "after a gap"),
    ]:
        pad = resting()
        if how == "dead":
            pad.dead = NONE_DEAD.copy()
        if how == "forgotten":
            pad.tracker.forget()
        pad.push(of_z(own=40), after_ns=gap_ns)
        pad.blocks(6, of_z(own=40))
        assert cause in pad.event


@pytest.mark.parametrize(("voting", "followed"), [((0, 0, 0, 4), True), ((0, 0, 0, 5), False)])
def test_four_taxels_without_a_step_tell_what_is_common(voting, followed):
    step = np.zeros((3, 16))
    step[2] = [-40] * 6 + list(voting) + [40] * 6
    pad = resting()
    pad.touched(step.reshape(3, 4, 4))
    drift, behind = step.copy(), 0.5 * 0.65 * 2  # three counts/s by now, of which one is not shared
    drift[2, 6:10] += 6
    pad.blocks(2, drift.reshape(3, 4, 4))
    np.testing.assert_allclose(pad.tracker.counts[2].ravel()[[0, 15]], 6 - behind if followed else 0, atol=1e-4)
    if not followed:
        np.testing.assert_allclose(pad.tracker.counts, 0, atol=1e-4)  # beside a step no taxel creeps on its own


def test_beside_a_step_only_drift_that_is_faster_is_shared():
    """By hand, as above: of 5 counts/s the first count is not shared, and there is no creep."""
    pad, step = resting(), of_z(taxel=5, own=40)
    pad.touched(step)
    pad.blocks(2, step + of_z(10, own=9))
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(10 + 0.5 * 0.65 * 4, abs=1e-3)
    assert pad.tracker.counts[2, 1, 1] == pytest.approx(10, abs=1e-3)


@pytest.mark.parametrize("dead_taxels", [1, 9, 16])
def test_dead_taxels_do_not_tell_what_is_common(dead_taxels):
    dead = np.arange(16).reshape(4, 4) < dead_taxels
    pad = resting(dead=dead)
    pad.blocks(3, np.where(dead, 9000, of_z(6)))
    assert abs(pad.tracker.counts[2][~dead] - 6).max(initial=0) < 1e-4
    assert dead_taxels < 16 or not pad.tracker.counts.any()
    assert pad.step == 0 and not pad.event


def test_a_taxel_that_was_not_zeroed_is_none_that_lives():
    counts = REST.astype(np.float32)
    counts[2, 2, 2] = np.nan
    dead = NONE_DEAD.copy()
    dead[0, 0] = True
    pad = resting(baseline=Baseline.of("4", counts, 1000.0, 100, "file"), dead=dead)
    assert pad.touched(np.where(dead, 9000, of_z(taxel=1, own=20)))[-1] is True and pad.step == 20
    pad.blocks(2, np.where(dead, 9000, of_z(4, taxel=1, own=20)))
    np.testing.assert_allclose(pad.tracker.counts[2], 4, atol=1e-4)
