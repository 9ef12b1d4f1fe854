"""Source of one or several links: opened in a thread, read in threads at a pace, scripts and emulated adapters."""

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import REST, FakeLink, ListSink, make_scan
from runtime_samples import presses, pumped

from edge.api import LinkLostError, Scan, Source, SourceError, UsageError
from edge.pipeline.cadence import ReadingPace
from edge.pipeline.scan_reader import CAPACITY_SCANS
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.base import Notice
from firmware_bridge.links.registry import open_source
from firmware_bridge.recording.tracks import Recording, Track

LIMIT_S = 30


def take_all(source, until=lambda taken: False):
    """Return everything in its order, until the open source ends or enough has come."""
    taken, end_s = [], time.monotonic() + LIMIT_S
    while not until(taken) and (some := source.take(0.2)) is not None:
        assert time.monotonic() < end_s, [one for one in taken if isinstance(one, Notice)]
        taken += some
    return taken


def numbers(taken, sensor="4"):
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
        source = Source(*links)
        with pytest.raises(LinkLostError, match="no such port"), source:
            pass
        source.close()
        assert links[0].entered == 0
        assert not any(thread.name == "scan-reader" for thread in threading.enumerate())
        with pytest.raises(UsageError, match="fake, away was closed before"):
            source.open()

    def test_emulated_and_real_links_are_not_mixed_whenever_it_shows(self):
        class Late(FakeLink):
            def __enter__(self):
                self.kind = "emulated"
                return self

        with pytest.raises(SourceError, match=r"\(fake is device, fake is emulated\), expected one"):
            Source(FakeLink([]), FakeLink([], kind="emulated"))
        with pytest.raises(SourceError, match="of several kinds"):
            Source(Late([]), FakeLink([])).open()
        with Source(Late([]), Late([], prefix="b/")) as source:
            assert source.kind == "emulated"


class TestOne:
    def test_a_scan_wakes_who_waits_for_it(self):
        gate = threading.Event()
        link = FakeLink([gate, presses([0])], endless=True)
        with Source(link) as source:
            threading.Timer(0.1, gate.set).start()
            assert numbers(source.take(10)) == [0]
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
        class Telling(FakeLink):
            def notices(self):
                return [Notice(0, "lost", "told")] if self.reads == at + 1 else []

        link = Telling([[scan] for scan in presses(range(CAPACITY_SCANS + 5))])
        with Source(link) as source:
            assert link.through.wait(10)
            taken = take_all(source)
        assert order(taken) == given and source.overruns + len(taken) - 1 == CAPACITY_SCANS + 5


class TestScripts:
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
        named = enumerate(emulators)
        links = [open_source(f"slcan:{emulator.port}", prefix=f"f{index}/") for index, emulator in named]
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

    class Patient(ListSink):
        def write(self, result, counters):
            super().write(result, counters)
            if result.scan.number == 149:
                rested.set()

    sink = Patient()
    sink.patience_s = patience_s
    late_ns = scans[-1].time_ns + 100_000_000
    statistics = pumped(link, sink, clock_ns=lambda: late_ns)
    patterns = [result.pattern is not None for result in sink.results if result.scan.number >= 150]
    assert len(patterns) == 6 and all(patterns) == (patience_s > 0)
    assert (statistics.dropped == statistics.late == 0) == (patience_s > 0)
