import contextlib
import itertools
import threading
import time

import pytest
from edge_samples import BASELINE, REST, FakeLink, FakeModel, ListSink, make_scan

from edge.errors import SinkClosedError
from edge.perception.runtime import Runtime
from edge.pipeline.commands import RESET
from edge.pipeline.pose_queue import PoseQueue
from edge.pipeline.pump import pump
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import CAPACITY_SCANS, Source
from firmware_bridge.errors import LinkLostError
from firmware_bridge.links.base import Notice, Pace
from firmware_bridge.zeroing.baseline import Baseline

BASELINES = {"4": BASELINE, "6": Baseline.of("6", REST, 1000.0, 100, "file")}


def scans(numbers, sensor="4", press=3000):
    return [make_scan(number, sensor=sensor, press_counts=press + 20 * number) for number in numbers]


def run(link, *sinks, model=None, statistics=None, **settings):
    runtime = settings.pop("runtime", None) or Runtime(model or FakeModel(), source=link.kind, baselines=BASELINES)
    settings.setdefault("stop", threading.Event())
    statistics = statistics or Statistics()
    capacity_scans, rate_hz = settings.pop("capacity_scans", CAPACITY_SCANS), settings.pop("rate_hz", None)
    with Source(link, capacity_scans=capacity_scans, rate_hz=rate_hz) as source:
        pump(source, runtime, sinks, statistics, **settings)
    return statistics


def numbers(sink, sensor="4"):
    return [result.scan.number for result in sink.results if result.scan.sensor == sensor]


def test_every_scan_gives_one_record_in_order_and_a_finite_source_ends_it():
    sink = ListSink()
    batches = [[scan] for scan in scans(range(50))]
    run(FakeLink(batches), sink)
    assert numbers(sink) == list(range(50))


def test_reading_goes_on_beside_inference():
    """The model waits until the link has been read again, which only another thread can do."""
    read_again = threading.Event()
    link = FakeLink([scans([0]), *[scans([n]) for n in range(1, 5)]])
    inner = link.read

    def read(timeout_s):
        if link.reads >= 3:
            read_again.set()
        return inner(timeout_s)

    link.read = read
    seen = []
    run(link, ListSink(), model=FakeModel(on_run=lambda: seen.append(read_again.wait(10))))
    assert all(seen)
    assert link.thread is not threading.current_thread()


def test_scans_that_come_between_the_calls_of_a_round_overtake_those_that_wait():
    """Six sensors press; a call has time for two of them, and the next scans come during the second call."""
    names = [f"{number}" for number in range(6)]
    batches = [[make_scan(n, sensor=name, press_counts=3000 + 500 * n) for name in names] for n in range(3)]
    gates = [threading.Event(), threading.Event()]
    link = FakeLink([batches[0], gates[0], batches[1], gates[1], batches[2]])
    clock_us, calls = itertools.count(0, 3000), []

    class Slow(FakeModel):
        def run_together(self, windows, pads=None):
            calls.append(len(windows))
            if len(calls) <= 2:
                gates[len(calls) - 1].set()
                while link.reads < 2 * len(calls) + 2:  # the batch is handed over before the next read
                    time.sleep(0.001)
            return super().run_together(windows, pads)

    runtime = Runtime(
        Slow(), source="device", baselines=dict.fromkeys(names, BASELINE), clock_ns=lambda: 1000 * next(clock_us)
    )
    sink = ListSink()
    statistics = run(link, sink, runtime=runtime, rate_hz=250)  # a call may take 1 ms
    made = [(one.scan.number, one.scan.sensor) for one in sink.results if one.pattern is not None]
    assert calls[:4] == [6, 2, 2, 2] and max(calls[4:]) <= 2
    assert made == [(0, name) for name in names] + [(1, "0"), (1, "1")] + [(2, name) for name in "234501"]
    assert statistics.dropped == 4
    assert all(numbers(sink, name) == [0, 1, 2] for name in names)


def slow_run(batch_while_busy, **settings):
    """One scan occupies the model; all of `batch_while_busy` arrives meanwhile."""
    busy, arrived = threading.Event(), threading.Event()
    link = FakeLink([scans([0]), busy, *batch_while_busy])

    def read(timeout_s, inner=link.read):
        got = inner(timeout_s)
        if link.ended:
            arrived.set()
        return got

    link.read = read
    sink = ListSink()
    model = FakeModel(on_run=lambda: (busy.set(), arrived.wait(10)))
    statistics = run(link, sink, model=model, **settings)
    return sink, statistics, model


def test_when_inference_falls_behind_the_newest_scan_wins_and_the_rest_is_counted():
    sink, statistics, model = slow_run([scans([n]) for n in range(1, 8)])
    assert numbers(sink) == list(range(8))
    assert [result.state for result in sink.results] == ["contact"] + ["dropped"] * 6 + ["contact"]
    assert statistics.dropped == 6 and statistics.overruns == 0 and len(model.windows) == 2
    assert [counters["dropped"] for counters in sink.counters] == [0, 1, 2, 3, 4, 5, 6, 6]


def test_each_sensor_keeps_its_newest():
    mixed = [[*scans([n]), *scans([n], "6")] for n in range(1, 4)]
    sink, statistics, _ = slow_run([*mixed, scans([4])])
    states = {(r.scan.sensor, r.scan.number): r.state for r in sink.results}
    assert states[("4", 4)] == states[("6", 3)] == "contact"
    assert statistics.dropped == 5


def test_a_full_queue_throws_away_the_oldest_and_counts_it():
    sink, statistics, _ = slow_run([scans([n]) for n in range(1, 11)], capacity_scans=4)
    assert numbers(sink) == [0, 7, 8, 9, 10]
    assert statistics.overruns == 6
    assert sink.counters[-1]["overruns"] == 6


def test_a_lost_link_is_told_after_all_scans_before_it():
    sink = ListSink()
    statistics = Statistics()
    link = FakeLink([scans([0, 1]), scans([2])], error=LinkLostError("gone"))
    with pytest.raises(LinkLostError, match="gone"):
        run(link, sink, statistics=statistics)
    assert numbers(sink) == [0, 1, 2]
    assert statistics.scans == 3


def test_a_fault_in_the_reader_is_not_swallowed():
    with pytest.raises(ZeroDivisionError):
        run(FakeLink([], error=ZeroDivisionError()), ListSink())


def test_stop_ends_an_endless_source():
    stop = threading.Event()
    sink = ListSink(on_write=lambda result: stop.set())
    run(FakeLink([scans([0])], endless=True), sink, stop=stop)
    assert numbers(sink) == [0]


def test_duration_ends_an_endless_source():
    ticks = itertools.count()
    link = FakeLink([], endless=True)
    run(link, ListSink(), duration_s=5.0, clock_s=lambda: float(next(ticks)))
    assert next(ticks) == 6  # 0 was the start, 1 to 4 were within, 5 was over


def test_the_reader_thread_is_over_when_the_pump_returns():
    link = FakeLink([], endless=True)
    run(link, ListSink(), duration_s=0.05)
    reads = link.reads
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("scan-reader")]
    assert link.reads == reads


def test_sinks_hear_that_nothing_comes():
    stop = threading.Event()
    sink = ListSink()
    wait = sink.wait
    sink.wait = lambda: (wait(), stop.set())
    run(FakeLink([], endless=True), sink, stop=stop)
    assert sink.waits == 1 and sink.results == []


def test_a_closed_sink_ends_it():
    def refuse(result):
        raise SinkClosedError("gone")

    with pytest.raises(SinkClosedError):
        run(FakeLink([scans([0])], endless=True), ListSink(on_write=refuse))


def test_records_carry_the_links_counters_of_their_scan_or_later():
    sink = ListSink()
    run(FakeLink([scans([0]), scans([1, 2])]), sink)
    assert all(a <= counters["scans"] <= 3 for a, counters in zip((1, 3, 3), sink.counters, strict=True))
    link, sink = FakeLink([scans([0]), scans([1, 2])]), ListSink()
    link.patient = True
    run(link, sink)
    assert [counters["scans"] for counters in sink.counters] == [1, 3, 3]


@pytest.mark.parametrize("error", [None, LinkLostError("gone")])
def test_a_record_tells_what_was_left_out_before_it_and_the_run_all_of_it(error):
    class Slow(ListSink):
        unwritten = 0

        def write(self, result, counters):
            super().write(result, counters)
            self.unwritten += 1

    sink, statistics = Slow(), Statistics()
    with contextlib.suppress(LinkLostError):
        run(FakeLink([scans([0]), scans([1, 2])], error=error), sink, statistics=statistics)
    assert [counters["unwritten"] for counters in sink.counters] == [0, 1, 2]
    assert statistics.unwritten == 3


class Script:
    """Commands that come before certain polls."""

    def __init__(self, at) -> None:
        self.refused, self.reason = 3, None
        self.poses = PoseQueue()
        self._at = at
        self._polls = itertools.count()

    def poll(self):
        return [RESET] if next(self._polls) in self._at else []


def test_a_reset_command_resets_the_runtime():
    resets = []
    runtime = Runtime(FakeModel(), source="device", baselines=BASELINES)
    runtime.reset = lambda: resets.append(1)
    statistics = run(FakeLink([], endless=True), runtime=runtime, commands=Script({1, 2}), duration_s=1.5)
    assert resets == [1, 1]
    assert statistics.commands_refused == 3


def test_reader_takes_all_that_waits_and_says_when_it_is_through():
    with Source(FakeLink([scans([0]), scans([1, 2])])) as reader:
        taken = []
        while (arrivals := reader.take(10)) is not None:
            taken += [scan.number for scan in arrivals]
        assert taken == [0, 1, 2]
        assert reader.take(0) is None


def test_a_scan_wakes_who_waits_for_it():
    gate = threading.Event()
    link = FakeLink([gate, scans([0])], endless=True)
    with Source(link) as reader:
        threading.Timer(0.1, gate.set).start()
        assert reader.take(10) != []
        assert link.reads < 100, "it slept through some thousand more reads"


def test_reader_gives_nothing_after_the_timeout():
    with Source(FakeLink([], endless=True)) as reader:
        assert reader.take(0.01) == []


class Telling(FakeLink):
    """Link with one notice, at a certain read."""

    def __init__(self, batches, at, kind):
        super().__init__(batches)
        self._at, self._kind = at, kind

    def notices(self):
        return [Notice(0, self._kind, "told")] if self.reads == self._at else []


@pytest.mark.parametrize("kind", ["lost", "silent", "back", "trouble", "well"])
def test_what_a_link_tells_reaches_runtime_and_sinks_in_its_place(kind):
    batches = [[scan] for scan in scans(range(10))]
    order = []
    runtime = Runtime(FakeModel(), source="device", baselines=BASELINES)
    runtime.lose_touch = lambda sensors, **_: order.append("lost touch")
    sink = ListSink(on_write=lambda result: order.append(result.scan.number))
    sink.tell = lambda event, counters: order.append((event.kind, event.text))
    statistics = run(Telling(batches, 5, kind), sink, runtime=runtime)
    touch = ["lost touch"] if kind in ("lost", "silent", "back") else []
    assert order == [0, 1, 2, 3, *touch, (kind, "told"), *range(4, 10)]
    assert statistics.events == {kind: 1}


class Troubled(ListSink):
    trouble = None


def test_what_is_wrong_with_sinks_at_last_is_of_the_summary():
    bad, good, worse = Troubled(), ListSink(), Troubled()
    bad.trouble, worse.trouble = "nobody reads", "the disk is full"
    statistics = run(FakeLink([scans([0])]), bad, good, worse)
    assert statistics.sink_trouble == "nobody reads; the disk is full"
    bad.trouble = worse.trouble = None
    assert run(FakeLink([scans([0])]), bad, good, worse).sink_trouble is None


@pytest.mark.parametrize("at", [1, 5, 9])
def test_a_notice_keeps_its_place_where_scans_are_thrown_away_that_nobody_took(at):
    link = Telling([[scan] for scan in scans(range(9))], at, "lost")
    with Source(link, capacity_scans=4) as reader:
        while not link.ended:
            time.sleep(0.001)
        taken = []
        while (some := reader.take(10)) is not None:
            taken += some
    numbers = ["lost" if isinstance(heard, Notice) else heard.number for heard in taken]
    assert numbers == {1: ["lost", 6, 7, 8], 5: ["lost", 5, 6, 7, 8], 9: [5, 6, 7, "lost", 8]}[at]
    assert reader.overruns + len(taken) - 1 == 9


class Patient(ListSink):
    patience_s = 0.2


@pytest.mark.parametrize("impatient", [False, True])
def test_scans_may_wait_only_at_rest_and_only_where_every_sink_can_wait(impatient):
    """Close to contact they may not: changes too small to be seen could add up to one."""
    begun, rested, paces = threading.Event(), threading.Event(), []
    rest = [make_scan(n, noise=3) for n in range(120)]
    link = FakeLink([rest[:1], begun, rest[1:], rested, [make_scan(120, noise=3, press_counts=1200)]])
    link.set_pace = paces.append
    gates = {0: begun, 119: rested}
    sink = Patient(lambda result: gates.pop(result.scan.number, begun).set())
    run(link, sink, ListSink() if impatient else Patient())
    assert paces == ([Pace()] if impatient else [Pace(still_s=0.2), Pace()])


@pytest.mark.parametrize(("sensors", "every_ms"), [(3, 0.0), (4, 2.5)])
def test_many_sensors_are_read_together_four_times_a_period(sensors, every_ms):
    paces, written = [], threading.Semaphore(1)
    batches = [[make_scan(n, sensor=f"{name}", noise=3) for name in range(sensors)] for n in range(20)]
    link = FakeLink(batches)
    link.set_pace = paces.append
    read = link.read

    def read_one(timeout_s):
        written.acquire(timeout=10)
        return read(timeout_s)

    link.read = read_one
    sink = ListSink(lambda result: written.release() if result.scan.sensor == "0" else None)
    run(link, sink, runtime=Runtime(FakeModel(), source="device"))
    assert [pace._replace(together_s=round(1e3 * pace.together_s, 2)) for pace in paces] == [
        Pace(),
        *[Pace(every_ms)] * (every_ms > 0),
    ]
