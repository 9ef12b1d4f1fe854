"""Source of one or several links, and the loop from it through the runtime into sinks: order, ends, deadlines."""

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, REST, FakeLink, FakeModel, ListSink, make_scan
from runtime_samples import make_runtime, presses, pumped

from edge.api import LinkLostError, Scan, Source, SourceError, Statistics
from edge.pipeline.cadence import ReadingPace
from edge.pipeline.scan_reader import CAPACITY_SCANS
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.base import Notice
from firmware_bridge.links.registry import open_sources
from firmware_bridge.recording.tracks import Recording, Track

LIMIT_S = 30


def take_all(source, until=lambda taken: False):
    """Return everything in its order, until the open source ends or enough has come."""
    taken, end_s = [], time.monotonic() + LIMIT_S
    while not until(taken) and (some := source.take(0.2)) is not None:
        assert time.monotonic() < end_s, [one for one in taken if isinstance(one, Notice)]
        taken += some
    return taken


def numbers_of(taken, sensor="4"):
    return [one.number for one in taken if isinstance(one, Scan) and one.sensor == sensor]


def order(taken):
    return [one.text if isinstance(one, Notice) else one.number for one in taken]


class TestOpening:
    def test_an_error_leaves_all_links_closed_and_no_thread(self):
        class Counted(FakeLink):
            entered = 0

            def __enter__(self):
                self.entered += 1
                if self.name == "away":
                    raise LinkLostError("no such port")
                return self

            def __exit__(self, *exc_info):
                self.entered -= 1

        links = Counted([[make_scan(0)]], prefix="a/"), Counted([], prefix="b/")
        links[1].name = "away"
        with pytest.raises(LinkLostError, match="no such port"):
            Source(*links).open()
        assert links[0].entered == 0
        assert not any(thread.name == "scan-reader" for thread in threading.enumerate())

    def test_emulated_and_real_links_are_not_mixed_whenever_it_shows(self):
        class Late(FakeLink):
            def __enter__(self):
                self.kind = "emulated"
                return self

        with pytest.raises(SourceError, match=r"\(fake is device, fake is emulated\), expected one"):
            Source(FakeLink([]), FakeLink([], kind="emulated"))
        with pytest.raises(SourceError, match="of several kinds"):
            Source(Late([]), FakeLink([])).open()
        played = FakeLink([], kind="replay")
        played.origin = "emulated"
        with pytest.raises(SourceError, match=r"\(fake is replay \(EMULATED\), fake is replay\), expected one"):
            Source(played, FakeLink([], kind="replay"))
        with Source(Late([]), Late([], prefix="b/")) as source:
            assert source.kind == "emulated"


class Telling(FakeLink):
    """Link that has a notice at one of its reads."""

    def __init__(self, parts, read, kind):
        super().__init__(parts)
        self._read, self._notice = read, Notice(0, kind, "told")

    def notices(self):
        return [self._notice] if self.reads == self._read else []


class TestOne:
    def test_a_scan_wakes_who_waits_for_it(self):
        gate = threading.Event()
        link = FakeLink([gate, presses([0])], endless=True)
        with Source(link) as source:
            threading.Timer(0.1, gate.set).start()
            assert numbers_of(source.take(10)) == [0]
            assert link.reads < 100, "it slept through some thousand more reads"
            assert source.take(0.01) == []

    @pytest.mark.parametrize(
        ("at", "given"),
        [
            (0, ["told", *range(6, CAPACITY_SCANS + 5)]),
            (CAPACITY_SCANS, [*range(5, CAPACITY_SCANS), "told", *range(CAPACITY_SCANS, CAPACITY_SCANS + 5)]),
        ],
    )
    def test_a_notice_keeps_its_place_among_lost_scans(self, at, given):
        link = Telling([[scan] for scan in presses(range(CAPACITY_SCANS + 5))], at + 1, "lost")
        with Source(link) as source:
            assert link.through.wait(10)
            taken = take_all(source)
        assert order(taken) == given and source.overruns + len(taken) - 1 == CAPACITY_SCANS + 5


class TestScripts:
    def test_a_link_that_hangs_holds_up_no_other(self):
        gate = threading.Event()
        fast = FakeLink([[make_scan(n)] for n in range(5)], prefix="fast/")
        with Source(FakeLink([gate, [make_scan(0)]], prefix="slow/"), fast) as source:
            taken = take_all(source, lambda taken: len(taken) >= 5)
            assert numbers_of(taken, "fast/4") == list(range(5)) and not numbers_of(taken, "slow/4")
            gate.set()
            assert numbers_of(take_all(source), "slow/4") == [0]

    def test_the_source_closes_while_a_link_is_away(self):
        before = set(threading.enumerate())
        away = FakeLink([], error=LinkLostError("gone"), lasts=True)
        with Source(away, FakeLink([], endless=True, prefix="right/"), give_up_s=float("inf")) as source:
            take_all(source, lambda taken: any(isinstance(one, Notice) for one in taken))
        assert not set(threading.enumerate()) - before


def recording(scans, pressed):
    """Two sensors on a bus, which change in every scan, and are pressed at the end."""
    rng = np.random.default_rng(2)
    counts = [(REST + rng.integers(-3, 4, (scans, 3, 4, 4))).astype(np.int32) for _ in range(2)]
    for one in counts:
        one[pressed:, 2, 1, 1] += 3000
    tracks = tuple(Track(name, one, None) for name, one in zip("46", counts, strict=True))
    return Recording(Path("made.csv"), tracks, 100.0)


@pytest.mark.parametrize("pace", [ReadingPace(0.01, 8), ReadingPace()])
def test_what_is_read_does_not_depend_on_when(pace):
    """Cycles of two sensors mix on each of two buses, and reads end within them."""
    played = recording(100, 60)
    with ExitStack() as closing:
        emulators = [closing.enter_context(Emulator([played], waits=True)) for _ in range(2)]
        links = open_sources([f"f{index}=slcan:{emulator.port}" for index, emulator in enumerate(emulators)])
        source = Source(*links, give_up_s=float("inf"))
        closing.enter_context(source)
        source.pace = pace
        taken: list[list[Scan]] = []
        end_s = time.monotonic() + 30
        while sum(map(len, taken)) < 400 and time.monotonic() < end_s:
            taken.append([one for one in source.take(0.1) or () if isinstance(one, Scan)])
        counters = source.counters()
    for name in ("f0/4", "f0/6", "f1/4", "f1/6"):
        mine = [[scan for scan in together if scan.sensor == name] for together in taken]
        scans = [scan for together in mine for scan in together]
        assert [scan.number for scan in scans] == list(range(100))
        expected = played.tracks["46".index(name[-1])].counts
        assert (np.stack([scan.counts for scan in scans]) == expected).all()
        assert pace.reads == 1 or max(map(len, mine)) >= 5
    assert counters["frames"] == counters["readings"] == 6400


@pytest.mark.parametrize("patience_s", [0.0, 0.2])
def test_a_contact_that_waited_gets_all_its_patterns(patience_s):
    """Its scans come together after rest: none is dropped, nor late by its pattern."""
    rested, scans = threading.Event(), [make_scan(n, noise=3, press_counts=(n >= 150) * (3000 + n)) for n in range(156)]
    stamped = [replace(scan, device_ns=scan.time_ns) for scan in scans]
    link = FakeLink([[scan] for scan in stamped[:150]] + [rested, stamped[150:]])

    sink = ListSink(on_write=lambda result: result.scan.number == 149 and rested.set())
    sink.patience_s = patience_s
    late_ns = scans[-1].time_ns + 100_000_000
    statistics = pumped(link, sink, clock_ns=lambda: late_ns)
    patterns = [result.pattern is not None for result in sink.results if result.scan.number >= 150]
    assert len(patterns) == 6 and all(patterns) == (patience_s > 0)
    assert (statistics.dropped == statistics.late == 0) == (patience_s > 0)


MS = 1_000_000


def numbers(sink, sensor="4"):
    return [result.scan.number for result in sink.results if result.scan.sensor == sensor]


def answered(scans):
    """Return a link and a sink: each scan comes when the one before is written."""
    written = [threading.Event() for _ in scans]
    link = FakeLink([part for scan, event in zip(scans, written, strict=True) for part in ([scan], event)])
    return link, ListSink(on_write=lambda result: written[result.scan.number].set())


def test_scans_that_come_during_a_turn_wait_for_the_next():
    """Six sensors press; a call takes four of them, and the next scans come during each of the first two calls."""
    names = [f"{number}" for number in range(6)]
    batches = [[make_scan(n, sensor=name, press_counts=3000 + 500 * n) for name in names] for n in range(3)]
    gates, read_on = [threading.Event(), threading.Event()], [threading.Event(), threading.Event()]
    link = FakeLink([batches[0], gates[0], batches[1], read_on[0].set, gates[1], batches[2], read_on[1].set])
    calls = []

    class Slow(FakeModel):
        def run_together(self, windows, pads=None, poses=None):
            calls.append(len(windows))
            if len(calls) <= 2:
                gates[len(calls) - 1].set()
                assert read_on[len(calls) - 1].wait(10)
            return super().run_together(windows, pads)

    sink = ListSink()
    runtime = make_runtime(Slow(), baselines=dict.fromkeys(names, BASELINE))
    statistics = pumped(link, sink, runtime=runtime, rate_hz=250)
    made = [(one.scan.number, one.scan.sensor) for one in sink.results if one.pattern is not None]
    assert calls == [4, 2, 4, 2] and statistics.dropped == 6
    assert made == [(number, name) for number in (0, 2) for name in names]
    assert all(numbers(sink, name) == [0, 1, 2] for name in names)


class TestEnds:
    @pytest.mark.parametrize(
        ("error", "words"), [(LinkLostError("gone"), "gone"), (ZeroDivisionError(), "unforeseen ZeroDivisionError")]
    )
    def test_a_lost_or_faulty_link_is_reported_after_earlier_scans(self, error, words):
        sink, statistics = ListSink(), Statistics()
        with pytest.raises(LinkLostError, match=words):
            pumped(FakeLink([presses([0, 1]), presses([2])], error=error), sink, statistics=statistics)
        assert numbers(sink) == [0, 1, 2] and statistics.scans == 3

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

    @pytest.mark.parametrize("kind", ["lost", "silent", "back", "trouble"])
    def test_a_notice_reaches_runtime_and_sinks_in_its_place(self, kind):
        order, runtime = [], make_runtime()
        runtime.lose_touch = lambda sensors, **_: order.append("lost touch")
        sink = ListSink(on_write=lambda result: order.append(result.scan.number))
        sink.tell = lambda event, counters: order.append((event.kind, event.text))
        statistics = pumped(Telling([[scan] for scan in presses(range(10))], 5, kind), sink, runtime=runtime)
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
        assert statistics.late == 3 and len(statistics.latency_us) == 10 and statistics.dropped == 0
