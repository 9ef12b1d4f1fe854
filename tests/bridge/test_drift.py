"""Drift of a pad is followed while nothing touches, nothing that touches is followed, and what is told of it."""

import numpy as np
import pytest
from edge_samples import BASELINE, REST
from numpy.typing import ArrayLike

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from firmware_bridge.zeroing.drift_tracker import Drift, DriftTracker

PERIOD_NS = 25_000_000  # enough scans for every block, no more than they take
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


def test_a_pad_that_warms_up_stays_at_zero():
    tracker, told, left = played(400, lambda t: -120 * (1 - np.exp(-t / 80)) * AXES * TAXELS)
    assert abs(left.mean(axis=(2, 3))).max() < 4, "while it warms"
    assert abs(left[-1]).max() < 3, "every taxel, in the end"
    assert abs(left[:, 2].sum(axis=(1, 2))).max() < 80
    assert told == [] and tracker.summary.common_counts[2] == pytest.approx(-120, rel=0.1)


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
    assert abs(left[-1]).max() < 5 and baseline.moved(tracker.counts).counts.max() <= 65_536


# Block by block, on a pad without noise.


BLOCK_PERIOD_NS = 62_500_000  # eight scans last half a second: the shortest block of the fewest scans
SETTLED = [False] * 5


class Blocks:
    def __init__(self, baseline=BASELINE, dead=NONE_DEAD):
        self.tracker = DriftTracker(baseline)
        self.time_ns = 7_000_000_000
        self.contact, self.dead = False, dead
        self._rest = np.nan_to_num(baseline.counts).astype(np.int32)
        self._series = ScanSeries("4", USPA44)
        self.push()

    def push(self, offset: ArrayLike = 0, after_ns=BLOCK_PERIOD_NS, absent=None):
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


def test_after_five_blocks_it_is_followed_one_block_late():
    pad = Blocks()
    assert pad.tracker.summary == Drift((0, 0, 0), 0, 0) and not pad.tracker.counts.any()
    assert pad.blocks(7) == [*SETTLED, True, True] and pad.tracker.note is None and not pad.event
    assert pad.block(on_axes(2, -3, 6)) is True and not pad.tracker.counts.any()
    assert pad.block(on_axes(2, -3, 6)) is True
    np.testing.assert_allclose(pad.tracker.counts, on_axes(2, -3, 6), atol=1e-5)
    assert pad.tracker.summary.common_counts == pytest.approx((2, -3, 6), abs=1e-5)
    assert pad.tracker.summary.own_counts == pytest.approx(0, abs=1e-5) and pad.step == 0


CREEP = 0.5 * 0.05


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("levels", "common", "own"),
    [
        # 20 counts a second of common drift.
        ([of_z(25)] * 3, 20, 0),
        ([of_z(25)] * 5, 25, 0),
        # What was followed of a touch is dropped.
        ([of_z(6), of_z(6, own=200), *[of_z()] * 6], 0, 0),
        # By hand: of 20 counts/s a quarter of the way each half second, less the noise, times the share, and the creep.
        ([of_z(own=9), of_z(10, own=9)], 0, CREEP),
        (
            [of_z(own=9), of_z(10, own=9), *[of_z(20, own=9)] * 2],
            20,
            CREEP + 0.5 * (0.65 * 4.8 + 0.05) + 0.5 * (0.65 * 8.55 + 0.05),
        ),
    ],
)
def test_what_is_followed_at_rest(sign, levels, common, own):
    pad = resting()
    for level in levels:
        pad.block(sign * level)
    assert pad.tracker.counts[2, 0, 0] == pytest.approx(sign * (common + own), abs=1e-3)
    np.testing.assert_allclose(pad.tracker.counts[2, 1:], sign * common, atol=1e-4)
    assert pad.tracker.summary.own_counts == pytest.approx(abs(own), abs=1e-3)


@pytest.mark.parametrize(
    ("ahead", "followed"),
    [
        (of_z(50), True),
        (of_z(51), False),
        (of_z(own=10), True),
        (of_z(own=11), False),
        (of_z(-20, own=22), True),
        (of_z(-20, own=24), False),
    ],
)
def test_what_is_ahead_is_followed_up_to_a_touch(ahead, followed):
    pad = resting()
    assert pad.block(ahead) is followed
    assert pad.blocks(6) == ([True] * 6 if followed else [*SETTLED, True])


def test_scans_without_a_living_taxel_do_not_count():
    dead = np.arange(16).reshape(4, 4) == 6
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
    ],
)
def test_a_pad_is_still_while_blocks_differ_by_little(change, still):
    pad = Blocks()
    assert [pad.block(100 + number * change) for number in range(5)] == [False] * 4 + [still]
    assert bool(pad.event) is still and (still or not any(pad.block(100 + number * change) for number in (5, 6, 7)))


@pytest.mark.parametrize(
    ("level", "step", "event"),
    [
        (of_z(taxel=7, own=8), 0, ""),
        (of_z(taxel=7, own=9), 9, ""),
        (of_z(taxel=7, own=15), 15, ""),
        (of_z(taxel=7, own=-16), -16, "16 counts below the one before on z (taxel 7)"),
        (of_z(15, taxel=7, own=-9), -9, ""),
        (on_axes(3, -40, 30) + of_z(own=5), -40, "40 counts below the one before on y (all taxels alike, as drift or"),
    ],
)
def test_a_step_over_a_contact_is_kept_and_told_of(level, step, event):
    """A common change that is not told of is followed, and a taxel's own beside a step does not creep."""
    pad = resting()
    assert pad.touched(level) == [False] * 4 + [bool(event)]
    assert pad.step == step
    attitude = " another attitude)" * event.endswith("or")
    told = f"rest level {event}{attitude}: free the pad and zero again" if event else None
    assert pad.tracker.note == told and pad.event == (told or "") and not pad.event
    before = pad.tracker.counts
    pad.blocks(4, level)
    assert pad.tracker.counts[2, 1, 3] - before[2, 1, 3] == pytest.approx(
        0 if event else level[2, 0, 0] + (0 if step else 3 * CREEP), abs=1e-4
    )


@pytest.mark.parametrize(
    ("level", "kept"),
    [
        (of_z(50), 0),
        (of_z(51), 51),
        (of_z(8, own=12), 0),
        (of_z(8, own=13), 21),
        (on_axes(0, 0, 20) + 7 * of_z(own=1)[::-1], 0),
        (on_axes(0, 0, 20) + 8 * of_z(own=1)[::-1], 20),
    ],
)
def test_since_zeroing_a_pad_may_have_drifted_by_fifty_counts(level, kept):
    pad = Blocks()
    answers = pad.blocks(5, level)
    assert pad.step == kept and answers == [False] * 4 + [kept > 0]


def test_a_known_step_is_told_of_again_where_it_has_changed():
    pad = resting()
    assert pad.touched(of_z(own=12)) == SETTLED, "too little to tell of"
    assert pad.touched(of_z(own=40))[-1] is True and "rest level 40 counts above" in pad.event
    assert pad.touched(of_z(own=40)) == SETTLED and not pad.event, "the same"
    assert pad.touched(of_z(own=55))[-1] is True and not pad.event, "another note, and no event"
    assert pad.touched(of_z(own=71))[-1] is True and pad.event == pad.tracker.note
    assert pad.touched()[-1] is True and pad.event == "rest level is back where it was"
    assert pad.tracker.note is None and pad.step == 0 and not pad.event
    assert pad.touched() == SETTLED and not pad.event


@pytest.mark.parametrize(
    ("how", "gap_ns"),
    [("dead", BLOCK_PERIOD_NS), ("away", 6_000_000_000), ("forgotten", BLOCK_PERIOD_NS), ("light", BLOCK_PERIOD_NS)],
)
def test_after_any_interruption_a_step_is_told(how, gap_ns):
    """Of all taxels alike, which is drift only while nothing has happened since zeroing."""
    pad = resting()
    if how == "dead":
        pad.dead = NONE_DEAD.copy()
    if how == "forgotten":
        pad.tracker.forget()
    if how == "light":
        pad.block(of_z(own=200))
    else:
        pad.push(of_z(-40), after_ns=gap_ns)
    pad.blocks(6, of_z(-40))
    assert "all taxels alike" in pad.event and pad.step == -40


@pytest.mark.parametrize(("voting", "followed"), [((0, 0, 0, 4), True), ((0, 0, 0, 5), False)])
def test_four_taxels_without_a_step_tell_what_is_common(voting, followed):
    step = np.zeros((3, 16))
    step[2] = [-40] * 6 + list(voting) + [40] * 6
    pad = resting()
    pad.touched(step.reshape(3, 4, 4))
    drift, behind = step.copy(), 0.5 * 0.65 * 2  # three counts/s by now, of which one is not shared
    drift[2, 6:10] += 6
    pad.blocks(2, drift.reshape(3, 4, 4))
    np.testing.assert_allclose(pad.tracker.counts[2].flat[[0, 15]], 6 - behind if followed else 0, atol=1e-4)
    assert followed or abs(pad.tracker.counts).max() < 1e-4, "beside a step no taxel creeps on its own"


def test_a_taxel_that_was_not_zeroed_is_none_that_lives():
    counts = REST.astype(np.float32)
    counts[2, 2, 2] = np.nan
    dead = np.arange(16).reshape(4, 4) == 0
    pad = resting(baseline=Baseline.of("4", counts, 1000.0, 100, "file"), dead=dead)
    assert pad.touched(np.where(dead, 9000, of_z(taxel=1, own=20)))[-1] is True and pad.step == 20
    pad.blocks(2, np.where(dead, 9000, of_z(4, taxel=1, own=20)))
    np.testing.assert_allclose(pad.tracker.counts[2], 4, atol=1e-4)
