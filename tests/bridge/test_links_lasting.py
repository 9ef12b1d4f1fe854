"""Links that come back, on a clock of their own."""

import itertools
from dataclasses import replace

import pytest
from edge_samples import make_scan

from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import LATE_RETRY_S, LINK_SILENT_S, SOON_RETRY_S, SOON_S, Link, LinkReader, Unread

S = 1_000_000_000


class World(Link):
    """A link, and its clock: it is there at some times, speaks at some, and then gives a scan at every read."""

    def __init__(self, *, away=(), mute=()):
        self.name, self.kind, self.ended = "slcan:x", "device", False
        self.now_ns, self.away, self.mute = 0, away, mute
        self.opened_at_s: list[float] = []
        self.tried_at_s: list[float] = []
        self.is_open, self.scans = False, 0

    def sleep(self, time_s):
        self.now_ns += round(time_s * S)

    def within(self, *stretches):
        return any(start <= self.now_ns / S < end for start, end in stretches)

    def __enter__(self):
        assert not self.is_open, "opened twice"
        self.tried_at_s.append(self.now_ns / S)
        if self.within(*self.away):
            raise DeviceError("x: no such port")
        self.is_open = True
        self.opened_at_s.append(self.now_ns / S)
        return self

    def __exit__(self, *exc_info):
        assert self.is_open, "closed twice"
        self.is_open = False

    def read(self, timeout_s):
        assert self.is_open, "read while closed"
        self.sleep(0.01)
        if self.within(*self.away):
            raise LinkLostError("x: link lost")
        self.scans += not self.within(*self.mute)
        return [] if self.within(*self.mute) else [make_scan(self.scans)]

    def counters(self):
        return {"scans": self.scans}


def reader_of(world, give_up_s=float("inf")):
    return LinkReader(world, give_up_s, clock_ns=lambda: world.now_ns, sleep=world.sleep)


def lasting(world, until_s, give_up_s=float("inf")):
    """Read until a time; all notices, the link, and when scans came, in [s]."""
    notices, heard_s = [], []
    with reader_of(world, give_up_s) as link:
        while world.now_ns < until_s * S:
            scans = link.read(0.1)
            notices += link.notices()
            heard_s += [world.now_ns / S] * len(scans)
    return notices, link, heard_s


def kinds(notices):
    return [notice.kind for notice in notices]


SILENT_S = 1.0 + LINK_SILENT_S


@pytest.mark.parametrize(
    ("away", "mute", "told", "back_s", "within_s"),
    [
        *(([(1.0, back_s)], [], ["lost", "back"], back_s, SOON_RETRY_S) for back_s in (1.05, 3.7, 59.0)),
        ([(1.0, 200.0)], [], ["lost", "back"], 200.0, LATE_RETRY_S),
        # An adapter that was reset has a port, but its channel is closed until it is opened.
        ([], [(1.0, SILENT_S + 0.015)], ["silent", "back"], SILENT_S, 0.1),
        # A silence that turns out a loss is one outage; a device that has to settle is not opened over and over.
        ([(SILENT_S, 5.0)], [(1.0, SILENT_S), (5.0, 4.0 + SILENT_S - 0.1)], ["silent", "lost", "back"], 5.0, 1.0),
    ],
)
def test_one_that_is_back_is_used_soon_and_told_once(away, mute, told, back_s, within_s):
    world = World(away=away, mute=mute)
    notices, link, heard_s = lasting(world, back_s + 3)
    assert kinds(notices) == told and len(world.opened_at_s) == len(told)
    used_s = min(time_s for time_s in heard_s if time_s > back_s)
    assert used_s - back_s <= within_s + 0.02
    assert notices[-1].text.startswith("slcan:x is back after ")
    assert float(notices[-1].text.split()[-2]) == pytest.approx(used_s - 1.0, abs=0.1)
    assert (link.counters()["outages"], link.counters()["reopenings"]) == (1, len(told) - 1)
    late_s = [time_s for time_s in world.tried_at_s if time_s > 1.0 + SOON_S + LATE_RETRY_S]
    assert all(after - before == pytest.approx(LATE_RETRY_S, abs=0.01) for before, after in itertools.pairwise(late_s))


@pytest.mark.parametrize(
    ("stretches", "words", "at_most_s"),
    [
        ({"away": [(1.0, 100.0)]}, r"slcan:x was away for 5 s: x: no such port", 6.6),
        ({"mute": [(1.0, 100.0)]}, r"slcan:x gave no scan for \d s: check the sensor's power", 9.0),
    ],
)
def test_a_link_that_is_away_or_silent_for_too_long_is_given_up(stretches, words, at_most_s):
    world = World(**stretches)
    with pytest.raises(LinkLostError, match=words):
        lasting(world, 60.0, give_up_s=5.0)
    assert 6.0 <= world.now_ns / S < at_most_s


def test_where_it_may_not_be_lost_silence_is_left_alone():
    world = World(away=[(32.0, 39.0)], mute=[(0.5, 30.0)])
    with pytest.raises(LinkLostError, match=r"^x: link lost$"):
        lasting(world, 60.0, give_up_s=0)
    assert world.now_ns // S == 32 and len(world.opened_at_s) == 1


@pytest.mark.parametrize("error", [AssertionError(), ValueError("a\nb"), OSError(5, "bus")])
def test_an_error_of_any_class_is_a_loss_and_it_is_opened_again(error):
    """Libraries raise what nobody foresees, when they read, open and close."""

    class Broken(World):
        def __enter__(self):
            if self.within((1.0, 2.0)):
                raise error
            return super().__enter__()

        def read(self, timeout_s):
            scans = super().read(timeout_s)
            if self.within((1.0, 2.0)):
                raise error
            return scans

        def __exit__(self, *exc_info):
            super().__exit__()
            raise error

    notices, _, heard_s = lasting(Broken(), 4.0)
    assert kinds(notices) == ["lost", "back"] and len(heard_s) > 200
    told = (
        f"slcan:x: link lost by an unforeseen {' '.join(f'{type(error).__name__} {error}'.split())} (bridge/test_links"
    )
    assert notices[0].text.startswith(told) and "\n" not in notices[0].text


def test_the_first_opening_must_succeed():
    with pytest.raises(DeviceError, match="no such port"):
        lasting(World(away=[(0.0, 1.0)]), 1.0)


def test_trouble_is_told_twice_and_lost_stamps_once():
    world, notices = World(), []
    with reader_of(world) as link:
        for trouble, dropped in ((None, False), ("bus-off", False), ("bus-off", True), (None, True)):
            world.trouble, world.stamps_dropped = trouble, dropped
            link.read(0.1)
            notices += link.notices()
    assert [(notice.kind, notice.text.split(",")[0]) for notice in notices] == [
        ("trouble", "bus-off"),
        ("note", "slcan:x: its time stamps do not run as this machine's clock does"),
        ("well", "slcan:x reports no trouble"),
    ]


def test_a_clock_set_by_readings_that_waited_gives_no_times():
    """Stamps of readings that nobody fetched set the adapter's clock, and by it they were new."""
    unread, ms = Unread(), 1_000_000
    unread.empty_ns = 0
    scan = replace(make_scan(0), time_ns=100 * ms, device_ns=99 * ms)
    (old,) = unread.mark([scan], 100 * ms, clock_begun_ns=100 * ms)
    assert (old.unread_ns, old.device_ns, old.not_before_ns) == (100 * ms, None, 0)
    (old,) = unread.mark([scan], 101 * ms, clock_begun_ns=-ms)
    assert (old.unread_ns, old.device_ns) == (100 * ms, 99 * ms)
    unread.note_data(101 * ms, 103 * ms)
    assert unread.empty_ns == 0, "until all data is read, the duration of a read is no evidence"
    unread.empty_ns = 101 * ms
    assert unread.mark([replace(scan, time_ns=102 * ms)], 102 * ms, None)[0].unread_ns == 0
