"""One source of several links: scripts, and emulated adapters on pseudo-terminals."""

import itertools
import threading
import time

import numpy as np
import pytest
from bridge_samples import make_recording, stacked
from edge_samples import FakeLink, make_scan

from edge.pipeline.scan_reader import Source
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import LinkLostError, SourceError
from firmware_bridge.links.base import Notice, Pace
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.scan import Scan


def take_all(source, until=lambda taken: False, limit_s=30):
    """Everything in its order, until the source ends or is asked no more."""
    taken, end_s = [], time.monotonic() + limit_s
    with source:
        while (some := source.take(0.2)) is not None:
            assert time.monotonic() < end_s, "still going"
            taken += some
            if until(taken):
                break
    return taken


def numbers(taken, sensor):
    return [one.number for one in taken if isinstance(one, Scan) and one.sensor == sensor]


def test_scans_of_each_link_keep_their_order():
    links = [FakeLink([[make_scan(n)] for n in range(50)]) for _ in range(4)]
    source = Source(*(LastingLink(link, None, name=f"f{index}") for index, link in enumerate(links)))
    taken = take_all(source)
    for index in range(4):
        assert numbers(taken, f"f{index}/4") == list(range(50))
    assert source.counters() == {"scans": 200}


def test_a_link_that_hangs_holds_up_no_other():
    gate = threading.Event()
    slow = FakeLink([gate, [make_scan(0)]])
    fast = FakeLink([[make_scan(n)] for n in range(5)])
    with Source(LastingLink(slow, None, name="slow"), LastingLink(fast, None, name="fast")) as source:
        taken = []
        while len(taken) < 5:
            taken += source.take(5) or ()
        assert numbers(taken, "fast/4") == list(range(5)) and not numbers(taken, "slow/4")
        gate.set()
        while (some := source.take(0.2)) is not None:
            taken += some
    assert numbers(taken, "slow/4") == [0]


class Telling(FakeLink):
    def notices(self):
        return [Notice(self.reads, "back", f"before read {self.reads}")]


def test_what_is_told_comes_before_the_scans_that_are_given_with_it():
    taken = take_all(
        Source(Telling([[make_scan(n)] for n in range(20)]), LastingLink(FakeLink([]), None, name="other"))
    )
    order = [one.text if isinstance(one, Notice) else one.number for one in taken]
    assert order[:40] == [x for n in range(20) for x in (f"before read {n + 1}", n)]


def test_one_that_gives_up_ends_all_after_its_scans_and_what_it_told():
    lost = FakeLink([[make_scan(0)]], error=LinkLostError("gone"))
    told = [Notice(0, "lost", "told")]
    lost.notices = lambda: [] if lost.reads < 2 or not told else [told.pop()]
    other = FakeLink([], endless=True)
    taken = []
    with Source(lost, LastingLink(other, None, name="other")) as source:
        with pytest.raises(LinkLostError, match="gone"):
            while True:
                taken += source.take(0.2) or ()
        with pytest.raises(LinkLostError, match="gone"):
            source.take(0)
    assert sorted(type(one).__name__ for one in taken) == ["Notice", "Scan"]


def test_the_kind_of_several_is_what_they_are_once_open():
    class Late(FakeLink):
        def __enter__(self):
            self.kind = "emulated"
            return self

    with Source(Late([]), LastingLink(Late([]), None, name="b")) as source:
        assert source.kind == "emulated"
    with pytest.raises(SourceError, match="of several kinds"):
        Source(Late([]), FakeLink([])).__enter__()


def test_emulated_and_real_sources_are_not_mixed():
    with pytest.raises(SourceError, match=r"\(fake is device, fake is emulated\), expected one"):
        Source(FakeLink([]), FakeLink([], kind="emulated"))


@pytest.fixture
def two_adapters():
    recordings = [make_recording(120, seed=seed) for seed in (1, 2)]
    with (
        Emulator(recordings[:1], jitter_s=0.002, seed=1) as left,
        Emulator(recordings[1:], jitter_s=0.002, seed=2) as right,
    ):
        yield recordings, (left, right)


def lasting(adapters):
    names = ("left", "right")
    return [LastingLink(SlcanSerialLink(one.port), name=name) for name, one in zip(names, adapters, strict=True)]


@pytest.mark.parametrize("together_s", [0.0, 0.003])
def test_two_ports_are_read_in_one_thread_and_nothing_is_lost_or_mixed_up(two_adapters, together_s):
    recordings, adapters = two_adapters
    before = set(threading.enumerate())
    threads, taken = set(), []
    with Source(*lasting(adapters)) as source:
        source.set_pace(Pace(together_s))
        end_s = time.monotonic() + 30
        while any(len(numbers(taken, f"{name}/4")) < 90 for name in ("left", "right")):
            assert time.monotonic() < end_s
            taken += source.take(0.2) or ()
            if len(taken) > 40:  # both are open and have sent by then
                threads |= {thread.name for thread in set(threading.enumerate()) - before}
        counters = source.counters()
    assert threads == {"scan-reader"}
    assert not set(threading.enumerate()) - before, "a thread outlived the source"
    for recording, name in zip(recordings, ("left", "right"), strict=True):
        mine = [one for one in taken if isinstance(one, Scan) and one.sensor == f"{name}/4"]
        assert [scan.number for scan in mine] == list(range(len(mine)))
        assert all(a.time_ns <= b.time_ns for a, b in itertools.pairwise(mine))  # what is read together, arrives so
        played = recording.tracks[0].counts
        whole = [scan for scan in mine if scan.complete]
        first = next(row for row in range(len(played)) if np.array_equal(played[row], whole[0].counts))
        if counters["torn_wire"] == 0:
            assert np.array_equal(stacked(whole, f"{name}/4"), played[first : first + len(whole)])
    assert counters["frames"] == counters["readings"] and counters["torn_source"] == 0
    assert counters["outages"] == counters["reopenings"] == 0


def test_a_port_that_is_away_holds_up_no_other_and_comes_back_to_the_common_thread(tmp_path):
    """The left adapter is pulled out for a while; the right one's scans go on meanwhile, each of them."""
    recordings = [make_recording(120, seed=seed) for seed in (1, 2)]
    names = []
    before = set(threading.enumerate())
    with Emulator(recordings[:1], loop=True, jitter_s=0) as gone, Emulator(recordings[1:], loop=True) as stays:
        port = tmp_path / "left"
        port.symlink_to(gone.port)
        links = [
            LastingLink(SlcanSerialLink(str(port)), name="left"),
            LastingLink(SlcanSerialLink(stays.port), name="right"),
        ]
        with Source(*links) as source:

            def wait_for(done, limit_s=20):
                taken, end_s = [], time.monotonic() + limit_s
                while not done(taken):
                    assert time.monotonic() < end_s, [one for one in taken if isinstance(one, Notice)]
                    taken += source.take(0.1) or ()
                return taken

            wait_for(lambda taken: len(numbers(taken, "left/4")) >= 5 and len(numbers(taken, "right/4")) >= 5)
            outages = source.counters()["outages"]
            port.unlink()  # or another test's terminal of the same number would come back under this name
            gone.__exit__(None, None, None)
            taken = wait_for(lambda taken: len(numbers(taken, "right/4")) >= 100)
            assert [(one.kind, one.sensors) for one in taken if isinstance(one, Notice)] == [("lost", "left/")]
            heard = [one for one in taken if isinstance(one, Scan) and one.sensor == "right/4"]
            assert [scan.number for scan in heard] == list(range(heard[0].number, heard[0].number + len(heard)))
            names += [thread.name for thread in set(threading.enumerate()) - before]
            with Emulator(recordings[:1], loop=True, jitter_s=0) as again:
                port.symlink_to(again.port)
                taken = wait_for(lambda taken: len(numbers(taken, "left/4")) >= 20)
                assert [one.kind for one in taken if isinstance(one, Notice)] == ["back"]
                back = next(index for index, one in enumerate(taken) if isinstance(one, Notice))
                assert not numbers(taken[:back], "left/4"), "scans from behind the outage came before word of it"
                readers = {t.name for t in threading.enumerate() if t.name.startswith(("link-", "scan-"))}
                assert readers == {"scan-reader"}
                assert source.counters()["outages"] == outages + 1
    assert [name for name in names if name.startswith("scan-reader")]
    assert not {thread for thread in set(threading.enumerate()) - before if thread.name.startswith(("link-", "scan-"))}


def test_the_source_closes_at_once_while_a_link_is_away():
    links = [
        LastingLink(FakeLink([], error=LinkLostError("gone"))),
        LastingLink(FakeLink([], endless=True), None, name="right"),
    ]
    before = set(threading.enumerate())
    with Source(*links) as source:
        while not any(isinstance(one, Notice) for one in source.take(0.2) or ()):
            pass
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < 2
    assert not set(threading.enumerate()) - before
