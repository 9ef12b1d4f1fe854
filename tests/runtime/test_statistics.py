"""Statistics of a run, quantiles and the summary at its end; events and notes, each of one of a closed set of kinds."""

import re
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, make_scan

from edge.perception.event import KINDS, NOTE_KINDS, Event, Note
from edge.perception.result import Result
from edge.pipeline.run_statistics import Statistics


def result(scan, state="idle", run_time_us=None, **more):
    pattern = np.zeros((40, 40), dtype=np.float32) if state == "contact" else None
    return Result(scan, "device", "m", state, pattern=pattern, run_time_us=run_time_us, **more)


def counted(results):
    statistics = Statistics()
    for one in results:
        statistics.add(one)
    return statistics


def at(number, time_ns, sensor="4", state="idle", run_time_us=None, **scan):
    return result(make_scan(number, sensor=sensor, time_ns=time_ns, **scan), state, run_time_us)


def noted(number, state, note=None, sensor="4"):
    notes = () if note is None else (Note("zeroing_restarted", note),)
    return replace(result(make_scan(number, sensor=sensor), state), notes=notes)


@pytest.mark.parametrize(("age_s", "age"), [(12.4, "12 s"), (599, "599 s"), (660, "11 min"), (40000, "11 h")])
def test_which_baseline_and_how_old(age_s, age):
    known = result(make_scan(), baseline=BASELINE, baseline_age_s=age_s)
    assert known.baseline_text() == f"baseline {BASELINE.id} {age} old"
    assert result(make_scan()).baseline_text() == "no baseline"


class TestSummary:
    def test_it_tells_all_of_it(self):
        half_s = 500_000_000
        contacts = [at(n, n * half_s, "4", "contact", 200.0) for n in range(3)]
        known = replace(at(3, 3 * half_s), baseline=BASELINE, baseline_age_s=90.0)
        again = replace(at(5, 5 * half_s, state="contact"), reused_from=2)
        statistics = counted([*contacts, known, at(4, 4 * half_s, state="dropped"), again])
        statistics.overruns = 7
        statistics.sink_trouble = "nobody subscribes to zenoh:a"
        assert statistics.summary(source="EMULATED demo", wanted_rate_hz=100).splitlines() == [
            "EMULATED demo: 6 scans, 4 patterns (1 reused), 1 dropped, 7 overrun, 0 missed",
            "run time: p50 200 us, p99 200 us, max 200 us",
            "rate held: 2.0 Hz (sensor 4), 100 Hz asked for",
            f"sensor 4: baseline {BASELINE.id} 90 s old, from file",
            "sinks: nobody subscribes to zenoh:a",
        ]
        assert len(Statistics().summary(source="x").splitlines()) == 1

    @pytest.mark.parametrize(
        ("results", "why"),
        [
            ([noted(0, "zeroing")], "4 has no pattern: not zeroed, too few scans; or pass --baseline, of the free pad"),
            ([noted(0, "zeroing"), noted(1, "zeroing", "it moved")], "4 has no pattern: not zeroed, it moved; or pass"),
            ([noted(0, "incomplete", "taxel 3 is dead"), noted(1, "zeroing")], "4 has no pattern: taxel 3 is dead"),
            ([noted(0, "zeroing", "it moved"), noted(1, "idle")], "4 has no pattern: no contact: its readings never"),
            ([noted(0, "idle"), noted(1, "dropped"), noted(2, "idle")], "4 has no pattern: newer scans overtook all"),
            # A sensor without contact beside one that was touched is as it should be.
            (
                [noted(0, "contact"), noted(0, "idle", sensor="6"), noted(0, "zeroing", sensor="7")],
                "7 has no pattern: not zeroed",
            ),
        ],
    )
    def test_it_says_why_there_is_no_pattern(self, results, why):
        (line,) = [line for line in counted(results).summary(source="x").splitlines() if "no pattern" in line]
        assert line.startswith(f"sensor {why}")

    def test_it_tells_rates_over_more_than_a_second(self):
        results = [at(n, n * ns, sensor) for n in range(111) for sensor, ns in (("4", 10**7), ("6", 10**8))]
        statistics = counted([*results, at(0, 0, "7")])
        assert statistics.rate_hz() == pytest.approx({"4": 100.0, "6": 10.0})
        assert "rate held: 100.0 Hz (sensor 4), 10.0 Hz (sensor 6)" in statistics.summary(source="x")
        burst = counted(at(n, n * 265_000) for n in range(6))
        short = counted(at(n, max(n - 5, 0) * 10_000_000) for n in range(20))  # behind a few that came at once
        assert short.rate_hz()["4"] > 135 and "rate" not in burst.summary(source="x") + short.summary(source="x")


PAGE = [path for path in (ROOT / "edge" / "view").rglob("*") if path.suffix in (".html", ".js")]


def test_each_kind_has_a_text_and_a_place_in_the_docs():
    assert all(Event(0, kind, "4", "detail").text for kind in KINDS)
    text = (ROOT / "docs" / "formats.md").read_text()
    assert not {kind for kind in KINDS | NOTE_KINDS if f"`{kind}`" not in text}


def test_the_page_goes_by_kinds_that_there_are():
    page = "".join(path.read_text() for path in PAGE)
    lists = re.findall(r"byNumbers = \[(.*?)\]|\[([^\]]*)\]\.includes\(event\)|event === (\"\w+\")", page)
    named = set(re.findall(r'"(\w+)"', str(lists)))
    assert {"refused", "in_contact", "rest_level", "lost"} <= named <= KINDS
    notes = set(re.findall(r"\(kind\) => kind !== \"(\w+)\"", page))
    assert notes and notes <= NOTE_KINDS
