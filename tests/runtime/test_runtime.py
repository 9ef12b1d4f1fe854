"""Runtime: what a result holds, zeroing at the start, scans that overtake others, and those that need no pattern."""

import dataclasses

import pytest
from edge_samples import BASELINE, REST, FakeModel, make_contract, make_scan
from runtime_samples import PRESS, Pushed, make_runtime

from edge.api import WindowError
from edge.perception.run_options import RuntimeOptions
from firmware_bridge.scans.mounting import Mounting

SURE = make_contract(interval_factor=1.6)


class TestResult:
    def test_the_time_of_the_model_is_told_and_what_it_does_not_give(self):
        clock = iter([5_000, 25_500])
        result = make_runtime(clock_ns=lambda: next(clock)).push(make_scan(press_counts=PRESS))
        assert result.run_time_us == 20.5
        assert result.note == "not checked: the model has no checks"
        assert result.deviation is result.interval_mm is None

    def test_where_nothing_is_touched_no_interval_is_told(self):
        contract = dataclasses.replace(SURE, counts_per_unit=(500.0, 500.0, -1000.0))
        result = Pushed(make_runtime(FakeModel(contract))).push(PRESS)
        assert result.state == "contact" and (result.pattern <= 0).all()
        assert result.deviation is not None and result.interval_mm is result.centroid_mm is None
        assert result.area_mm2 == 0


class TestRefusals:
    def test_a_scan_of_another_grid_is_refused(self):
        with pytest.raises(WindowError, match=r"scan has shape \(3, 2, 4\), expected \(3, 4, 4\)"):
            make_runtime().push(dataclasses.replace(make_scan(), counts=REST[:, :2]))

    def test_a_sensor_that_no_file_knows_is_told(self):
        mountings = {"4": Mounting(), "6": Mounting()}
        runtime = make_runtime(baselines={"left/4": BASELINE}, mountings=mountings)
        result = runtime.push(make_scan(0, sensor="left/4"))
        assert result.note == "the sensor file has no sensor left/4, only 4, 6: taken as wired"
        result = runtime.push(make_scan(0))
        assert result.state == "zeroing" and "sensor file" not in result.note
        assert "no stored baseline for sensor 4, only for left/4" in result.note


class TestOvertaken:
    def test_a_scan_overtaken_spares_the_inference_but_feeds_the_tap(self):
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


class TestAway:
    @pytest.mark.parametrize(
        ("lost", "later_ns", "state"),
        [
            (None, 0, "contact"),  # a taxel that is missing now and then is held
            ((), 0, "incomplete"),  # every link
            (None, 1_100_000_000, "incomplete"),  # after a second without a scan
            (("left/",), 0, "contact"),  # another link broke
        ],
    )
    def test_no_reading_from_before_a_gap_is_used(self, lost, later_ns, state):
        pad = Pushed()
        for press in (PRESS, PRESS, 0, PRESS, PRESS):
            pad.push(press)
        assert pad.results[-1].taps_used == 2
        if lost is not None:
            pad.runtime.lose_touch(*lost)
        torn = pad.scan(PRESS, absent=(0, 5))
        result = pad.runtime.push(dataclasses.replace(torn, time_ns=torn.time_ns + later_ns))
        assert result.state == state and (result.pattern is not None) == (state == "contact")
        assert pad.push(PRESS).taps_used == (2 if state == "contact" else 1), "taps from before are forgotten as well"

    def test_a_reading_that_is_old_or_may_be_is_told(self):
        for delay_ns, unread_ns, told in (
            (50_000_000, 0, []),
            (50_000_001, 0, ["this reading was 0.05 s old when it arrived"]),
            (None, 4_980_000_000, ["this reading may have been 4.98 s old when it arrived"]),
            (1000, 4_980_000_000, []),  # the device knows better
        ):
            scan = make_scan(press_counts=PRESS)
            device_ns = None if delay_ns is None else scan.time_ns - delay_ns
            notes = make_runtime().push(dataclasses.replace(scan, device_ns=device_ns, unread_ns=unread_ns)).notes
            assert [one.text for one in notes if one.kind == "late"] == told


def make_pad(**settings):
    model = FakeModel(SURE)
    return Pushed(make_runtime(model, **settings)), model


def test_a_still_grip_is_inferred_once():
    pad, model = make_pad()
    results = [pad.push(PRESS, noise=3) for _ in range(15)]
    assert len(model.windows) == 1
    assert [result.reused_from for result in results] == [None] + [0] * 14
    for result in results[1:]:
        assert result.state == "contact" and result.run_time_us is None and result.pattern is results[0].pattern
        assert result.interval_mm == results[0].interval_mm and result.area_mm2 == results[0].area_mm2
    moved = pad.push(PRESS + 20)
    assert moved.reused_from is None and moved.run_time_us is not None and len(model.windows) == 2
    pad.runtime.reset()
    assert pad.push(PRESS + 20).reused_from is None, "a reset"
    pad.push()
    again = [pad.push(PRESS + 20).reused_from for _ in range(2)]
    assert again == [None, 18] and len(model.windows) == 4, "the same touch in the next tap"


def test_a_press_that_rises_slowly_is_inferred_again():
    (pad, _), (every, model) = make_pad(), make_pad(options=RuntimeOptions(every_scan=True))
    assert [pad.push(PRESS + 5 * n).reused_from for n in range(9)] == [None, 0, 0, None, 3, 3, None, 6, 6]
    assert all(every.push(PRESS).reused_from is None for _ in range(5)) and len(model.windows) == 5
