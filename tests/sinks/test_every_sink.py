"""Contract of every sink: each kind of result and event comes back, it fails alone, and ends cleanly."""

import contextlib
import os
import resource
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from edge_samples import ROOT, ListSink, fake_source
from sink_samples import (
    CONTRACT,
    EVENTS,
    PERIOD_NS,
    RUN,
    Jsonl,
    Mcap,
    every_kind,
    make_results,
    make_sure_results,
)

from edge.api import Fan, LinkLostError, PadPose, Sink, SinkError, TimedPose, UsageError
from edge.sinks.json_records import COUNTED_NS
from edge.sinks.registry import FORMS, check_sink, open_sink


@pytest.fixture(params=[Jsonl, Mcap], ids=lambda kind: kind.__name__.lower())
def opened(request, tmp_path):
    """A sink of a file, with its reader; other kinds have tests of their own."""
    return request.param(tmp_path)


def test_each_kind_of_result_and_event_comes_back(opened):
    results = every_kind()
    sink: Sink = opened.sink
    sink.pose([TimedPose(PadPose(1, 2), 3)])
    for result in results:
        sink.write(result, RUN)
    for event in EVENTS[:2]:
        sink.tell(event, RUN)
    sink.wait()
    sink.close()
    assert sink.unwritten == 0
    for got, result in zip(opened.results(), results, strict=True):
        names = (got[name] for name in ("sensor", "scan", "source", "state", "trusted"))
        assert (*names,) == (result.scan.sensor, result.scan.number, result.source, result.state, result.trusted)
        assert got["force_counts"] == pytest.approx(result.force_counts, abs=0.051)
        assert (got["pattern"] is None) == (result.pattern is None)
        assert result.pattern is None or got["pattern"] == pytest.approx(result.pattern, abs=1e-6)
    assert opened.events() == [(event.kind, event.text) for event in EVENTS[:2]]


def test_one_that_ends_without_a_result_leaves_nothing_behind(opened, tmp_path):
    opened.sink.wait()
    opened.sink.close()
    assert [path.name for path in tmp_path.iterdir() if path.stat().st_size] == []


def test_counters_come_once_a_second_and_where_losses_change(opened):
    (first, *_) = make_sure_results(1)
    losses = (0, 0, 2, 2, 2, 2, 2)
    times_ns = (0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS, COUNTED_NS, COUNTED_NS + 2 * PERIOD_NS, 5)  # played again
    for number, (lost, time_ns) in enumerate(zip(losses, times_ns, strict=True)):
        scan = replace(first.scan, number=number, time_ns=time_ns)
        opened.sink.write(replace(first, scan=scan), {"scans": number, "dropped": lost})
    opened.sink.close()
    counted = {one["scan"]: one["counters"]["dropped"] for one in opened.results() if "counters" in one}
    assert counted == {0: 0, 2: 2, 5: 2, 6: 2}


def test_a_file_that_finds_no_more_room_holds_whole_records(tmp_path):
    """A recording for replay does, too: tests/bridge/test_mcap_commands.py."""
    opened, contact, before = Jsonl(tmp_path), every_kind()[3], resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    try:
        with pytest.raises(SinkError, match=r"cannot write records to .*out\.jsonl: File too large"):
            for number in range(2400):
                opened.sink.write(replace(contact, scan=replace(contact.scan, number=number)), RUN)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [line["scan"] for line in opened.lines()] == list(range(len(opened.lines()))) != []


def gone(tmp_path: Path) -> Sink:
    """Return a sink whose reader has left."""
    os.mkfifo(tmp_path / "fifo")
    reader = os.open(tmp_path / "fifo", os.O_RDONLY | os.O_NONBLOCK)
    sink = open_sink(f"jsonl:{tmp_path}/fifo", CONTRACT, fake_source())
    os.close(reader)
    return sink


def full(tmp_path: Path) -> Sink:
    return open_sink("jsonl:/dev/full", CONTRACT, fake_source())


def failing(*given):
    raise SinkError("disk full")


def fan_of(*sinks, tell=lambda event: None, clock_ns=lambda: 11):
    fan = Fan(tell, clock_ns)
    for sink in sinks:
        fan.add(sink)
    return fan


@pytest.mark.parametrize("bad", [full, gone])
def test_a_failing_sink_is_reported_and_the_others_go_on(bad, tmp_path):
    events, good = [], ListSink()
    fan = fan_of(bad(tmp_path), good, tell=events.append)
    results = every_kind()
    for result in results:
        fan.write(result, RUN)
    assert bool(fan.failures) == (bad is not gone)
    with pytest.raises(SinkError, match="No space left") if fan.failures else contextlib.nullcontext():
        fan.close()
    assert good.results == results and good.closed
    (event,) = events
    assert event.kind == "sink" and event.text.endswith("; the other sinks continue") and good.events == events


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("jsonl:none/out.jsonl", SinkError, "none/out.jsonl: No such file"),
        ("jsonl:fifo", SinkError, "nobody reads fifo: start its reader first"),
        ("mcap:none/out.mcap", SinkError, "cannot record into none/out.mcap: No such file"),
        ("mcap:taken.mcap", SinkError, "taken.mcap exists: give another name, or delete it first"),
        *((f"mcap:{name}", UsageError, "a file whose name ends in .mcap") for name in ("a", "/dev/full", "a.npz")),
        ("npz:a.npz", UsageError, "record by --sink mcap:a.mcap, then edge-sr convert a.mcap a.npz"),
        *((f"shm:{name}", SinkError, "cannot be a name") for name in ("a/b", "../x", ".x", "a b", "x" * 101)),
        *((f"ros2:{name}", UsageError, "is not a ROS topic") for name in ("4", "a//b", "a/", "a b", "\u00e4", "~/a")),
        ("ros2:skin?comands", UsageError, "'comands' after its topic, expected ros2:TOPIC or ros2:TOPIC?commands"),
        ("zenoh:a//b", UsageError, "'a//b' for a key"),
        ("zenoh:a/*", UsageError, "'a/*' for a key"),
        ("zenoh:@/a", UsageError, "'@/a' for a key"),
        ("zenoh:a?listen=x", UsageError, "'listen=x' after its key: expected zenoh:KEY, zenoh:KEY?connect="),
        ("zenoh:a?connect=here", UsageError, "'connect=here' after its key"),
        ("zenoh:a?", UsageError, "'' after its key"),
        *((f"rerun:{target}", UsageError, "rerun:view") for target in ("press.mcap", "127.0.0.1", "")),
        *(
            (text, UsageError, ", ".join(one.text for one in FORMS.values()))
            for text in ("", "jsonl", "jsonl:", "npz:", "csv:a", "status:x", "x")
        ),
    ],
)
def test_a_sink_that_cannot_open_is_one_line_and_nothing_is_lost(text, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("taken.mcap").write_text("mine")
    os.mkfifo("fifo")
    with pytest.raises(error) as refused:
        open_sink(text, CONTRACT, fake_source())
    assert words in str(refused.value) and str(refused.value).isprintable()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "taken.mcap"]
    assert Path("taken.mcap").read_text() == "mine"
    if error is UsageError:  # known before anything is opened
        with pytest.raises(UsageError):
            check_sink(text)


@pytest.mark.parametrize(
    ("package", "text", "error", "words"),
    [
        ("cyclonedds", "ros2:skin", UsageError, "ros2:skin needs Cyclone DDS: pip install"),
        ("zenoh", "zenoh:a", SinkError, "zenoh: needs eclipse-zenoh: pip install"),
        ("rerun", "rerun:press.rrd", SinkError, "rerun: needs rerun-sdk: pip install"),
    ],
)
def test_without_its_package_one_line_says_how_to_get_it(package, text, error, words, monkeypatch):
    for name in [name for name in sys.modules if name.startswith((package, "edge.sinks.ros2"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(error) as refused:
        open_sink(text, CONTRACT, fake_source())
    assert str(refused.value) == f"{words} '{ROOT}[{text.partition(':')[0]}]'"


@pytest.mark.parametrize("form", ["mcap:out.mcap", "ros2:skin"])
def test_metres_need_a_model_whose_unit_is_known(form, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="patterns are in 'counts', expected mm: use another sink"):
        open_sink(form, replace(CONTRACT, output_unit="counts"), fake_source())
    assert not list(tmp_path.iterdir())


class TestFan:
    def test_lasting_trouble_is_told_once_and_again_when_it_returns(self):
        class Troubled(ListSink):
            trouble = None

        now_ns, told = [0], []
        bad, good = Troubled(), ListSink()
        fan = fan_of(bad, good, tell=told.append, clock_ns=lambda: now_ns[0])
        for time_ms, trouble in ((100, "nobody"), (600, "nobody"), (1200, "nobody"), (1800, None), (2400, "nobody")):
            now_ns[0], bad.trouble = time_ms * 1_000_000, trouble
            fan.write(make_results(1)[0], RUN)
            assert fan.trouble == trouble
        assert [(event.time_ns, event.kind, event.text) for event in told] == [
            (time_ns, "sink", "nobody") for time_ns in (600_000_000, 2_400_000_000)
        ]
        assert good.events == told

    def test_one_that_fails_while_nothing_comes_is_given_up_too(self):
        good, bad = ListSink(), ListSink()
        bad.wait = failing
        fan = fan_of(bad, good)
        fan.write(make_results(1)[0], RUN)
        fan.wait()
        fan.wait()
        assert good.waits == 2 and bad.closed and [event.kind for event in good.events] == ["sink"]
        assert good.told_counters == [RUN]  # and of what was counted nothing is forgotten

    def test_the_runs_own_end_is_raised_not_an_earlier_sinks_failure(self):
        fan = fan_of(ListSink(on_write=failing), ListSink())
        fan.write(make_results(1)[0], RUN)
        with pytest.raises(LinkLostError, match="gone"), contextlib.ExitStack() as closing:
            closing.callback(fan.close)
            raise LinkLostError("gone")

    def test_one_that_cannot_be_finished_hinders_no_other(self):
        bad, good = ListSink(), ListSink()
        bad.close = failing
        fan = fan_of(bad, good)
        with pytest.raises(SinkError, match="disk full"):
            fan.close()
        assert good.closed
