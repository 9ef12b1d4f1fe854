"""Zeroing on demand, ages, and what records tell of it, through the runtime."""

import io
import json

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, REST, FakeModel, make_contract, make_scan
from mcap_samples import arrays_of

from edge.perception.runtime import Runtime
from edge.perception.zeroing import GIVE_UP_NS
from edge.sinks.event_printer import MessageSink
from edge.sinks.jsonl import record_line
from edge.sinks.mcap import McapSink
from edge.sinks.status_line import StatusSink
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import deformation

DAY_S = 86_400.0


class Bench:
    """A runtime, and scans that come to it one after another."""

    def __init__(self, **settings):
        settings = {"source": "device", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1060.0} | settings
        self.runtime = Runtime(FakeModel(make_contract()), **settings)
        self.number = 0

    def play(self, count, offset=0, sensor="4", noise=3, period_ns=PERIOD_NS):
        """Results of so many scans whose z is off by `offset` counts, broadcast to (rows, cols)."""
        results = []
        for _ in range(count):
            scan = make_scan(self.number, sensor=sensor, noise=noise)
            counts = scan.counts.copy()
            counts[2] += np.rint(np.broadcast_to(offset, (4, 4))).astype(np.int32)
            moved = Scan(sensor, scan.number, self.number * period_ns, counts, scan.fresh, scan.renewed)
            results.append(self.runtime.push(moved))
            self.number += 1
        return results


def events(results):
    return [result.event for result in results if result.event is not None]


LOCAL = np.zeros((4, 4))
LOCAL[1, 2] = 3000


def test_the_old_baseline_stays_in_use_until_the_new_one_is_there():
    bench = Bench()
    bench.play(5, 30)
    bench.runtime.zero()
    results = bench.play(120, 30)
    first = next(index for index, result in enumerate(results) if result.baseline.id != BASELINE.id)
    assert first == 99
    assert all(result.state == "idle" and result.baseline is BASELINE for result in results[:first])
    assert all(result.note == "zeroing: keep the pad still and free" for result in results[:first])
    new = results[first].baseline
    assert new.origin == "demand" and abs(new.counts[2] - REST[2] - 30).max() <= 3
    assert results[first].note is None and abs(results[first].force_counts) < 100
    assert events(results) == [f"sensor 4 zeroed on demand: baseline {new.id} instead of {BASELINE.id}"]
    assert results[-1].baseline_age_s == pytest.approx((120 - 100) * PERIOD_NS / 1e9)


def test_in_contact_it_is_refused_unless_forced():
    bench = Bench()
    bench.play(5, LOCAL)
    bench.runtime.zero()
    results = bench.play(120, LOCAL)
    (event,) = events(results)
    assert [(one.kind, one.sensor) for one in results[0].events] == [("in_contact", "4")]
    assert event.startswith("zeroing refused: sensor 4 is in contact: free the pad, or force it")
    assert {result.baseline.id for result in results} == {BASELINE.id}
    bench.runtime.zero(force=True)
    results = bench.play(120, LOCAL)
    assert "zeroed on demand" in events(results)[0]
    assert results[-1].contact is False and abs(results[-1].force_counts) < 100


def test_motion_puts_it_off_and_a_touch_meanwhile_starts_it_over():
    bench = Bench()
    bench.play(5)
    bench.runtime.zero()
    sway = [bench.play(1, 40 * (n % 2))[0] for n in range(150)]
    assert events(sway) == [] and sway[-1].note.startswith("zeroing started over: taxel (")
    bench.play(90)
    touched = bench.play(3, LOCAL)
    assert touched[-1].note.startswith("zeroing started over: the pad is in contact: free it")
    results = bench.play(110)
    assert [result.event is not None for result in results].index(True) == 100  # the first scan free ends the tap


def test_it_gives_up_after_a_stated_time_and_says_why():
    bench = Bench()
    bench.play(5)
    bench.runtime.zero()
    results = [bench.play(1, 40 * (n % 2))[0] for n in range(GIVE_UP_NS // PERIOD_NS + 5)]
    (event,) = events(results)
    assert event.startswith("sensor 4: zeroing given up, the old baseline stays: taxel (") and "tried for 15 s" in event
    assert results[-1].note is None and results[-1].baseline.id == BASELINE.id


def test_a_load_below_contact_is_seen_against_the_old_baseline():
    bench = Bench()
    light = LOCAL / 10
    bench.play(5, light)
    bench.runtime.zero()
    results = bench.play(GIVE_UP_NS // PERIOD_NS + 5, light)
    assert any("counts above the baseline" in event for event in events(results))
    assert results[-1].baseline.id == BASELINE.id


def test_one_sensor_alone_or_all():
    bench = Bench(baselines={"4": BASELINE, "6": BASELINE})
    for sensor in ("4", "6"):
        bench.play(2, sensor=sensor)
    bench.runtime.zero("6")
    four = bench.play(105, sensor="4")
    six = bench.play(105, sensor="6")
    assert events(four) == [] and len(events(six)) == 1
    bench.runtime.zero("9")
    assert events(bench.play(1)) == ["zeroing refused: no sensor 9, there are 4, 6"]


def test_before_there_is_a_baseline_there_is_nothing_to_zero_again():
    bench = Bench(baselines={})
    bench.play(5)
    bench.runtime.zero()
    results = bench.play(100)
    assert events(results) == ["sensor 4: no baseline yet, zeroing since the start"]
    assert results[-1].baseline.origin == "start-up"


def test_earlier_taps_are_forgotten_since_they_were_read_over_another_rest_level():
    bench = Bench()
    bench.play(3, LOCAL), bench.play(3), bench.play(3, LOCAL), bench.play(3)
    assert bench.play(1, LOCAL)[0].taps_used == 3
    bench.play(3)
    bench.runtime.zero()
    bench.play(105)
    assert bench.play(2, LOCAL)[1].taps_used == 1


def test_an_age_goes_on_by_scan_time_whatever_the_wall_clock_does():
    wall_s = iter([1060.0, 1060.0 - DAY_S])
    bench = Bench(unix_time_s=lambda: next(wall_s))  # asked once: twice, it would have been set back by a day
    assert bench.play(1)[0].baseline_age_s == 60.0
    results = bench.play(300)
    assert results[-1].baseline_age_s == pytest.approx(60.0 + 300 * PERIOD_NS / 1e9)


def test_an_age_from_a_clock_that_was_wrong_is_not_known():
    bench = Bench(unix_time_s=lambda: 5.0)
    (result,) = bench.play(1)
    assert result.baseline_age_s is None and result.baseline_text() == f"baseline {BASELINE.id} of unknown age"


def test_what_was_subtracted_is_in_the_record_and_raw_counts_stay(tmp_path):
    bench = Bench()
    sink = McapSink(tmp_path / "drift.mcap", make_contract())
    results = bench.play(1500, 25)
    for result in results:
        sink.write(result, {})
    sink.close()
    last = results[-1]
    assert last.baseline.id == BASELINE.id and abs(last.force_counts) < 100
    record = json.loads(record_line(last, {}))
    assert record["drift_counts"]["common"][2] == pytest.approx(25, abs=2) and record["drift_counts"]["step"] == 0
    assert record["counts"] == last.scan.counts.tolist() and record["baseline"] == BASELINE.id
    kept = arrays_of(tmp_path / "drift.mcap")
    np.testing.assert_array_equal(kept["counts"][-1], last.scan.counts)
    np.testing.assert_array_equal(kept["baseline_counts"][0], BASELINE.counts)
    zeroed = kept["counts"][-1] - kept["baseline_counts"][-1]
    np.testing.assert_array_equal(zeroed, deformation(last.scan.counts, last.baseline))
    assert float(zeroed[2].sum()) == pytest.approx(last.force_counts, abs=0.1)


def test_after_a_step_the_record_and_the_live_line_tell_it():
    bench = Bench()
    bench.play(300)
    bench.play(20, LOCAL)
    off = LOCAL / 50
    results = bench.play(400, off)
    (event,) = events(results)
    assert event.startswith("sensor 4: rest level 6") and "(taxel 6) after a contact" in event
    assert event.endswith(results[-1].note)
    assert json.loads(record_line(results[-1], {}))["drift_counts"]["step"] == pytest.approx(60, abs=4)
    assert results[-1].force_counts == pytest.approx(60, abs=40)
    status, stream = StatusSink(), io.StringIO()
    messages = MessageSink(stream)
    for result in results:
        status.write(result, {})
        messages.write(result, {})
    assert "rest off by 6" in status.line()
    assert stream.getvalue() == f"edge-sr: {event}\n"
    assert [note.kind for note in results[-1].notes] == ["rest_level"]


def test_a_link_that_was_away_is_followed_by_a_comparison():
    bench = Bench()
    bench.play(300)
    bench.runtime.lose_touch()
    results = bench.play(400, 40)
    assert "after a gap" in events(results)[0]
    assert results[-1].force_counts == pytest.approx(16 * 40, abs=100)
    bench.runtime.lose_touch()
    assert len(events(bench.play(400))) == 1  # back where it was


def test_nothing_of_drift_changes_while_it_is_in_contact():
    bench = Bench()
    bench.play(300)
    grip = np.linspace(50, 400, 16).reshape(4, 4)
    held = [bench.play(1, grip * (1 + n / 20_000))[0] for n in range(2000)]
    assert len({id(result.baseline) for result in held[1:]}) == 1
    assert held[-1].force_counts == pytest.approx(grip.sum() * 1.1, abs=100)
