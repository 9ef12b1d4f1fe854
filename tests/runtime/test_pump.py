"""Loop from a source through the runtime into sinks: order, overtaking, what ends it, and its deadlines."""

import contextlib
import threading

import pytest
from edge_samples import BASELINE, FakeLink, FakeModel, ListSink, make_scan
from runtime_samples import make_runtime, presses, pumped

from edge.api import LinkLostError, Statistics
from firmware_bridge.links.base import Notice

MS = 1_000_000


def numbers(sink, sensor="4"):
    return [result.scan.number for result in sink.results if result.scan.sensor == sensor]


def answered(scans):
    """Return a link and a sink: each scan comes when the one before is written."""
    written = [threading.Event() for _ in scans]
    link = FakeLink([part for scan, event in zip(scans, written, strict=True) for part in ([scan], event)])
    return link, ListSink(on_write=lambda result: written[result.scan.number].set())


class TestOvertaking:
    def test_scans_between_the_calls_of_a_round_overtake(self):
        """Six sensors press; a call takes four of them, and the next scans come during each of the first two calls."""
        names = [f"{number}" for number in range(6)]
        batches = [[make_scan(n, sensor=name, press_counts=3000 + 500 * n) for name in names] for n in range(3)]
        gates, read_on = [threading.Event(), threading.Event()], [threading.Event(), threading.Event()]
        link = FakeLink(
            [batches[0], gates[0], batches[1], read_on[0].set, gates[1], batches[2], read_on[1].set],
        )
        calls = []

        class Slow(FakeModel):
            def run_together(self, windows, pads=None, poses=None):
                calls.append(len(windows))
                if len(calls) <= 2:
                    gates[len(calls) - 1].set()
                    assert read_on[len(calls) - 1].wait(10)
                return super().run_together(windows, pads)

        baselines, sink = dict.fromkeys(names, BASELINE), ListSink()
        runtime = make_runtime(Slow(), baselines=baselines)
        statistics = pumped(link, sink, runtime=runtime, rate_hz=250)
        made = [(one.scan.number, one.scan.sensor) for one in sink.results if one.pattern is not None]
        assert calls == [4, 4, 4, 2]
        assert made == [(number, name) for number, names in enumerate(("0123", "4501", "230145")) for name in names]
        assert statistics.dropped == 4
        assert all(numbers(sink, name) == [0, 1, 2] for name in names)


class TestEnds:
    @pytest.mark.parametrize(
        ("error", "words"), [(LinkLostError("gone"), "gone"), (ZeroDivisionError(), "unforeseen ZeroDivisionError")]
    )
    def test_a_lost_link_or_a_fault_in_it_is_told_after_all_scans_before(self, error, words):
        sink, statistics = ListSink(), Statistics()
        with pytest.raises(LinkLostError, match=words):
            pumped(FakeLink([presses([0, 1]), presses([2])], error=error), sink, statistics=statistics)
        assert numbers(sink) == [0, 1, 2] and statistics.scans == 3

    def test_stop_and_duration_end_an_endless_source(self):
        stop = threading.Event()
        sink = ListSink(on_write=lambda result: stop.set())
        pumped(FakeLink([presses([0])], endless=True), sink, stop=stop)
        assert numbers(sink) == [0]
        sink = ListSink()
        pumped(FakeLink([], endless=True), sink, duration_s=0.05)
        assert sink.waits > 0 and sink.results == []

    def test_scans_that_wait_at_the_end_have_their_results(self):
        stop, busy = threading.Event(), threading.Event()
        link = FakeLink([presses([0]), busy, presses([1, 2])], endless=True)
        sink = ListSink(on_write=lambda result: (busy.set(), link.through.wait(10), stop.set()))
        pumped(link, sink, stop=stop)
        assert numbers(sink) == [0, 1, 2]


class TestRecords:
    def test_they_carry_the_links_counters_of_their_scan_or_later(self):
        for patient in (False, True):
            link, sink = FakeLink([presses([0]), presses([1, 2])]), ListSink()
            link.patient = patient
            pumped(link, sink)
            counted = [counters["scans"] for counters in sink.counters]
            assert counted == [1, 3, 3] if patient else all(counted[n] >= at for n, at in enumerate((1, 3, 3)))

    @pytest.mark.parametrize("error", [None, LinkLostError("gone")])
    def test_they_tell_how_many_were_left_out(self, error):
        class Slow(ListSink):
            unwritten = 0
            trouble = "the disk is full"

            def write(self, result, counters):
                super().write(result, counters)
                self.unwritten += 1

        sink, statistics = Slow(), Statistics()
        with contextlib.suppress(LinkLostError):
            link = FakeLink([presses([0]), presses([1, 2])], error=error)
            pumped(link, sink, ListSink(), statistics=statistics)
        assert [counters["unwritten"] for counters in sink.counters] == [0, 1, 2]
        assert statistics.unwritten == 3 and statistics.sink_trouble == "the disk is full"

    @pytest.mark.parametrize("kind", ["lost", "silent", "back", "trouble", "well"])
    def test_a_notice_reaches_runtime_and_sinks_in_its_place(self, kind):
        class Telling(FakeLink):
            def notices(self):
                return [Notice(0, kind, "told")] if self.reads == 5 else []

        order, runtime = [], make_runtime()
        runtime.lose_touch = lambda sensors, **_: order.append("lost touch")
        sink = ListSink(on_write=lambda result: order.append(result.scan.number))
        sink.tell = lambda event, counters: order.append((event.kind, event.text))
        statistics = pumped(Telling([[scan] for scan in presses(range(10))]), sink, runtime=runtime)
        touch = ["lost touch"] if kind in ("lost", "silent", "back") else []
        assert order == [0, 1, 2, 3, *touch, (kind, "told"), *range(4, 10)]
        assert statistics.events == {kind: 1}


class TestDeadline:
    def test_the_loop_counts_late_patterns_and_tells_every_latency(self):
        """The clock gives 4 ms after each scan, and more after the last ones."""
        contact, statistics = presses(range(10)), Statistics()
        link, sink = answered(contact)
        done_ms = [4.0] * 7 + [11.0, 50.0, 290.0]
        ready_ns = [scan.time_ns + round(ms * MS) for scan, ms in zip(contact, done_ms, strict=True)] + [10**9]
        pumped(
            link,
            sink,
            statistics=statistics,
            clock_ns=lambda: ready_ns[len(sink.results)],
            rate_hz=100,
        )
        assert [result.latency_us for result in sink.results] == [1000 * one for one in done_ms]
        assert [counters["late"] for counters in sink.counters] == [0] * 7 + [1, 2, 3]
        assert ["late" in [note.kind for note in result.notes] for result in sink.results] == [False] * 9 + [True]
        assert "this pattern was ready 0.29 s after its newest reading arrived" in (sink.results[9].note or "")
        assert statistics.late == 3 and statistics.latency_us.count == 10 and statistics.dropped == 0
