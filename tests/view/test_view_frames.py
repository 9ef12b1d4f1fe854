"""Frames to viewers: sampled, bounded, and the newest."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import PERIOD_NS, Clock, fake_source, unpack
from view_samples import CONTRACT, Press

from edge.perception.event import Event, Note
from edge.sinks.json_records import event_record, record
from edge.view.frames import EVENTS, MAX_FPS, RECENT_SCANS, TRACE_POINTS, TRACE_S, Frames, RunSnapshot, Viewer, hello


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def heard(clock):
    return RunSnapshot(clock)


def look(viewer, heard, clock):
    return [unpack(frame) for frame in viewer.due(Frames(heard, clock(), "emulated"))]


def numbers(header):
    """Numbers of the scans that a trace is of, from their times."""
    return [round(seconds * 1e9 / PERIOD_NS) for seconds, *_ in header["trace"]]


def test_a_result_frame_is_the_record_and_its_maps(heard, clock):
    press = Press(counts_per_newton=1000.0)
    result = replace(press.take(3)[-1], notes=(Note("late", "old"), Note("dead", "taxel 3")))
    heard.write(result, {"dropped": 3})
    clock.now_ns += 70_000_000
    [(header, maps)] = look(Viewer(), heard, clock)
    said = record(result, {"dropped": 3})
    assert header["kind"] == "result" and header["age_s"] == 0.07 and header["note_kinds"] == ["late", "dead"]
    assert {key: header[key] for key in said if key != "counts"} == {k: v for k, v in said.items() if k != "counts"}
    assert header["counts"] == result.scan.counts.tolist() and header["source"] == "emulated"
    assert list(maps) == ["zeroed", "pattern", "deviation"]
    assert all(np.array_equal(values, getattr(result, name)) for name, values in maps.items())
    drawn = [round(result.force_counts, 1), round(result.area_mm2, 2), round(result.force_n, 4)]
    assert header["trace"] == [[0.0, *drawn, None]]


def test_what_is_heard_while_a_frame_is_made_is_left_to_the_next(heard, clock):
    press, viewer = Press(), Viewer()
    heard.write(press.next(), {})
    frames = Frames(heard, clock(), "emulated")
    heard.write(press.next(), {})
    [(first, _)] = map(unpack, viewer.due(frames))
    [(second, _)] = look(viewer, heard, clock)
    assert (first["scan"], numbers(first)) == (0, [0]) and (second["scan"], numbers(second)) == (1, [1])
    assert look(viewer, heard, clock) == [], "nothing is sent twice"


@pytest.mark.parametrize("rate_hz", [8, 100, 1000])
def test_a_newcomer_gets_the_last_minute_thinned(heard, clock, rate_hz):
    press, period_ns = Press(), 10**9 // rate_hz
    idle = press.next(0)
    count = 70 * rate_hz
    spike = count - 30 * rate_hz + (rate_hz > 20) * 3  # neither the first of its 50 ms nor the last
    for number in range(count):  # made over from one: what is drawn is all that matters
        force = 9000.0 if number == spike else 0.0
        scan = replace(idle.scan, number=number, time_ns=number * period_ns)
        heard.write(replace(idle, scan=scan, force_counts=force), {})
    [(header, _)] = look(Viewer(), heard, clock)
    seconds = [point[0] for point in header["trace"]]
    assert len(seconds) <= TRACE_POINTS and seconds == sorted(set(seconds))
    assert seconds[-1] == round((count - 1) / rate_hz, 3)
    assert TRACE_S - 0.25 <= seconds[-1] - seconds[0] <= TRACE_S
    assert max(np.diff(seconds)) <= max(0.1, 1 / rate_hz) + 1e-3
    assert [point[0] for point in header["trace"] if point[1] == 9000.0] == [round(spike / rate_hz, 3)]


def test_a_viewer_long_away_gets_thinned_scans_and_nothing_twice(heard, clock):
    press, viewer = Press(), Viewer()
    heard.write(press.next(0), {})
    look(viewer, heard, clock)
    for result in press.take(2 * RECENT_SCANS, 0):
        heard.write(result, {})
    [(header, _)] = look(viewer, heard, clock)
    got = numbers(header)
    assert got[-1] == 2 * RECENT_SCANS and 1 <= got[0] <= 5 and len(got) <= 2 * RECENT_SCANS / 5 + 2
    assert got == sorted(set(got))


def test_events_come_once_and_a_newcomer_gets_the_latest(heard, clock):
    viewer = Viewer()
    for number in range(EVENTS + 5):
        heard.tell(Event(number, "lost", None, f"gone {number}"), {"outages": number})
    clock.now_ns += 2 * 10**9
    got = look(viewer, heard, clock)
    assert [header["note"] for header, _ in got] == [f"gone {number}" for number in range(5, EVENTS + 5)]
    last = Event(EVENTS + 4, "lost", None, f"gone {EVENTS + 4}")
    said = event_record(last, {"outages": EVENTS + 4}, "emulated")
    assert got[-1][0] == said | {"kind": "event", "number": EVENTS + 5, "age_s": 2.0, "maps": []}
    assert look(viewer, heard, clock) == []
    heard.tell(Event(1, "back", None, "again"), {})
    assert [header["note"] for header, _ in look(viewer, heard, clock)] == ["again"]


def test_a_name_of_any_bytes_can_be_shown(heard, clock):
    path = Path(os.fsdecode(b"\xff.mcap"))
    source = fake_source()
    source.name, source.length_s = f"replay:{path}", 6.7
    header, _ = unpack(hello(source, "mtsr4", CONTRACT))
    assert (header["name"], header["length_s"]) == (r"replay:\xff.mcap", 6.7)
    heard.tell(Event(1, "sink", None, f"recording into {path} stopped"), {})
    assert look(Viewer(), heard, clock)[0][0]["note"] == r"recording into \xff.mcap stopped"


@pytest.mark.parametrize("jitter_ns", [0, 900_000])
def test_every_fourth_of_a_hundred_scans_wakes_and_the_last(clock, heard, jitter_ns):
    start_ns, woken = clock.now_ns, []
    heard.wake = lambda: woken.append(clock())
    for number, result in enumerate(Press().take(400)):
        clock.now_ns = start_ns + number * PERIOD_NS + (jitter_ns if number % 3 else -jitter_ns)
        heard.write(result, {})
    assert 95 <= len(woken) <= 4 * MAX_FPS + 1
    before = len(woken)
    for _ in range(5):  # what came last before a silence is shown once
        clock.now_ns += 100_000_000
        heard.wait()
    assert len(woken) == before + 1
