from contextlib import nullcontext

import numpy as np
import pytest
from baseline_samples import REST, made
from edge_samples import make_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.zeroing.baseline import (
    LOAD_LIMIT_COUNTS,
    Baseline,
    BaselineEstimator,
    deformation,
)

NOISE_COUNTS = np.array([2.6, 2.6, 3.9])[:, None, None]


def still(count: int, seed: int = 0, rest: np.ndarray = REST) -> np.ndarray:
    """Scans of a pad that nothing moves: (count, 3, 4, 4)."""
    noise = np.random.default_rng(seed).normal(0, 1, (count, 3, 4, 4)) * NOISE_COUNTS
    return np.rint(rest + noise).astype(np.int32) % 65536


def scans_of(counts: np.ndarray, sensor: str = "4") -> list[Scan]:
    series = ScanSeries(sensor, USPA44)
    return [series.close(np.array(one, dtype=np.int32), n) for n, one in enumerate(counts)]


def push_all(estimator: BaselineEstimator, counts: np.ndarray) -> list[Baseline | None]:
    return [estimator.push(scan) for scan in scans_of(counts)]


def test_a_still_pad_gives_its_median():
    estimator = BaselineEstimator(clock=lambda: 1234.5)
    counts = still(100)
    *before, baseline = push_all(estimator, counts)
    assert before == [None] * 99 and baseline is not None
    assert (baseline.counts == np.median(counts, axis=0)).all()
    assert baseline.counts.dtype == np.float32 and not baseline.counts.flags.writeable
    assert (baseline.sensor, baseline.scans, baseline.origin, baseline.created_unix_s) == ("4", 100, "start-up", 1234.5)
    assert baseline.age_s(1300.0) == 65.5
    assert estimator.scans == 0


def test_the_median_is_not_a_hundredth_too_high():
    """A loop that sums 101 scans and divides by 100 puts z 370 counts too high."""
    baseline = push_all(BaselineEstimator(), still(100))[-1]
    assert baseline is not None
    assert abs(baseline.counts - REST).max() < 2.5


def test_noise_of_any_known_pad_is_accepted():
    for seed in range(40):
        assert push_all(BaselineEstimator(), still(100, seed))[-1] is not None, seed
    loudest = np.rint(REST + np.random.default_rng(5).normal(0, 1, (100, 3, 4, 4)) * [[[2.8]], [[2.8]], [[4.7]]])
    assert push_all(BaselineEstimator(), loudest)[-1] is not None


def test_single_readings_far_off_are_no_motion():
    counts = still(100)
    counts[40:42, :, 3, 3] -= [0, 117, 290]
    baseline = push_all(BaselineEstimator(), counts)[-1]
    assert baseline is not None and abs(baseline.counts - REST).max() < 2.5


def test_a_press_while_zeroing_is_refused_and_zeroing_starts_over():
    estimator = BaselineEstimator()
    counts = still(100)
    counts[70:, 2, 1, 2] += 40
    with pytest.raises(
        BaselineRefusedError, match=r"taxel \(1, 2\) z moved by \d+ counts .* at most 25 .* still and free"
    ):
        push_all(estimator, counts)
    assert estimator.scans == 0
    assert push_all(estimator, still(100, 1))[-1] is not None


def test_slow_creep_is_refused():
    counts = still(100)
    counts[:, 2, 0, 3] += np.linspace(0, 22, 100).astype(np.int32)
    with pytest.raises(BaselineRefusedError, match=r"taxel \(0, 3\) z crept by 1\d counts .* at most 10"):
        push_all(BaselineEstimator(), counts)
    counts = still(100)
    counts[:, 2, 0, 3] -= np.linspace(0, 22, 100).astype(np.int32)
    with pytest.raises(BaselineRefusedError, match="crept"):
        push_all(BaselineEstimator(), counts)


def test_creep_is_told_of_the_taxel_that_creeps():
    counts = np.broadcast_to(REST, (100, 3, 4, 4)).copy()
    counts[:, 2, 0, 3] += np.linspace(0, 18, 100).astype(np.int64)
    counts[:, 0, 3, 3] += 3 * (np.arange(100) % 5)  # the widest spread for its axis, but no creep
    with pytest.raises(BaselineRefusedError, match=r"taxel \(0, 3\) z crept"):
        push_all(BaselineEstimator(), counts)


def test_a_load_is_seen_against_a_reference():
    reference = made()
    warm = still(100, rest=REST + np.array([0, 0, 120])[:, None, None])
    assert push_all(BaselineEstimator(reference=reference), warm)[-1] is not None
    pressed = still(100)
    pressed[:, 2, 2, 1] += 350
    with pytest.raises(BaselineRefusedError, match=rf"\(2, 1\) z is 35\d counts above the baseline {reference.id}"):
        push_all(BaselineEstimator(reference=reference), pressed)
    # A documented limit: without a reference such a load is zeroed away.
    assert push_all(BaselineEstimator(), pressed)[-1] is not None


def test_the_load_limit_is_for_z_above_the_reference():
    def zeroed(axis: int, offset: float) -> Baseline | None:
        counts = np.broadcast_to(REST, (100, 3, 4, 4)).astype(np.int32)
        counts[:, 0, 0, 0] += np.arange(100) % 2
        counts[:, axis, 1, 1] += int(offset)
        return push_all(BaselineEstimator(reference=made()), counts)[-1]

    assert zeroed(2, LOAD_LIMIT_COUNTS) is not None
    assert zeroed(2, -3 * LOAD_LIMIT_COUNTS) is not None
    assert zeroed(0, 3 * LOAD_LIMIT_COUNTS) is not None
    with pytest.raises(BaselineRefusedError):
        zeroed(2, LOAD_LIMIT_COUNTS + 1)


def test_torn_and_repeated_scans_are_no_samples():
    estimator = BaselineEstimator(min_scans=3)
    counts = np.stack([REST, REST + 1, REST + 2])
    gap = counts[1].copy()
    gap[:, 0, 0] = ABSENT
    scans = scans_of(np.stack([counts[0], gap, counts[1], counts[1], counts[1], counts[2]]))
    assert [estimator.push(scan) is not None for scan in scans] == [False] * 5 + [True]


def test_a_scan_that_is_renewed_in_part_is_a_sample():
    counts = np.stack([REST, REST, REST])
    counts[1, 0, 0, 0] += 1
    counts[2, 0, 0, 0] += 2
    assert push_all(BaselineEstimator(min_scans=3), counts)[-1] is not None


@pytest.mark.parametrize("rest", [0, 443, 65_535, 32_768])
def test_zeroing_and_deformation_go_round_the_circle(rest):
    level = np.full((3, 4, 4), rest)
    baseline = push_all(BaselineEstimator(), still(100, rest=level))[-1]
    assert baseline is not None
    off = (baseline.counts - rest + 32_768) % 65_536 - 32_768
    assert abs(off).max() < 2.5
    assert baseline.counts.min() >= 0 and baseline.counts.max() < 65_536
    for pressed in (-500, -1, 0, 1, 500, 13_460):
        seen = deformation((level + pressed) % 65_536, baseline)
        assert seen.dtype == np.float32
        assert abs(seen - pressed).max() < 2.5, pressed


@given(st.integers(0, 65_535), st.integers(-32_767, 32_767))
@settings(deadline=None)
def test_deformation_is_the_short_way_round(rest, pressed):
    scan = np.full((3, 4, 4), (rest + pressed) % 65_536, dtype=np.int32)
    assert (deformation(scan, made(np.full((3, 4, 4), rest))) == pressed).all()


def test_deformation_keeps_halves_and_leaves_gaps_open():
    scan = REST.astype(np.int32)
    scan[:, 1, 3] = ABSENT
    seen = deformation(scan, made(REST - 0.5))
    assert np.isnan(seen[:, 1, 3]).all()
    seen[:, 1, 3] = 0.5
    assert (seen == 0.5).all()


def test_from_counts_takes_what_it_is_given():
    counts = still(20)
    counts[15:, 2] += 4000
    baseline = Baseline.from_counts("6", counts, 99.0)
    assert (baseline.counts == np.median(counts, axis=0)).all()
    assert (baseline.sensor, baseline.scans, baseline.created_unix_s) == ("6", 20, 99.0)
    for bad in (counts[:0], np.where(counts == counts[0, 0, 0, 0], ABSENT, counts)):
        with pytest.raises(ValueError, match="whole scans"):
            Baseline.from_counts("6", bad, 99.0)


def test_a_pad_that_has_drifted_rests_higher_by_that_and_round_the_circle():
    baseline = made(np.full_like(REST, 65_530))
    moved = baseline.moved(np.full(REST.shape, 10.5, dtype=np.float32))
    assert (moved.counts == 4.5).all() and moved.id == baseline.id
    with pytest.raises(ValueError, match="read-only"):
        moved.counts[...] = 0


def test_too_few_scans_for_a_third_are_refused():
    with pytest.raises(ValueError, match="at least 3"):
        BaselineEstimator(min_scans=2)


def test_a_taxel_given_up_has_no_rest_until_the_next_zeroing():
    counts = still(200)
    counts[:, :, 1, 1] = ABSENT
    counts[:20, :, 2, 2] = ABSENT
    one, two = np.zeros((2, 4, 4), dtype=bool)
    one[1, 1] = two[1, 1] = two[2, 2] = True
    estimator = BaselineEstimator()
    found = [estimator.push(scan, two if number < 20 else one) for number, scan in enumerate(scans_of(counts))]
    assert [number for number, baseline in enumerate(found) if baseline is not None] == [99, 199]
    for baseline, given_up in ((found[99], two), (found[199], one)):
        assert baseline is not None
        np.testing.assert_array_equal(np.isnan(baseline.counts), np.broadcast_to(given_up, (3, 4, 4)))
        np.testing.assert_allclose(baseline.counts[:, ~given_up], REST[:, ~given_up], atol=2)


def test_a_taxel_that_was_not_zeroed_does_not_keep_others_from_wrapping_round():
    counts = np.full((3, 4, 4), 65_500, dtype=np.float32)
    counts[:, 0, 0] = np.nan
    scan = np.full((3, 4, 4), 100, dtype=np.int32)
    zeroed = deformation(scan, Baseline.of("4", counts, 0.0, 100, "file"))
    assert np.isnan(zeroed[:, 0, 0]).all() and (zeroed[:, 1:, :] == 136).all()


def test_a_taxel_that_comes_and_goes_does_not_put_zeroing_off_for_ever():
    estimator = BaselineEstimator()
    silent = np.zeros((4, 4), dtype=bool)
    silent[0, 0] = True
    for number in range(1000):
        gone = number // 60 % 2 == 1
        scan = make_scan(number, absent=(0,) if gone else (), noise=3)
        baseline = estimator.push(scan, silent if gone else None)
        if baseline is not None:
            break
    assert baseline is not None and number < 110
    assert np.isnan(baseline.counts[:, 0, 0]).all() and np.isfinite(baseline.counts[:, 1:, :]).all()


@pytest.mark.parametrize("pressed", [False, True])
def test_a_load_is_refused_also_where_a_taxel_has_no_rest(pressed):
    reference = Baseline.of("4", REST.astype(np.float32), 0.0, 100, "file")
    silent = np.zeros((4, 4), dtype=bool)
    silent[0, 0] = True
    estimator = BaselineEstimator(reference=reference)
    counts = still(100)
    counts[:, :, 0, 0] = ABSENT
    counts[:, 2, 1, 1] += 1000 * pressed
    with pytest.raises(BaselineRefusedError, match="above the baseline") if pressed else nullcontext():
        found = [estimator.push(scan, silent) for scan in scans_of(counts)]
        assert found[-1] is not None and np.isnan(found[-1].counts[:, 0, 0]).all()
