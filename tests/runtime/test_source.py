"""Source of one or several links: opened in a thread, read in threads, scripts and emulated adapters."""

import threading
import time

import pytest
from bridge_samples import make_recording
from edge_samples import FakeLink, make_scan
from runtime_samples import presses

from edge.errors import UsageError
from edge.pipeline.scan_reader import Source
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import LinkLostError, SourceError
from firmware_bridge.links.base import Notice
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.scan import Scan

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
    class SlowLink(FakeLink):
        """Link that opens when it may, and notes that it was closed."""

        def __init__(self, error=None):
            super().__init__([[make_scan(0)], [make_scan(1)]])
            self.entering, self.may_open, self.closed = threading.Event(), threading.Event(), threading.Event()
            self.opening_error = error

        def __enter__(self):
            self.entering.set()
            assert self.may_open.wait(10)
            if self.opening_error is not None:
                raise self.opening_error
            return self

        def __exit__(self, *exc_info):
            self.closed.set()

    def test_it_waits_for_what_was_begun_and_loses_nothing(self):
        source = Source(link := self.SlowLink())
        source.begin()
        assert link.entering.wait(10)  # while this thread goes on
        with pytest.raises(UsageError, match="fake is not open"):
            source.take(0)
        threading.Timer(0.1, link.may_open.set).start()
        with source:
            assert link.may_open.is_set() and numbers(take_all(source)) == [0, 1]
        assert link.closed.is_set()

    def test_its_error_comes_where_it_is_awaited(self):
        source = Source(link := self.SlowLink(LinkLostError("no such port")))
        source.begin()
        link.may_open.set()
        with pytest.raises(LinkLostError, match="no such port"), source:
            pass
        source.close()

    def test_closing_ends_what_was_begun_and_never_opened(self):
        source = Source(link := self.SlowLink())
        source.begin()
        threading.Timer(0.1, link.may_open.set).start()
        source.close()
        assert link.closed.is_set()
        assert not any(thread.name == "scan-reader" for thread in threading.enumerate())
        with pytest.raises(UsageError, match="fake was closed before"):
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
        with Source(Late([]), LastingLink(Late([]), None, name="b")) as source:
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
        ("at", "given"), [(1, ["told", 6, 7, 8]), (5, ["told", 5, 6, 7, 8]), (9, [5, 6, 7, "told", 8])]
    )
    def test_a_notice_keeps_its_place_among_lost_scans(self, at, given):
        class Telling(FakeLink):
            def notices(self):
                return [Notice(0, "lost", "told")] if self.reads == at else []

        through = threading.Event()
        link = Telling([[scan] for scan in presses(range(9))])
        inner = link.read

        def read(timeout_s):
            scans = inner(timeout_s)
            if link.ended:
                through.set()
            return scans

        link.read = read
        with Source(link, capacity_scans=4) as source:
            assert through.wait(10)
            taken = take_all(source)
        assert order(taken) == given and source.overruns + len(taken) - 1 == 9


class TestScripts:
    def test_a_link_that_hangs_holds_up_no_other(self):
        gate = threading.Event()
        fast, slow = FakeLink([[make_scan(n)] for n in range(5)]), FakeLink([gate, [make_scan(0)]])
        with Source(LastingLink(slow, None, name="slow"), LastingLink(fast, None, name="fast")) as source:
            taken = take_all(source, lambda taken: len(taken) >= 5)
            assert numbers(taken, "fast/4") == list(range(5)) and not numbers(taken, "slow/4")
            gate.set()
            assert numbers(take_all(source), "slow/4") == [0]

    def test_one_that_gives_up_ends_all_after_its_scans(self):
        lost = FakeLink([[make_scan(0)]], error=LinkLostError("gone"))
        told = [Notice(0, "lost", "told")]
        lost.notices = lambda: [] if lost.reads < 2 or not told else [told.pop()]
        taken = []
        with Source(lost, LastingLink(FakeLink([], endless=True), None, name="other")) as source:
            with pytest.raises(LinkLostError, match="gone"):
                while True:
                    taken += source.take(0.2) or ()
            with pytest.raises(LinkLostError, match="gone"):
                source.take(0)
        assert sorted(type(one).__name__ for one in taken) == ["Notice", "Scan"]

    def test_the_source_closes_while_a_link_is_away(self):
        before = set(threading.enumerate())
        away = LastingLink(FakeLink([], error=LinkLostError("gone")))
        with Source(away, LastingLink(FakeLink([], endless=True), None, name="right")) as source:
            take_all(source, lambda taken: any(isinstance(one, Notice) for one in taken))
        assert not set(threading.enumerate()) - before


def lasting(port, name):
    return LastingLink(SlcanSerialLink(str(port)), name=name)


class TestPorts:
    def test_one_that_is_away_holds_up_no_other_and_comes_back(self, tmp_path):
        """The left adapter is pulled out for a while; the right one's scans go on meanwhile, each of them."""
        recordings = [make_recording(120, seed=seed) for seed in (1, 2)]
        port = tmp_path / "left"

        def readers():
            return [thread.name for thread in threading.enumerate() if thread.name == "scan-reader"]

        def both(taken):
            return min(len(numbers(taken, f"{name}/4")) for name in ("left", "right")) >= 5

        with Emulator(recordings[:1], loop=True, jitter_s=0) as gone, Emulator(recordings[1:], loop=True) as stays:
            port.symlink_to(gone.port)
            with Source(lasting(port, "left"), lasting(stays.port, "right")) as source:
                take_all(source, both)
                outages = source.counters()["outages"]
                port.unlink()  # or another test's terminal of the same number would come back under this name
                gone.__exit__(None, None, None)
                taken = take_all(source, lambda taken: len(numbers(taken, "right/4")) >= 60)
                assert [(one.kind, one.sensors) for one in taken if isinstance(one, Notice)] == [("lost", "left/")]
                heard = numbers(taken, "right/4")
                assert heard == list(range(heard[0], heard[0] + len(heard)))
                with Emulator(recordings[:1], loop=True, jitter_s=0) as again:
                    port.symlink_to(again.port)
                    taken = take_all(source, lambda taken: len(numbers(taken, "left/4")) >= 10)
                    assert [one.kind for one in taken if isinstance(one, Notice)] == ["back"]
                    back = next(index for index, one in enumerate(taken) if isinstance(one, Notice))
                    assert not numbers(taken[:back], "left/4"), "scans from behind the outage came before word of it"
                    assert len(readers()) == 2
                    assert source.counters()["outages"] == outages + 1
        assert not readers()
