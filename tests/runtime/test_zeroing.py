"""Zeroing: of a source by itself, on demand in the runtime, the ages of baselines, and what records tell of it."""

import threading

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, REST, FakeLink, make_scan
from runtime_samples import Pushed, make_runtime

from edge.api import BaselineRefusedError, DeviceError, LinkLostError, Source, take_baselines
from edge.perception.zeroing import GIVE_UP_NS
from edge.sinks.json_records import record
from edge.sinks.status_line import StatusSink
from firmware_bridge.links.base import Notice

DAY_S = 86_400.0


def rest_scans(count, *sensors, start=0):
    return [[make_scan(n, sensor=sensor, noise=3) for sensor in sensors or ("4",)] for n in range(start, start + count)]


def take(link, **settings):
    with Source(link) as source:
        return take_baselines(source, **settings)


class Script:
    """Source that gives what it is told to for each take, every one of which takes 0.1 s."""

    name, kind, taken = "fake", "device", 0

    def __init__(self, given):
        self._given = given

    def reserve(self):
        """Has no other stream."""

    def counters(self):
        return {}

    def take(self, timeout_s):
        self.taken += 1
        return self._given(self.taken)

    def now_s(self):
        return 0.1 * self.taken


class Lost(FakeLink):
    """Link that was away before its ninetieth read."""

    def notices(self):
        return [Notice(0, "lost", "gone")] if self.reads == 90 else []


class TestCapture:
    def test_every_sensor_that_is_read_gets_its_baseline(self):
        baselines = take(FakeLink(rest_scans(150, "4", "6"), endless=True))
        assert {name: (one.sensor, one.scans) for name, one in baselines.items()} == {"4": ("4", 100), "6": ("6", 100)}
        assert np.abs(baselines["6"].counts - REST).max() <= 2

    @pytest.mark.parametrize(
        ("link", "error", "match"),
        [
            (
                FakeLink([[make_scan(n, noise=3, press_counts=10 * n)] for n in range(100)], endless=True),
                BaselineRefusedError,
                r"sensor 4: taxel \(1, 1\) z moved",
            ),
            (FakeLink(rest_scans(99)), BaselineRefusedError, "ended before 100 complete scans"),
            (Lost(rest_scans(188)), BaselineRefusedError, "ended before 100"),
            (FakeLink(rest_scans(5), error=LinkLostError("gone")), LinkLostError, "gone"),
        ],
    )
    def test_why_there_is_none_is_told(self, link, error, match):
        with pytest.raises(error, match=match):
            take(link)

    @pytest.mark.parametrize(
        ("given", "match"),
        [
            (lambda n: [make_scan(n, noise=3)] if n <= 30 else [], "no scan from fake for 10 s"),
            (lambda n: [make_scan(n, noise=3, absent=(3,))], ""),  # a silent taxel, or another id map
            (lambda n: [make_scan(n, noise=3), *[make_scan(n, sensor="6", noise=3)] * (n < 30)], ""),
            (lambda n: [make_scan(0, stale=range(16))], ""),  # frozen: the same readings again and again
        ],
    )
    def test_a_sensor_that_gives_no_whole_scan_is_told(self, given, match):
        source = Script(given)
        with pytest.raises(DeviceError, match=match or "no whole new scan from sensor [46] for 10 s: .*edge-sr doctor"):
            take_baselines(source, clock_s=source.now_s)
        assert source.taken < 200

    def test_a_stop_ends_it_and_nothing_is_kept(self):
        stop = threading.Event()
        stop.set()
        with pytest.raises(BaselineRefusedError, match="stopped before every sensor was zeroed: nothing is kept"):
            take(FakeLink(rest_scans(100), endless=True), stop=stop)

    def test_a_sensor_that_is_done_may_move_while_another_is_not(self):
        done = [make_scan(n, noise=3, press_counts=0 if n < 100 else 50 * n) for n in range(300)]
        torn = [make_scan(n, sensor="6", noise=3, absent=(1,) if n < 150 else ()) for n in range(300)]
        baselines = take(FakeLink(map(list, zip(done, torn, strict=True))))
        assert sorted(baselines) == ["4", "6"] and np.abs(baselines["4"].counts - REST).max() <= 2

    def test_scans_on_both_sides_of_an_outage_are_not_mixed(self):
        """A sensor that was powered again rests elsewhere: a baseline of both halves would fit neither."""
        before = [[make_scan(n, press_counts=9)] for n in range(89)]
        assert np.abs(take(Lost(before + rest_scans(100, start=89)))["4"].counts - REST).max() <= 2


LOCAL = np.zeros((4, 4))
LOCAL[1, 2] = 3000


def make_bench(**settings):
    return Pushed(make_runtime(**settings), noise=3)


def zeroed(bench, count, offset=0, **settings):
    """Ask for zeroing after a few scans, and return the results behind it."""
    bench.play(5, offset(0) if callable(offset) else offset)
    bench.runtime.zero(**settings)
    return bench.play(count, offset)


def events(results):
    return [result.event for result in results if result.event is not None]


def sway(n):
    return 40 * (n % 2)


GIVEN_UP = GIVE_UP_NS // PERIOD_NS + 5


class TestOnDemand:
    def test_the_old_baseline_stays_until_the_new_one_is_there(self):
        results = zeroed(make_bench(), 120, 30)
        first = next(index for index, result in enumerate(results) if result.baseline.id != BASELINE.id)
        assert first == 99
        assert all(result.state == "idle" and result.baseline is BASELINE for result in results[:first])
        assert all(result.note == "zeroing: keep the pad still and free" for result in results[:first])
        new = results[first].baseline
        assert new.origin == "demand" and abs(new.counts[2] - REST[2] - 30).max() <= 3
        assert results[first].note is None and abs(results[first].force_counts) < 100
        assert events(results) == [f"sensor 4 zeroed on demand: baseline {new.id} instead of {BASELINE.id}"]
        assert results[-1].baseline_age_s == pytest.approx((120 - 100) * PERIOD_NS / 1e9)

    def test_motion_puts_it_off_and_a_touch_meanwhile_starts_it_over(self):
        bench = make_bench()
        moving = zeroed(bench, 150, sway)
        assert events(moving) == [] and moving[-1].note.startswith("zeroing started over: taxel (")
        bench.play(90)
        assert bench.play(3, LOCAL)[-1].note.startswith("zeroing started over: the pad is in contact: free it")
        results = bench.play(110)
        # The first scan free ends the tap.
        assert [result.event is not None for result in results].index(True) == 100

    @pytest.mark.parametrize(("offset", "why"), [(sway, "tried for 15 s"), (LOCAL / 10, "counts above the baseline")])
    def test_it_gives_up_after_a_stated_time_and_says_why(self, offset, why):
        results = zeroed(make_bench(), GIVEN_UP, offset)
        (event,) = [event for event in events(results) if "given up" in event]
        assert event.startswith("sensor 4: zeroing given up, the old baseline stays: taxel (") and why in event
        assert results[-1].baseline.id == BASELINE.id

    def test_one_sensor_alone_or_all_that_have_a_baseline(self):
        bench = make_bench(baselines={"4": BASELINE, "6": BASELINE})
        for sensor in ("4", "6"):
            bench.play(2, sensor=sensor)
        bench.runtime.zero("6")
        assert events(bench.play(105, sensor="4")) == [] and len(events(bench.play(105, sensor="6"))) == 1
        bench.runtime.zero("9")
        assert events(bench.play(1)) == ["zeroing refused: no sensor 9, there are 4, 6"]
        results = zeroed(make_bench(baselines={}), 100)
        assert events(results) == ["sensor 4: no baseline yet, zeroing since the start"]
        assert results[-1].baseline.origin == "start-up"

    def test_taps_over_another_rest_level_are_forgotten(self):
        bench = make_bench()
        for _ in range(2):
            bench.play(3, LOCAL)
            bench.play(3)
        assert bench.play(1, LOCAL)[0].taps_used == 3
        bench.play(3)
        zeroed(bench, 105)
        assert bench.play(2, LOCAL)[1].taps_used == 1


class TestAge:
    def test_it_goes_on_by_scan_time_whatever_the_wall_clock_does(self):
        wall_s = iter([1060.0, 1060.0 - DAY_S])
        bench = make_bench(unix_time_s=lambda: next(wall_s))  # asked once: twice, it would have been set back by a day
        assert bench.play(1)[0].baseline_age_s == 60.0
        assert bench.play(300)[-1].baseline_age_s == pytest.approx(60.0 + 300 * PERIOD_NS / 1e9)

    def test_from_a_clock_that_was_wrong_it_is_not_known(self):
        (result,) = make_bench(unix_time_s=lambda: 5.0).play(1)
        assert result.baseline_age_s is None and result.baseline_text() == f"baseline {BASELINE.id} of unknown age"


class TestDrift:
    def test_after_a_step_the_record_and_the_live_line_tell_it(self):
        bench = make_bench()
        bench.play(300)
        bench.play(20, LOCAL)
        results = bench.play(400, LOCAL / 50)
        (event,) = events(results)
        assert event.startswith("sensor 4: rest level 6") and "(taxel 6)" in event
        assert event.endswith(results[-1].note) and [note.kind for note in results[-1].notes] == ["rest_level"]
        assert record(results[-1], {})["drift_counts"]["step"] == pytest.approx(60, abs=4)
        assert results[-1].force_counts == pytest.approx(60, abs=40)
        status = StatusSink()
        for result in results:
            status.write(result, {})
        assert "rest off by 6" in status.line()

    def test_a_link_that_was_away_is_followed_by_a_comparison(self):
        bench = make_bench()
        bench.play(300)
        bench.runtime.lose_touch()
        results = bench.play(400, 40)
        assert "all taxels alike" in events(results)[0]
        assert results[-1].force_counts == pytest.approx(16 * 40, abs=100)
        bench.runtime.lose_touch()
        assert len(events(bench.play(400))) == 1  # back where it was
