from dataclasses import replace

import numpy as np
import pytest
from edge_samples import BASELINE, make_scan
from hypothesis import given
from hypothesis import strategies as st

from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.pipeline.run_statistics import Histogram, Statistics


def result(scan, state="idle", run_time_us=None, reused_from=None):
    pattern = np.zeros((40, 40), dtype=np.float32) if state == "contact" else None
    return Result(scan, "device", "m", state, pattern=pattern, reused_from=reused_from, run_time_us=run_time_us)


@pytest.mark.parametrize(("age_s", "age"), [(12.4, "12 s"), (599, "599 s"), (660, "11 min"), (40000, "11 h")])
def test_which_baseline_and_how_old(age_s, age):
    known = Result(make_scan(), "device", "m", "idle", baseline=BASELINE, baseline_age_s=age_s)
    assert known.baseline_text() == f"baseline {BASELINE.id} {age} old"
    assert result(make_scan()).baseline_text() == "no baseline"


@given(st.lists(st.floats(1, 1e7), min_size=1, max_size=200), st.floats(0.01, 1))
def test_quantiles_are_at_most_one_bucket_too_high(values, share):
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    exact = float(np.quantile(values, share, method="inverted_cdf"))
    got = histogram.quantile(share)
    assert got is not None
    assert exact * (1 - 1e-9) <= got <= exact * 1.0219
    assert got <= histogram.max == max(values)


def test_extreme_values_stay_within_the_histogram():
    histogram = Histogram()
    size = len(histogram._buckets)
    for value in (0.0, 1e-9, 1e30):
        histogram.add(value)
    assert histogram.count == 3 and histogram.max == 1e30 and len(histogram._buckets) == size
    assert histogram.quantile(0.5) == 1.0


def test_no_values_have_no_quantile():
    assert Histogram().quantile(0.5) is None


def test_counts_what_happened():
    statistics = Statistics()
    statistics.add(result(make_scan(0), "contact", 200.0))
    statistics.add(result(make_scan(1), "dropped"))
    statistics.add(result(make_scan(1), "contact", reused_from=0))
    statistics.add(result(make_scan(2, absent=(1, 2))))
    statistics.add(result(make_scan(3, stale=(1,))))
    statistics.add(result(make_scan(4, stale=tuple(range(16)))))
    statistics.add(result(make_scan(5, absent=(0,), stale=tuple(range(16)))))
    got = {name: getattr(statistics, name) for name in ("scans", "patterns", "reused", "dropped")}
    assert got == {"scans": 7, "patterns": 2, "reused": 1, "dropped": 1} and statistics.run_time_us.count == 1
    assert (statistics.torn_wire, statistics.torn_source, statistics.repeated) == (2, 1, 1)


def test_rate_is_held_per_sensor_over_the_whole_run():
    statistics = Statistics()
    for number in range(11):
        statistics.add(result(make_scan(number, time_ns=number * 10_000_000)))
        statistics.add(result(make_scan(number, sensor="6", time_ns=number * 20_000_000)))
    statistics.add(result(make_scan(0, sensor="7")))
    assert statistics.rate_hz() == pytest.approx({"4": 100.0, "6": 50.0})


def test_summary_tells_all_of_it():
    statistics = Statistics()
    for number in range(3):
        statistics.add(result(make_scan(number, absent=(0,), time_ns=number * 500_000_000), "contact", 200.0))
    zeroed = Result(make_scan(3, time_ns=1_500_000_000), "device", "m", "idle", baseline=BASELINE, baseline_age_s=90.0)
    statistics.add(zeroed)
    statistics.overruns = 7
    statistics.commands_refused = 2
    statistics.sink_trouble = "nobody subscribes to zenoh:a"
    for kind in ("lost", "back", "lost"):
        statistics.tell(Event(0, kind, None, ""))
    text = statistics.summary(source="EMULATED demo", wanted_rate_hz=100)
    assert text.splitlines() == [
        "EMULATED demo: 4 scans, 3 patterns (0 reused), 0 dropped, 7 overrun, 0 missed",
        "torn: 3 on the wire, 0 renewed in part; 0 repeated",
        "run time: p50 200 us, p99 200 us, max 200 us",
        "rate held: 2.0 Hz (sensor 4), 100 Hz asked for",
        f"sensor 4: baseline {BASELINE.id} 90 s old, from file",
        "sinks: nobody subscribes to zenoh:a",
        "events: lost 2, back 1",
        "refused: 2 lines or messages were not commands",
    ]


def noted(number, state, note=None, sensor="4"):
    notes = () if note is None else (Note("zeroing_restarted", note),)
    return replace(result(make_scan(number, sensor=sensor), state), notes=notes)


@pytest.mark.parametrize(
    ("results", "why"),
    [
        ([noted(0, "zeroing")], "not zeroed, too few scans; or pass --baseline, of the free pad"),
        ([noted(0, "zeroing"), noted(1, "zeroing", "it moved")], "not zeroed, it moved; or pass --baseline, of the"),
        ([noted(0, "incomplete", "taxel 3 is dead"), noted(1, "zeroing")], "taxel 3 is dead"),
        ([noted(0, "zeroing", "it moved"), noted(1, "idle")], "no contact: its readings never reached"),
        ([noted(0, "idle"), noted(1, "dropped"), noted(2, "idle")], "newer scans overtook all"),
    ],
)
def test_summary_says_why_there_is_no_pattern(results, why):
    statistics = Statistics()
    for one in results:
        statistics.add(one)
    (line,) = [line for line in statistics.summary(source="x").splitlines() if "no pattern" in line]
    assert line.startswith(f"sensor 4 has no pattern: {why}")


def test_summary_is_silent_of_a_sensor_that_nothing_touched_while_another_was():
    statistics = Statistics()
    for one in (noted(0, "contact"), noted(0, "idle", sensor="6"), noted(0, "zeroing", sensor="7")):
        statistics.add(one)
    lines = [line for line in statistics.summary(source="x").splitlines() if "no pattern" in line]
    assert len(lines) == 1 and lines[0].startswith("sensor 7 has no pattern: not zeroed")


def test_summary_tells_no_rate_of_scans_that_came_in_one_burst():
    statistics = Statistics()
    for number in range(6):
        statistics.add(result(make_scan(number, time_ns=number * 265_000)))
    assert "rate" not in statistics.summary(source="x")


def test_summary_tells_no_rate_of_less_than_a_second():
    """At 100 Hz, behind a few that came at once."""
    statistics = Statistics()
    for number in range(20):
        statistics.add(result(make_scan(number, time_ns=max(number - 5, 0) * 10_000_000)))
    assert statistics.rate_hz()["4"] > 135 and "rate" not in statistics.summary(source="x")
    for number in range(20, 106):
        statistics.add(result(make_scan(number, time_ns=(number - 5) * 10_000_000)))
    assert "rate held: 105.0 Hz (sensor 4)" in statistics.summary(source="x")


def test_summary_of_nothing():
    assert Statistics().summary(source="x").splitlines() == [
        "x: 0 scans, 0 patterns (0 reused), 0 dropped, 0 overrun, 0 missed",
        "torn: 0 on the wire, 0 renewed in part; 0 repeated",
    ]
