import dataclasses
import itertools

import numpy as np
import pytest
from edge_samples import (
    BASELINE,
    REST,
    FakeModel,
    make_contract,
    make_scan,
    tiny_deviation,
    tiny_pattern,
    write_model,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime_samples import PRESS, make_runtime

from edge.errors import ModelError, UsageError, WindowError
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.contact_patch import touched, touched_patch
from edge.perception.result import mask_bits
from edge.perception.runtime import Runtime
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.zeroing.baseline import Baseline


def test_a_contact_gives_a_pattern_and_all_that_is_known():
    clock = iter([5_000, 25_500])
    runtime = make_runtime(clock_ns=lambda: next(clock), counts_per_newton=1200.0)
    scan = make_scan(3, press_counts=PRESS)
    result = runtime.push(scan)
    assert result.scan is scan
    assert (result.source, result.model, result.state) == ("device", "fake", "contact")
    assert result.contact is True and result.taps_used == 1
    expected = np.kron(np.eye(16)[5].reshape(4, 4) * PRESS / 1000, np.ones((10, 10)))
    np.testing.assert_allclose(result.pattern, expected)
    assert result.pattern_unit == "mm"
    assert result.force_counts == PRESS and result.force_n == 2.5
    assert result.run_time_us == 20.5
    assert result.area_mm2 == pytest.approx(4.7**2)
    assert result.centroid_mm == pytest.approx((-2.35, -2.35))
    assert result.baseline is BASELINE and result.baseline_age_s == 60.0
    assert result.note == "not checked: the model has no checks"
    assert result.deviation is result.interval_mm is None, "the model gives none"


def test_a_model_that_says_how_sure_it_is_is_heard():
    model = FakeModel(make_contract(interval_factor=1.6))
    runtime = make_runtime(model)
    first = runtime.push(make_scan(0, press_counts=PRESS))
    np.testing.assert_allclose(first.deviation, tiny_deviation(first.pattern))
    # Where it is touched the pattern is 3, so the deviation .04, and .01 elsewhere.
    assert first.interval_mm == pytest.approx(1.6 * 0.04)
    kept = first.deviation.copy()
    model.deviation += 1
    np.testing.assert_array_equal(first.deviation, kept, "a result keeps its own deviation")
    idle = runtime.push(make_scan(1))
    assert idle.deviation is idle.interval_mm is None


def test_where_nothing_is_touched_no_interval_is_told():
    runtime = make_runtime(FakeModel(make_contract(interval_factor=1.6, counts_per_unit=(500.0, 500.0, -1000.0))))
    result = runtime.push(make_scan(press_counts=PRESS))
    assert result.state == "contact" and (result.pattern <= 0).all()
    assert result.deviation is not None and result.interval_mm is result.centroid_mm is None and result.area_mm2 == 0


def test_no_contact_no_inference():
    model = FakeModel()
    result = make_runtime(model).push(make_scan())
    assert (result.state, result.contact, result.taps_used, result.force_counts) == ("idle", False, 0, 0.0)
    assert result.pattern is result.area_mm2 is result.centroid_mm is result.run_time_us is result.force_n is None
    assert model.windows == []


def test_input_is_scaled_by_the_contract_newest_tap_first():
    model = FakeModel()
    runtime = make_runtime(model)
    for number, press in enumerate([2000, 5000, 0, 3000]):
        runtime.push(make_scan(number, press_counts=press))
    window = model.windows[-1]
    assert window.shape == (4, 3, 4, 4) and window.dtype == np.float32
    assert window[:, 2, 1, 1].tolist() == [3.0, 5.0, 0.0, 0.0]
    assert not window[:, :2].any()


@pytest.mark.parametrize("factor", [None, 1.6])
def test_the_real_session_fits(tmp_path, factor):
    runtime = make_runtime(ModelSession(write_model(tmp_path / "tiny.onnx", make_contract(interval_factor=factor))))
    first = runtime.push(make_scan(0, press_counts=2000))
    second = runtime.push(make_scan(1, press_counts=4000))
    assert first.pattern is not None and second.pattern is not None
    assert first.pattern.max() == pytest.approx(2.0), "a result keeps its own pattern"
    assert second.pattern.max() == pytest.approx(4.0)
    window = np.zeros((4, 3, 4, 4))
    window[0, 2, 1, 1] = 4
    np.testing.assert_allclose(second.pattern, tiny_pattern(window), atol=1e-6)
    assert (first.interval_mm, second.interval_mm) == pytest.approx(
        (1.6 * 0.03, 1.6 * 0.05) if factor else (None, None)
    )
    if factor:
        np.testing.assert_allclose(first.deviation, tiny_deviation(first.pattern), atol=1e-6)


def test_a_scan_overtaken_spares_the_inference_but_feeds_the_tap():
    model = FakeModel()
    runtime = make_runtime(model)
    runtime.push(make_scan(0, press_counts=2000))
    dropped = runtime.push(make_scan(1, press_counts=9000), infer=False)
    assert (dropped.state, dropped.contact, dropped.taps_used) == ("dropped", True, 1)
    assert dropped.pattern is dropped.run_time_us is None and dropped.force_counts == 9000
    assert len(model.windows) == 1
    runtime.push(make_scan(2))
    runtime.push(make_scan(3, press_counts=2000))
    assert model.windows[-1][1, 2, 1, 1] == 9.0, "the peak was in the scan without a pattern"


def test_without_contact_nothing_is_dropped():
    assert make_runtime().push(make_scan(), infer=False).state == "idle"


def test_zeroing_takes_a_hundred_scans_and_gives_no_pattern_meanwhile():
    runtime = make_runtime(baselines=None)
    states = []
    for number in range(100):
        result = runtime.push(make_scan(number, noise=4))
        states.append(result.state)
    assert states == ["zeroing"] * 99 + ["idle"]
    assert result.baseline is not None and result.baseline.origin == "start-up"
    result = runtime.push(make_scan(200, press_counts=PRESS))
    assert result.state == "contact"
    assert result.force_counts == pytest.approx(PRESS, abs=20)


def test_what_is_not_known_while_zeroing_is_none():
    result = make_runtime(baselines=None).push(make_scan(press_counts=PRESS))
    assert result.state == "zeroing" and result.taps_used == 0
    assert result.contact is result.pattern is result.force_counts is result.baseline is result.baseline_age_s is None


def test_a_refused_baseline_is_noted_and_zeroing_starts_over():
    runtime = make_runtime(baselines=None)
    for number in range(100):
        result = runtime.push(make_scan(number, noise=4, press_counts=200 if number > 50 else 0))
        assert result.note is None or number == 99
    assert result.state == "zeroing" and result.note is not None
    assert result.note.startswith("zeroing started over: taxel (1, 1) z")
    for number in range(100, 200):
        result = runtime.push(make_scan(number, noise=4))
        assert number == 199 or (result.state == "zeroing" and result.note is not None)
    assert result.state == "idle" and result.note is None


def test_torn_scans_do_not_count_for_zeroing():
    runtime = make_runtime(baselines=None)
    for number in range(150):
        result = runtime.push(make_scan(number, noise=4, absent=(3,) if number % 3 == 0 else ()))
    assert result.state == "idle"


def test_a_sensor_without_a_stored_baseline_says_so_and_is_zeroed():
    runtime = make_runtime()
    result = runtime.push(make_scan(sensor="6"))
    assert result.state == "zeroing" and result.note is not None
    assert "no stored baseline for sensor 6, only for 4" in result.note


def test_each_sensor_has_its_own_state():
    other = Baseline.of("6", REST, 1000.0, 100, "file")
    runtime = make_runtime(baselines={"4": BASELINE, "6": other})
    runtime.push(make_scan(0, press_counts=PRESS))
    assert runtime.push(make_scan(0, sensor="6")).state == "idle"
    assert runtime.push(make_scan(1, press_counts=PRESS)).state == "contact"
    assert runtime.push(make_scan(1, sensor="6", press_counts=PRESS, absent=(0,))).taps_used == 1


def test_reset_forgets_the_taps_of_every_sensor_and_keeps_the_baseline():
    runtime = make_runtime()
    for number, press in enumerate([2000, 2000, 0]):
        runtime.push(make_scan(number, press_counts=press))
    runtime.reset()
    result = runtime.push(make_scan(3, press_counts=2000))
    assert result.taps_used == 1 and result.baseline is BASELINE


def test_thresholds_and_idle_time_are_the_callers():
    runtime = make_runtime(options=RuntimeOptions(100, 50, idle_reset_s=0.5))
    used = []
    for number, press in ((0, 120), (1, 60), (2, 49), (3, 120), (100, 120), (101, 0), (200, 120)):
        used.append(runtime.push(make_scan(number, press_counts=press)).taps_used)
    assert used == [1, 1, 0, 2, 2, 0, 1]
    with pytest.raises(UsageError):
        make_runtime(options=RuntimeOptions(10, 50))


def test_a_sensor_that_the_model_was_not_trained_for_is_refused():
    with pytest.raises(ModelError, match="'pitch_mm'"):
        make_runtime(geometry=dataclasses.replace(USPA44, pitch_mm=5.0))
    with pytest.raises(ModelError, match="'sensor'"):
        make_runtime(FakeModel(make_contract(sensor="other")))


def test_a_baseline_or_scan_of_another_grid_is_refused():
    small = Baseline.of("4", REST[:, :2], 0.0, 100, "file")
    with pytest.raises(UsageError, match=r"sensor 4 has shape \(3, 2, 4\), expected \(3, 4, 4\)"):
        make_runtime(baselines={"4": small})
    scan = dataclasses.replace(make_scan(), counts=REST[:, :2])
    with pytest.raises(WindowError, match=r"scan has shape \(3, 2, 4\), expected \(3, 4, 4\)"):
        make_runtime().push(scan)


def test_masks_have_bit_i_for_taxel_i():
    for taxel in range(16):
        assert mask_bits(make_scan(absent=(taxel,)).fresh) == 0xFFFF ^ (1 << taxel)
    assert mask_bits(np.ones((2, 3), dtype=bool)) == 0b111111
    assert mask_bits(np.zeros((4, 4), dtype=bool)) == 0


def test_patch_of_one_pixel_sits_on_it():
    pattern = np.zeros((40, 40), dtype=np.float32)
    pattern[39, 0] = 2
    area_mm2, centroid_mm = touched_patch(pattern, touched(pattern, 0.5), 0.47)
    assert area_mm2 == pytest.approx(0.47**2)
    assert centroid_mm == pytest.approx((-19.5 * 0.47, 19.5 * 0.47))


def test_patch_is_weighted_and_leaves_out_what_is_below_the_level():
    pattern = np.zeros((3, 5), dtype=np.float32)
    pattern[1] = [0.49, 0.5, 0, 1.0, 0]
    area_mm2, centroid_mm = touched_patch(pattern, touched(pattern, 0.5), 2.0)
    assert area_mm2 == 2 * 4
    assert centroid_mm == pytest.approx(((1 * 0.5 + 3 * 1.0) / 1.5 * 2 - 4, 0.0))


@pytest.mark.parametrize("pattern", [np.zeros((4, 4)), np.full((4, 4), -1.0)])
def test_patch_of_nothing_is_nothing(pattern):
    pattern = pattern.astype(np.float32)
    assert touched_patch(pattern, touched(pattern, 0.5), 1.0) == (0.0, None)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["4", "6"]),
            st.integers(0, 20_000),
            st.lists(st.integers(0, 15), max_size=16, unique=True),
            st.booleans(),
        ),
        max_size=40,
    )
)
def test_any_scans_give_one_result_each_and_a_pattern_only_in_contact(scans):
    model = FakeModel()
    runtime = make_runtime(model)
    for number, (sensor, press, absent, infer) in enumerate(scans):
        scan = make_scan(number, sensor=sensor, press_counts=press, absent=tuple(absent))
        result = runtime.push(scan, infer=infer)
        assert result.scan is scan
        assert (result.pattern is not None) == (result.state == "contact")
        assert (result.contact is None) == (result.state in ("zeroing", "incomplete"))
        assert (result.taps_used > 0) == (result.state in ("contact", "dropped"))
    for window in model.windows:
        assert np.isfinite(window).all()


def test_the_newest_scan_wins_and_keeps_the_place_of_the_one_that_it_overtakes():
    """Sensor 4 sends three scans while 6 sends one, and both wait: 4 is the first all the same, by its newest scan."""
    runtime = Runtime(FakeModel(), source="device", baselines=dict.fromkeys("468", BASELINE))
    sent = [make_scan(number, sensor="4", press_counts=3000 * (number + 1)) for number in range(3)]
    assert runtime.take(sent[0]) == [] and runtime.take(make_scan(0, sensor="6", press_counts=3000)) == []
    overtaken = [result for scan in sent[1:] for result in runtime.take(scan)]
    assert [(result.scan.number, result.state, result.pattern) for result in overtaken] == [
        (0, "dropped", None),
        (1, "dropped", None),
    ]
    (idle,) = runtime.take(make_scan(0, sensor="8"))
    assert idle.state == "idle" and runtime.waiting == 2
    newest, other = runtime.infer()
    assert (newest.scan, other.scan.sensor, runtime.waiting) == (sent[2], "6", 0)
    assert newest.pattern.max() == pytest.approx(3 * other.pattern.max())
    dropped, free = runtime.take(sent[0]) or runtime.take(make_scan(9, sensor="4"))
    assert (dropped.state, free.state, runtime.infer()) == ("dropped", "idle", [])


def test_sensors_that_do_not_fit_into_one_call_wait_for_the_next_and_none_starves():
    clock_us = itertools.count(0, 3000)  # two looks at it a call: each takes 3 ms
    names = [str(number) for number in range(6)]
    runtime = Runtime(
        FakeModel(),
        source="device",
        baselines=dict.fromkeys(names, BASELINE),
        clock_ns=lambda: 1000 * next(clock_us),
        options=RuntimeOptions(every_scan=True),
    )

    def infer(number, longest_us):
        for name in names:
            runtime.take(make_scan(number, sensor=name, press_counts=3000))
        return [result.scan.sensor for result in runtime.infer(longest_us)]

    assert infer(0, None) == names
    assert [infer(number, 2000) for number in range(1, 5)] == 2 * [names[:3], names[3:]]
    assert len(runtime.infer(0.001)) == 1, "one at least, or nothing would ever go on"


class TestLoseTouch:
    def pressed(self, *, then):
        """A tap, whatever happens then, and a torn scan."""
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
        for number in range(10):
            runtime.push(make_scan(number, press_counts=3000))
        later_ns = then(runtime)
        torn = make_scan(10, press_counts=3000, absent=(0, 5))
        return runtime.push(dataclasses.replace(torn, time_ns=torn.time_ns + later_ns))

    def test_a_taxel_that_is_missing_now_and_then_is_held(self):
        assert self.pressed(then=lambda runtime: 0).state == "contact"

    def test_after_the_link_broke_no_reading_from_before_is_used(self):
        result = self.pressed(then=lambda runtime: runtime.lose_touch() or 0)
        assert (result.state, result.pattern) == ("incomplete", None)

    def test_after_a_second_without_a_scan_neither(self):
        assert self.pressed(then=lambda runtime: 1_100_000_000).state == "incomplete"

    def test_only_of_the_link_that_broke(self):
        assert self.pressed(then=lambda runtime: runtime.lose_touch("left/") or 0).state == "contact"

    def test_taps_from_before_are_forgotten(self):
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
        for number, press in enumerate([3000, 3000, 0, 0, 3000]):
            before = runtime.push(make_scan(number, press_counts=press))
        assert before.taps_used == 2
        runtime.lose_touch()
        assert runtime.push(make_scan(5, press_counts=3000)).taps_used == 1


def test_a_reading_that_lay_about_is_told():
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    notes = []
    for number, delay_ns in enumerate([0, 50_000_000, 50_000_001, 0]):
        scan = make_scan(number, press_counts=3000)
        told = runtime.push(dataclasses.replace(scan, device_ns=scan.time_ns - delay_ns)).notes
        notes.append(next((note.text for note in told if note.kind == "late"), None))
    assert notes == [None, None, "this reading was 0.05 s old when it arrived", None]


def test_a_sensor_that_the_sensor_file_does_not_know_is_told():
    mountings = {"4": Mounting(), "6": Mounting()}
    runtime = Runtime(FakeModel(), source="device", baselines={"left/4": BASELINE}, mountings=mountings)
    result = runtime.push(make_scan(0, sensor="left/4"))
    assert result.note == "the sensor file has no sensor left/4, only 4, 6: taken as wired"
    assert "sensor file" not in (runtime.push(make_scan(0)).note or "")


def test_zeroing_before_any_sensor_was_heard_is_refused_and_said():
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    runtime.zero()
    assert runtime.push(make_scan(0)).event == "zeroing refused: no scan has arrived yet"


def test_what_may_be_old_because_nobody_read_is_said_to_be():
    runtime = make_runtime()
    late = dataclasses.replace(make_scan(0), unread_ns=4_980_000_000)
    note = runtime.push(late).note
    assert note is not None and "may have been 4.98 s old when it arrived: nothing was read meanwhile" in note
    known = dataclasses.replace(make_scan(1), unread_ns=4_980_000_000, device_ns=make_scan(1).time_ns - 1000)
    assert "old" not in (runtime.push(known).note or "")
