"""Diagnostics of the ROS 2 sink: once a second, and true about silence and recordings."""

import time
from dataclasses import replace

import pytest
from ros2_samples import ENVIRONMENT, contact, keep_published, sink

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

from edge_samples import BASELINE, make_contract, make_scan

from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.sinks.registry import open_sink
from edge.sinks.ros2.diagnostics import Level
from edge.sinks.ros2.sink import Ros2Sink
from firmware_bridge.links.base import Notice

__all__ = ["sink"]


class Clock:
    def __init__(self):
        self.now_ns = 10**12

    def __call__(self):
        return self.now_ns


def test_diagnostics_come_once_a_second_and_tell_of_silence_and_what_it_was():
    clock, published = Clock(), []
    sink = Ros2Sink("skin", ENVIRONMENT, clock_ns=clock, unix_ns=lambda: 1_700_000_000_123_456_789)
    keep_published(sink, published)

    def statuses():
        taken = [status for message in published for status in message.get("status", ())]
        published.clear()
        return [(status["level"], status["message"]) for status in taken]

    scan = make_scan(1, time_ns=clock.now_ns)
    idle = Result(scan, "device", "m", "idle", contact=False, baseline=BASELINE, baseline_age_s=3.0)
    for _ in range(250):
        clock.now_ns += 10_000_000
        sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns)), {"dropped": 2})
    assert statuses() == [(Level.WARN, "2 dropped"), (Level.OK, "idle")]
    sink.tell(Event(clock.now_ns, "trouble", None, "bus-off"), {"dropped": 2})
    clock.now_ns += 1_500_000_000
    sink.wait()
    sink.wait()
    assert statuses() == [(Level.STALE, "no scan for 2 s; bus-off")]
    sink.tell(Event(clock.now_ns, "well", None, "well again"), {"dropped": 2})
    sink.tell(Event(clock.now_ns, "silent", "5", "another is silent"), {"dropped": 2})
    clock.now_ns += 1_000_000_000
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), dead={3: "stuck"}), {"dropped": 2})
    assert statuses() == [(Level.WARN, "without taxel 3 (stuck)")]
    clock.now_ns += 1_000_000_000
    doubtful = {"state": "contact", "trusted": False, "untrusted_reason": "unexplained"}
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), **doubtful), {"dropped": 2})
    (status,) = statuses()
    assert status[0] == Level.WARN
    assert status[1].startswith("pattern not to be believed: the pattern does not explain its readings")
    clock.now_ns += 1_000_000_000
    doubt = {
        "state": "baseline_in_doubt",
        "contact": None,
        "trusted": False,
        "notes": (Note("baseline_in_doubt", "why"),),
    }
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), **doubt), {"dropped": 2})
    assert statuses() == [(Level.ERROR, "why")]
    published.clear()
    sink.tell(Event(clock.now_ns, "lost", None, "the plug is out"), {})
    sink.close()
    began_ns = 1_700_000_000_123_456_789
    stamp = published[-1]["header"]["stamp"]
    passed_ns = clock.now_ns - 10**12
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == began_ns + passed_ns, "wall time, from the start's on"


DAYS_NS = 3 * 86_400 * 10**9


def test_what_is_not_of_now_has_the_times_of_its_recording_and_is_not_called_silent():
    """Recorded on a machine that was up for three days more than this one."""
    recorded_ns, offset_ns = time.monotonic_ns() + DAYS_NS, 1_600_000_000 * 10**9
    published, later_ns = [], time.monotonic_ns() + 60 * 10**9
    with pytest.MonkeyPatch.context() as patch:
        for name, value in ENVIRONMENT.items():
            patch.setenv(name, value)
        sink = open_sink("ros2:skin", make_contract(), unix_offset_ns=offset_ns, source="replay")
    sink._clock_ns = lambda: later_ns
    keep_published(sink, published)
    result = contact(1, source="replay", force_n=1.0)
    sink.write(replace(result, scan=replace(result.scan, time_ns=recorded_ns)), {})
    sink.close()
    stamps = [one["header"]["stamp"] for one in published if "header" in one]
    assert {stamp["sec"] * 10**9 + stamp["nanosec"] for stamp in stamps} == {recorded_ns + offset_ns}
    said = [status for one in published for status in one.get("status", ())]
    assert [status["message"] for status in said] == ["REPLAY, not a sensor", "ended"]
    assert "scan_age_s" not in {pair["key"] for status in said for pair in status["values"]}


def test_an_outage_of_one_link_takes_nothing_from_the_sensors_of_another(sink):
    for name in ("left/4", "right/4"):
        sink.write(contact(1, sensor=name), {})
    left, right = sink._sensors["left/4"], sink._sensors["right/4"]
    for kind in ("lost", "trouble"):
        sink.tell(Event.of(Notice(time.monotonic_ns(), kind, "left: the plug is out", "left/")), {})
    assert left.trouble.keys() == {"lost", "trouble"} and not left.shown
    assert right.trouble == {} and len(right.shown) == 2
    sink.tell(Event.of(Notice(time.monotonic_ns(), "well", "right: well", "right/")), {})
    assert left.trouble.keys() == {"lost", "trouble"}
