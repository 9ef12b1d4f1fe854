"""Names of sensors that do not exist: refused with those that do, and never while one may still come."""

import pytest
from edge_samples import BASELINE, FakeModel, ListSink
from test_latest import StagedLink, scans, stream_of

from edge.api import Commands, PadPose, Stream, UsageError, open_runtime, paired
from edge.pipeline.commands import Command
from edge.pipeline.scan_reader import Source
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.poses.timed_pose import TimedPose


def test_a_name_that_no_sensor_has_is_refused_once_all_of_its_link_were_heard():
    """A sensor may still come before; one of another link, or with a baseline, at any time."""
    left = StagedLink(scans(0), scans(*range(1, 20)), endless=True)
    right = StagedLink(scans(0), endless=True)
    with Source(LastingLink(left, None, name="a"), LastingLink(right, None, name="b")) as source:
        stream = Stream(source, open_runtime(FakeModel(), source, baselines={"a/8": BASELINE}))
        with pytest.raises(UsageError, match=r"^no sensor '4': the names begin with a/, b/$"):
            stream.latest("4")
        left.let(0)
        assert stream.latest("a/5").result is stream.latest("b/5").result is None
        left.let(1)
        for call in (stream.latest, stream.read, lambda name: stream.pose(0, 0, sensor=name)):
            with pytest.raises(UsageError, match=r"^no sensor 'a/5': sensors are a/4$"):
                call("a/5")
        for name in ("a/8", "b/4", "b/5"):
            assert stream.latest(name).result is None
        right.let(0)
        with pytest.raises(UsageError, match="no sensor 'a/5'"):
            next(paired(stream, ["a/4", "a/5"]))


def test_a_command_for_a_sensor_waits_until_it_is_known_whether_there_is_one():
    link, commands, sink = StagedLink(scans(0), scans(*range(1, 20)), scans(20), endless=True), Commands(), ListSink()
    with Source(link) as source:
        stream = stream_of(source, commands=commands, sinks=[sink])
        commands.put(Command("zero", "9"))
        commands.refuse("a line is refused")
        texts = []
        for stage in range(3):
            commands.poses.put(TimedPose(PadPose(0, 0), 10**9 + stage, "9"))
            stream.latest()
            link.let(stage)
            stream.latest()
            texts.append([event.text for event in sink.events])
            texts[-1] += [event.text for result in sink.results for event in result.events]
    assert "a line is refused" in texts[0] and not [text for text in texts[0] if "no sensor" in text]
    assert {"zeroing refused: no sensor 9, there are 4", "a pose is refused: no sensor '9': sensors are 4"} < {
        *texts[-1]
    }
