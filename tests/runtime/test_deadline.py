import gc
import threading
import tracemalloc
from dataclasses import replace

import pytest
from edge_samples import BASELINE, FakeLink, FakeModel, ListSink, make_scan
from test_pump import run, scans

from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Runtime
from edge.pipeline.run_statistics import Statistics

MS = 1_000_000


def test_the_loop_counts_late_patterns_and_tells_every_latency():
    """The clock gives 4 ms after each scan, more after the last ones; each comes when the one before is written."""
    contact = scans(range(10))
    written = [threading.Event() for _ in contact]
    sink, statistics = ListSink(on_write=lambda result: written[result.scan.number].set()), Statistics()
    done_ms = dict.fromkeys(range(10), 4.0) | {7: 11.0, 8: 50.0, 9: 290.0}
    link = FakeLink([part for scan, event in zip(contact, written, strict=True) for part in ([scan], event)])
    run(
        link,
        sink,
        statistics=statistics,
        clock_ns=lambda: contact[len(sink.results)].time_ns + round(done_ms[len(sink.results)] * MS),
        rate_hz=100,
    )
    assert [result.latency_us for result in sink.results] == [1000 * done_ms[n] for n in range(10)]
    assert [counters["late"] for counters in sink.counters] == [0] * 7 + [1, 2, 3]
    noted = "this pattern was ready 0.29 s after its newest reading arrived"
    assert ["late" in [note.kind for note in result.notes] for result in sink.results] == [False] * 9 + [True]
    assert noted in (sink.results[9].note or "")
    assert statistics.late == 3 and statistics.latency_us.count == 10 and statistics.dropped == 0


def test_scans_that_lay_unread_set_no_pace():
    """A dozen lay there and are read a millisecond apart; then they come every 10 ms, each result 4 ms behind."""
    lay, came = range(12), range(12, 24)
    times_ms = [500 + n for n in lay] + [520 + 10 * (n - len(lay)) for n in came]
    read = [
        replace(scan, time_ns=times_ms[n] * MS, unread_ns=400 * MS * (n in lay))
        for n, scan in enumerate(scans(range(24)))
    ]
    written = [threading.Event() for _ in read]
    sink = ListSink(on_write=lambda result: written[result.scan.number].set())
    link = FakeLink([part for scan, event in zip(read, written, strict=True) for part in ([scan], event)])
    statistics = run(link, sink, clock_ns=lambda: read[len(sink.results)].time_ns + 4 * MS)
    assert statistics.scans == 24 and statistics.late == 0


def test_collection_stands_still_in_the_loop_only():
    seen = []
    run(
        FakeLink([scans([0])]),
        ListSink(on_write=lambda result: seen.append((gc.isenabled(), gc.get_freeze_count() > 0))),
    )
    assert seen == [(False, True)]
    assert gc.isenabled() and gc.get_freeze_count() == 0


@pytest.mark.parametrize("press", [0, 1400])
def test_the_loop_makes_no_cycles_and_holds_no_more_memory(press):
    """Patterns are copied for the sinks, and freed with their result."""
    # One taxel alone is believed up to 1500 counts.
    runtime = Runtime(
        FakeModel(),
        source="device",
        baselines={"4": BASELINE},
        options=RuntimeOptions(contact_on_counts=1000, every_scan=True),
    )
    runtime._model.windows = _Nothing()  # the fake keeps them
    batches = [[make_scan(n, press_counts=press, noise=3)] for n in range(2300)]
    held, patterns, written = {}, 0, threading.Semaphore(1)
    link = FakeLink(batches)
    read = link.read

    def read_one(timeout_s):
        written.acquire(timeout=10)  # or what waits to be taken would be counted
        return read(timeout_s)

    link.read = read_one

    def watch(result):
        nonlocal patterns
        patterns += result.pattern is not None
        written.release()
        if result.scan.number == 1200:
            gc.collect()
            tracemalloc.start(1)
        if result.scan.number in (1300, 2250):
            snapshot = tracemalloc.take_snapshot().filter_traces(
                [tracemalloc.Filter(True, "*/edge/*"), tracemalloc.Filter(True, "*/firmware_bridge/*")]
            )
            held[result.scan.number] = sum(trace.size for trace in snapshot.traces)
        if result.scan.number == 2290:
            tracemalloc.stop()
            cycles.append(gc.collect())

    cycles: list[int] = []
    sink = _Watcher(watch)
    run(link, sink, runtime=runtime, capacity_scans=10_000)
    assert cycles == [0] and patterns == (2300 if press else 0)
    assert held[2250] - held[1300] < 4096


class _Nothing:
    def append(self, window):
        pass


class _Watcher(ListSink):
    def __init__(self, watch):
        super().__init__()
        self._watch = watch

    def write(self, result, counters):
        self._watch(result)
