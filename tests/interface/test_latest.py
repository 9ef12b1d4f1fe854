"""The newest result of a stream, never an old one as if it were new, and names of sensors that do not exist."""

import asyncio
import itertools
import math
import threading

import pytest
from edge_samples import BASELINE, REST, FakeLink, FakeModel, ListSink, make_scan

from edge.api import Baseline, LinkLostError, NoResultError, Stream, UsageError, open_runtime, paired, take_baselines
from edge.pipeline.commands import Commands
from edge.pipeline.scan_reader import Source
from firmware_bridge.links.base import Notice
from firmware_bridge.poses import PadPose, TimedPose

BASELINES = {"4": BASELINE, "6": Baseline.of("6", REST, 1000.0, 100, "file")}


class StagedLink(FakeLink):
    """Link whose batches come when the test lets them: one stage each, with notices in front of its scans."""

    def __init__(self, *stages, notices=None, **settings):
        self.gates, self.arrived = ([threading.Event() for _ in stages] for _ in range(2))
        parts = zip(self.gates, stages, [event.set for event in self.arrived], strict=True)
        super().__init__(itertools.chain.from_iterable(parts), **settings)
        self._told = dict(notices or {})

    def notices(self):
        stage, part = divmod(self.reads - 1, 3)
        return self._told.pop(stage, []) if part == 1 else []

    def let(self, stage):
        self.gates[stage].set()
        assert self.arrived[stage].wait(10)


def scans(*numbers, sensor="4", press=3000):
    return [make_scan(number, sensor=sensor, press_counts=press) for number in numbers]


def stream_of(source, **settings):
    return Stream(source, open_runtime(settings.pop("model", FakeModel()), source, baselines=BASELINES), **settings)


def test_it_is_the_newest_and_skipped_scans_are_counted_and_kept():
    link, sink = StagedLink(scans(*range(7)), scans(7), endless=True), ListSink()
    waits_s, later_ns = set(), [make_scan(6).time_ns + 5_000_000]
    with Source(link) as source:
        take, source.take = source.take, lambda timeout_s: waits_s.add(timeout_s) or take(timeout_s)
        stream = stream_of(source, sinks=[sink], clock_ns=lambda: later_ns[0])
        before = stream.latest()  # nothing has come, and it does not wait for that
        assert (before.result, before.age_s, before.link, before.new) == (None, math.inf, "up", False)
        link.let(0)
        first = stream.latest()
        assert first.result.scan.number == 6 and first.result.pattern is not None
        assert (first.age_s, first.link, first.new, first.skipped) == (0.005, "up", True, 6)
        later_ns[0] += 10**9
        again = stream.latest()
        assert again.result is first.result and (again.age_s, again.new, again.skipped) == (1.005, False, 0)
        link.let(1)
        assert (stream.latest().skipped, stream.latest().new) == (0, False)
    assert [result.scan.number for result in sink.results] == [*range(8)] and waits_s == {0.0}


def test_it_says_that_a_link_is_lost_and_that_it_is_back():
    told = {1: [Notice(0, "lost", "gone")], 2: [Notice(0, "back", "there")], 3: [Notice(0, "silent", "quiet")]}
    left = StagedLink(scans(0), [], scans(1), [], endless=True, notices=told, prefix="left/")
    right = StagedLink(scans(0), endless=True, prefix="right/")
    states = []
    with Source(left, right) as source:
        stream = stream_of(source)
        right.let(0)
        for stage in range(4):
            left.let(stage)
            both = stream.latest_of_all()
            states.append((both["left/4"].link, both["left/4"].new, both["left/4"].result.scan.number))
            assert both["right/4"].link == "up" and stream.latest("left/4").link == states[-1][0]
    assert states == [("up", True, 0), ("lost", False, 0), ("up", True, 1), ("silent", False, 1)]


def test_a_link_that_is_lost_for_good_is_an_error_at_every_call():
    with Source(FakeLink([scans(0)], error=LinkLostError("gone for good"))) as source:
        stream = stream_of(source)
        assert stream.read().result.scan.number == 0
        for call in (stream.read, stream.latest, stream.latest, lambda: next(iter(stream))):
            with pytest.raises(LinkLostError, match="gone for good"):
                while True:  # the reader's thread may not be there yet
                    call()
    with Source(FakeLink([scans(0)])) as source:  # and one that ends says so
        stream = stream_of(source)
        assert stream.read(timeout_s=10).new
        with pytest.raises(NoResultError, match=r"^no new result: link ended, sensors so far: 4$"):
            stream.read(timeout_s=10)
        latest = stream.latest()
        assert (latest.link, latest.new, latest.result.scan.number) == ("ended", False, 0)
        assert list(stream) == []


def test_of_two_fingers_each_has_its_own():
    link = StagedLink(scans(0) + scans(0, sensor="6"), scans(*range(1, 70), sensor="6"), scans(70), endless=True)
    with Source(link) as source:
        stream = stream_of(source)
        link.let(0)
        assert stream.latest("4").new and stream.latest("6").new
        with pytest.raises(UsageError, match="there are sensors 4, 6: name one of them"):
            stream.latest()
        link.let(1)
        both = stream.latest_of_all()
        assert list(both) == ["4", "6"] and not stream.latest("6").new
        other, mine = both["4"], both["6"]
        assert (other.new, other.result.scan.number, mine.link) == (False, 0, "up")
        assert (mine.new, mine.skipped, mine.result.scan.number) == (True, 68, 69)
        assert stream.latest("4").link == "silent"
        link.let(2)
        assert stream.latest("4").link == stream.latest("6").link == "up"
        with pytest.raises(NoResultError, match="no new result of sensor 4: link up, sensors so far: 4, 6"):
            stream.read("4", timeout_s=0.01)


@pytest.mark.parametrize("way", ["read", "read_async"])
def test_read_passes_over_what_a_loop_had_made_and_left(way):
    """The robot moved meanwhile; and once the source is closed nothing that was left is new."""
    link = StagedLink(scans(*range(3)), scans(3, 4), endless=True)

    def read():
        return stream.read() if way == "read" else asyncio.run(stream.read_async())

    with Source(link) as source:
        stream = stream_of(source)
        link.let(0)
        assert next(iter(stream)).scan.number == 0  # 1 and 2 are made with it
        link.let(1)
        latest = read()
        assert (latest.result.scan.number, latest.new, latest.skipped) == (4, True, 3)
    with pytest.raises(UsageError, match="closed: results that were left are old"):
        read()


def test_a_source_is_opened_once_and_has_one_stream_at_a_time():
    source = Source(FakeLink([scans(0)], endless=True))
    assert repr(source) == "<Source fake, not open>"
    assert source.open() is source and repr(source) == "<Source fake, open>"
    first = stream_of(source)
    assert first.read().new
    for second in (lambda: stream_of(source), lambda: take_baselines(source)):
        with pytest.raises(UsageError, match=r"^source fake has a stream already, .* close\(\)$"):
            second()
    first.close()
    with pytest.raises(UsageError, match="is closed"):
        first.latest()
    stream_of(source)
    for _ in range(2):  # a stream that was dropped, and one that has ended
        assert list(stream_of(source, duration_s=1e-6)) == []
    last = stream_of(source)
    source.close()
    source.close()
    assert repr(source) == "<Source fake, closed>"
    for call in (last.latest, lambda: list(last)):
        with pytest.raises(UsageError, match="source fake is closed"):
            call()
    with pytest.raises(UsageError, match="fake was opened before"):
        source.open()


class SlowModel(FakeModel):
    """Model that runs until the event loop lets it: with a loop that it blocked, it would not end."""

    def __init__(self):
        super().__init__()
        self.begun, self.let = threading.Event(), threading.Event()

    def run(self, *window):
        self.begun.set()
        assert self.let.wait(10), "the event loop is blocked"
        return super().run(*window)


@pytest.mark.parametrize("way", ["iterate", "read"])
@pytest.mark.parametrize("when", ["waiting", "running"])
def test_a_task_that_is_cancelled_loses_no_result(way, when):
    async def main():
        link = StagedLink(scans(0), scans(1, press=4000), endless=True)
        with Source(link) as source:
            model = SlowModel()
            stream = stream_of(source, model=model)

            async def follow():
                if way == "read":
                    return (await stream.read_async(timeout_s=10)).result.scan.number
                return (await anext(aiter(stream))).scan.number

            task = asyncio.create_task(follow())
            if when == "running":
                link.let(0)
                await asyncio.to_thread(model.begun.wait, 10)
            else:
                await asyncio.sleep(0.01)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            model.let.set()
            link.gates[0].set()
            numbers = [await follow()]
            link.gates[1].set()
            return [*numbers, await follow()]

    assert asyncio.run(main()) == [0, 1]


def test_asyncio_is_told_of_errors_and_of_time():
    async def main():
        with Source(FakeLink([scans(0)], error=LinkLostError("gone"))) as source:
            stream = stream_of(source)
            assert (await stream.read_async()).new
            with pytest.raises(LinkLostError):
                async for _ in stream:
                    pass
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("result-stream")]
        with (
            Source(FakeLink([], endless=True)) as source,
            pytest.raises(TimeoutError, match="no new result: link up, sensors so far: none"),
        ):
            await stream_of(source).read_async(timeout_s=0.01)
        return threading.active_count()

    assert asyncio.run(main()) == threading.active_count()


def test_an_unknown_name_is_refused_once_its_link_was_heard():
    """A sensor may still come before; one of another link, or with a baseline, at any time. So it is with a pose."""
    left = StagedLink(scans(0), scans(*range(1, 20)), endless=True, prefix="a/")
    right = StagedLink(scans(0), endless=True, prefix="b/")
    with Source(left, right) as source:
        runtime, commands, sink = open_runtime(FakeModel(), source, baselines={"a/8": BASELINE}), Commands(), ListSink()
        stream = Stream(source, runtime, commands=commands, sinks=[sink])
        with pytest.raises(UsageError, match=r"^no sensor '4': the names begin with a/, b/$"):
            stream.latest("4")
        commands.refuse("a line is refused")
        left.let(0)
        assert stream.latest("a/5").result is stream.latest("b/5").result is None
        commands.poses.put(TimedPose(PadPose(0, 0), 10**9, "a/5"))
        stream.latest("b/5")
        assert sink.events[0].text == "a line is refused"
        assert not [event for event in sink.events if "a pose is refused" in event.text]
        left.let(1)
        stream.latest("b/5")
        commands.poses.put(TimedPose(PadPose(0, 0), 10**9 + 1, "a/5"))
        for call in (stream.latest, stream.read, lambda name: stream.pose(0, 0, sensor=name)):
            with pytest.raises(UsageError, match=r"^no sensor 'a/5': sensors are a/4$"):
                call("a/5")
            with pytest.raises(UsageError, match=r"^no sensor 5: a name is text, such as '4'$"):
                call(5)
        assert sink.events[-1].text == "a pose is refused: no sensor 'a/5': sensors are a/4"
        for name in ("a/8", "b/4", "b/5"):
            assert stream.latest(name).result is None
        right.let(0)
        with pytest.raises(UsageError, match="no sensor 'a/5'"):
            next(paired(stream, ["a/4", "a/5"]))
