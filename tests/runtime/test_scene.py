"""Needs of a scan: nothing, the pattern before, or one from the taps that matter."""

import numpy as np
from edge_samples import BASELINE, FakeModel, inferred, make_contract, make_scan

from edge.perception.change_gate import CHANGED_COUNTS, NOISE_COUNTS, LastReading
from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Runtime

SHAPE = (3, 4, 4)


def reading(seed=0, size=2000.0):
    return (size * np.random.default_rng(seed).random(SHAPE)).astype(np.float32)


def noise(seed):
    return NOISE_COUNTS * np.random.default_rng([seed, 1]).standard_normal(SHAPE, dtype=np.float32)


class TestLastReading:
    def test_noise_is_no_change(self):
        last, still = LastReading(SHAPE), reading()
        last.keep(still + noise(0), "model")
        assert sum(last.holds(still + noise(seed), "model") for seed in range(1, 2001)) >= 1990

    def test_one_taxel_that_changed_is_seen(self):
        last, before = LastReading(SHAPE), reading()
        last.keep(before, "model")
        for place in np.ndindex(SHAPE):
            after = before.copy()
            after[place] -= CHANGED_COUNTS + 1
            assert not last.holds(after, "model")

    def test_a_little_everywhere_is_seen(self):
        last, before = LastReading(SHAPE), reading()
        last.keep(before, "model")
        assert last.holds(before + np.float32(3.9), "model")
        assert not last.holds(before + np.float32(4.0), "model")

    def test_what_creeps_is_followed_however_slowly(self):
        last, counts = LastReading(SHAPE), reading()
        last.keep(counts, "model")
        made = 0
        for _ in range(400):
            counts = counts + np.float32(0.1)
            if not last.holds(counts, "model"):
                last.keep(counts, "model")
                made += 1
        assert made == 10

    def test_another_maker_or_none_makes_it_anew(self):
        last, before = LastReading(SHAPE), reading()
        assert not last.holds(before, "model")
        last.keep(before, ("model", 0, 1))
        assert last.holds(before, ("model", 0, 1))
        assert not last.holds(before, ("model", 1, 1))
        last.keep(before, None)
        assert not last.holds(before, ("model", 0, 1))


def make_runtime(contract=None, **settings):
    model = FakeModel(contract or make_contract(interval_factor=1.6))
    return Runtime(model, source="device", baselines={"4": BASELINE}, **settings), model


def test_a_still_grip_is_inferred_once_and_says_whose_pattern_it_is():
    runtime, model = make_runtime()
    results = [runtime.push(make_scan(number, press_counts=3000, noise=3)) for number in range(15)]
    assert len(model.windows) == 1
    assert [result.reused_from for result in results] == [None] + [0] * 14
    for result in results[1:]:
        assert result.state == "contact" and result.run_time_us is None and result.pattern is results[0].pattern
        assert result.interval_mm == results[0].interval_mm and result.area_mm2 == results[0].area_mm2
    moved = runtime.push(make_scan(15, press_counts=3020))
    assert moved.reused_from is None and moved.run_time_us is not None and len(model.windows) == 2


def test_every_scan_is_inferred_where_that_is_asked_for():
    runtime, model = make_runtime(options=RuntimeOptions(every_scan=True))
    assert all(runtime.push(make_scan(number, press_counts=3000)).reused_from is None for number in range(5))
    assert len(model.windows) == 5


def test_the_same_touch_in_the_next_tap_is_inferred_anew():
    runtime, model = make_runtime()
    for number, press in enumerate((3000, 3000, 0, 3000, 3000)):
        last = runtime.push(make_scan(number, press_counts=press))
    assert len(model.windows) == 2 and last.reused_from == 3 and last.taps_used == 2


def test_a_reset_in_a_tap_is_inferred_anew():
    runtime, model = make_runtime()
    runtime.push(make_scan(0, press_counts=3000))
    runtime.reset()
    assert runtime.push(make_scan(1, press_counts=3000)).reused_from is None and len(model.windows) == 2


def taps_used(runtime, presses):
    """Return the taps used for one scan in each of a row of taps pressed so hard."""
    used, number = [], 0
    for press in presses:
        for counts in (press - 50, press, 0):
            result = runtime.push(make_scan(number, press_counts=counts))
            used += [result.taps_used] * (counts == press)
            number += 1
    return used


def test_every_tap_that_is_there_is_used():
    told = {"doubt": [0.1, 1.0], "error": [0.1, 0.2], "gain": [0.0, 0.0]}
    contract = make_contract(interval_factor=1.6, confidence={"1": told, "2": told, "3": told})
    runtime, model = make_runtime(contract)
    assert taps_used(runtime, (2000, 3000, 4000)) == [1, 2, 3]
    for used, window in zip(np.repeat([1, 2, 3], 2), model.windows, strict=True):
        assert window[:used].any(axis=(1, 2, 3)).all() and not window[used:].any()


def test_two_sensors_are_inferred_in_one_call_in_the_order_they_came():
    calls = []

    class Together(FakeModel):
        def run_together(self, windows, pads=None):
            calls.append(len(windows))
            return super().run_together(windows, pads)

    model = Together(make_contract(interval_factor=1.6))
    baselines = dict.fromkeys(("4", "6"), BASELINE)
    runtime = Runtime(model, source="device", baselines=baselines)
    alone = {
        name: Runtime(FakeModel(make_contract(interval_factor=1.6)), source="device", baselines=baselines).push(
            make_scan(1, sensor=name, press_counts=press)
        )
        for name, press in (("4", 3000), ("6", 5000))
    }
    pressed = [make_scan(1, sensor=name, press_counts=press) for name, press in (("4", 3000), ("6", 5000))]
    results = inferred(runtime, pressed)
    assert calls == [2] and [result.scan for result in results] == pressed
    for result in results:
        np.testing.assert_array_equal(result.pattern, alone[result.scan.sensor].pattern)
        np.testing.assert_array_equal(result.deviation, alone[result.scan.sensor].deviation)
