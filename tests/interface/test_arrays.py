"""Arrays to patterns in one call, results of two fingers in pairs, and objects that print in a line."""

import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from cli_samples import write_recording
from edge_samples import BASELINE, REST, FakeModel, make_scan

from edge import api
from edge.api import Baseline, RecordingError, Stream, UsageError, infer, paired

PRESSES = [0] * 5 + [3000] * 5 + [0] * 5
COUNTS = np.stack([make_scan(number, press_counts=press, noise=3).counts for number, press in enumerate(PRESSES)])


def test_an_array_has_the_results_of_a_recording_of_it(tmp_path):
    results = infer(FakeModel(), COUNTS, BASELINE)
    with api.open_recording(write_recording(tmp_path / "taps.npz", PRESSES)) as source:
        recorded = list(Stream(source, api.open_runtime(FakeModel(), source, baselines={"4": BASELINE})))
    assert [result.state for result in results] == [result.state for result in recorded]
    assert [result.scan.time_ns for result in results] == [10_000_000 * number for number in range(len(PRESSES))]
    for result, other in zip(results, recorded, strict=True):
        np.testing.assert_array_equal(result.zeroed, other.zeroed)
        np.testing.assert_array_equal(result.pattern, other.pattern)  # or there is none
    assert results[7].pattern.shape == (40, 40)


def test_one_scan_and_counts_of_the_free_pad_are_enough():
    (result,) = infer(FakeModel(), COUNTS[7], np.stack([REST - 1, REST, REST + 1]).astype(np.uint16))
    assert result.pattern is not None and result.force_counts == pytest.approx(3000, abs=60)
    (free,) = infer(FakeModel(), COUNTS[0], REST)
    assert free.state == "idle" and free.pattern is None


VENDORS = np.moveaxis(COUNTS, 1, -1).reshape(-1, 16, 3)


@pytest.mark.parametrize(
    ("counts", "baseline"),
    [
        (COUNTS.astype(float), COUNTS[:5].mean(axis=0)),
        (VENDORS, VENDORS[:5].mean(axis=0)),
        (VENDORS.reshape(-1, 48).astype(np.float32), VENDORS.reshape(-1, 48)[:5]),
    ],
)
def test_arrays_of_floats_and_in_the_vendors_order_are_taken(counts, baseline):
    expected, results = infer(FakeModel(), COUNTS, REST), infer(FakeModel(), counts, baseline)
    assert [result.state for result in results] == [result.state for result in expected]
    for result, other in zip(results, expected, strict=True):
        np.testing.assert_array_equal(result.scan.counts, other.scan.counts)
        np.testing.assert_allclose(result.zeroed, other.zeroed, atol=5)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"counts": COUNTS + 0.5}, "counts are not whole numbers, expected raw counts: no means"),
        ({"counts": COUNTS.astype(str)}, "counts are of type <U.*, expected whole numbers: raw counts, nothing sub"),
        ({"counts": COUNTS.astype(np.float16)}, "counts are of type float16, expected whole numbers"),
        ({"baseline": np.full((3, 4, 4), np.nan)}, "counts of the baseline hold NaN or infinity, expected raw counts"),
        ({"counts": COUNTS[:, :2]}, r"counts have shape \(15, 2, 4, 4\), expected \(3, rows, cols\) or \(n, 3, rows"),
        ({"counts": COUNTS[:0]}, r"counts have shape \(0, 3, 4, 4\), expected"),
        ({"counts": COUNTS - 70_000}, "counts are -.*, expected -1 to 65535"),
        ({"counts": np.zeros((3, 9, 9), dtype=int)}, "counts have 81 taxels, expected at most 64"),
        ({"baseline": np.full((3, 4, 4), -1)}, "counts of the baseline are -1 to -1, expected 0 to 65535"),
        ({"baseline": REST[:, :2]}, r"baseline of sensor array has shape \(3, 2, 4\), expected \(3, 4, 4\)"),
        ({"rate_hz": 0}, "rate_hz is 0, expected a positive number"),
        ({"counts": np.ma.masked_greater(COUNTS, 37_500)}, "counts are masked in part, .*: -1 where there is no"),
        ({"counts": [[1], [2, 3]]}, "counts are no array of numbers: "),
    ],
)
def test_an_array_of_something_else_is_refused(wrong, words):
    with pytest.raises(UsageError, match=words):
        infer(FakeModel(), **({"counts": COUNTS, "baseline": REST} | wrong))


@pytest.mark.parametrize(
    "counts", [COUNTS[0], COUNTS[:0], COUNTS - 70_000, COUNTS * np.nan, COUNTS > 0, np.ma.masked_greater(COUNTS, 1)]
)
def test_a_baseline_is_made_of_raw_counts_that_all_count(counts):
    with pytest.raises(api.BaselineRefusedError, match=r"^counts of sensor 4: .*expected"):
        Baseline.from_counts("4", counts, 99.0)


@pytest.mark.parametrize("axes", [[2], [0, 1]])
def test_a_taxel_that_is_absent_on_some_axes_is_refused(axes):
    """Where x alone tells whether it is there, a summed z of nothing reads as a free pad."""
    counts = COUNTS[7].copy()
    counts[axes, 1, 1] = -1
    with pytest.raises(RecordingError, match=r"^counts: a taxel absent on some axes, expected all of"):
        infer(FakeModel(), counts, REST)


class Timed:
    """Result as far as pairing looks at it."""

    def __init__(self, sensor, time_ms):
        self.scan = SimpleNamespace(sensor=sensor, on_bus_ns=int(time_ms * 1e6))


def results_at(**times_ms):
    made = [Timed(name, time_ms) for name, times in times_ms.items() for time_ms in times]
    return sorted(made, key=lambda result: result.scan.on_bus_ns)


def pairs_ms(results, *sensors, **settings):
    return [tuple(one.scan.on_bus_ns / 1e6 for one in pair) for pair in paired(iter(results), sensors, **settings)]


@pytest.mark.parametrize(
    ("times_ms", "settings", "expected"),
    [
        (([0, 10, 20], [3, 13, 23]), {}, [(0, 3), (10, 13), (20, 23)]),
        (([0, 10, 20], [8, 18, 28]), {}, [(10, 8), (20, 18)]),  # the nearer neighbour, though it came first
        (([0, 10, 20, 30], [21]), {}, [(20, 21)]),
        (([0, 10, 20, 30, 40], [1, 41]), {}, [(0, 1), (40, 41)]),
        (([0, 10], [40, 50]), {}, []),
        (([0], []), {}, []),
        (([0, 10, 20], [2, 12, 22], [9, 19, 29]), {}, [(10, 12, 9), (20, 22, 19)]),
        (([0, 10, 20], [2, 12, 22], [9, 19, 29]), {"apart_s": 0.001}, []),
    ],
)
def test_results_are_paired_with_the_nearest(times_ms, settings, expected):
    fingers = dict(zip("abc", times_ms, strict=False))
    assert pairs_ms(results_at(**fingers, other=[2]), *fingers, **settings) == expected
    swapped = [times[::-1] for times in expected]
    assert pairs_ms(results_at(**fingers), *reversed(fingers), **settings) == swapped


@pytest.mark.parametrize("left", [[0, 10, 20], [0, 50]])
def test_a_pair_comes_as_soon_as_nothing_can_better_it(left):
    results = results_at(left=left, right=[3, 13, 23])
    taken = []

    def follow():
        for result in results:
            taken.append(result)
            yield result

    first = next(paired(follow(), ("left", "right")))
    assert [result.scan.on_bus_ns for result in first] == [0, 3_000_000] and len(taken) == 3


def test_results_that_come_late_and_together_are_still_paired():
    left, right = range(0, 2000, 10), range(3, 2000, 10)
    results = [*results_at(left=left), *results_at(right=right)]
    assert pairs_ms(results, "left", "right") == list(zip(left, right, strict=True))


def test_a_silent_finger_lets_nothing_pile_up():
    alive, most = weakref.WeakSet(), 0

    def alone():
        nonlocal most
        for time_ms in range(0, 30_000, 10):
            (result,) = results_at(left=[time_ms])
            alive.add(result)
            most = max(most, len(alive))
            yield result

    with pytest.raises(UsageError, match="no result of sensor 'right': there are those of left"):
        list(paired(alone(), ("left", "right")))
    assert 0 < most < 1100


@pytest.mark.parametrize(
    ("left", "right", "expected"),  # contact, force in newtons, force in counts
    [
        ((True, None, 4400.0), (True, None, 3600.0), 0.2),
        ((True, 3.6, 4400.0), (True, 4.4, 4400.0), -0.2),
        ((True, 3.6, 4400.0), (True, None, 3600.0), 0.2),  # no scale of its own: counts of both
        ((True, 4.0, 4000.0), (False, 0.0, 10.0), None),
        ((None, 4.0, 4000.0), (True, 4.0, 4000.0), None),  # the baseline is in doubt
        ((True, -1.0, -1000.0), (True, 4.0, 4000.0), None),
    ],
)
def test_a_grip_presses_both_pads_alike(left, right, expected):
    results = results_at(left=[0], right=[1])
    for result, (contact, force_n, force_counts) in zip(results, (left, right), strict=True):
        result.contact, result.force_n, result.force_counts = contact, force_n, force_counts
    (pair,) = paired(iter(results), ["left", "right"])
    assert pair.imbalance == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize("sensors", ["left", ["left"], ["left", "left"]])
def test_a_pair_is_of_two_sensors(sensors):
    with pytest.raises(UsageError, match="expected two or more different names"):
        paired([], sensors)
