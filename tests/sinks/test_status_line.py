"""Status line on a terminal."""

import contextlib
import io
import itertools
import os
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import BASELINE, FakeModel, make_scan
from sink_samples import RUN, Terminal, make_results

from edge.api import Event, Note, Runtime
from edge.sinks.status_line import MessageSink, StatusSink


@pytest.mark.parametrize(
    ("kind", "term", "start"),
    [(io.StringIO, "xterm", ""), (Terminal, "dumb", ""), (Terminal, "xterm", "\r\x1b[K")],
)
def test_events_are_lines_that_cannot_control_the_terminal(kind, term, start, monkeypatch):
    """One that knows no escape sequences gets none."""
    monkeypatch.setenv("TERM", term)
    said, shown = kind(), kind()
    messages, status = MessageSink(said), StatusSink(shown)
    messages.tell(Event(0, "trouble", None, "\x1b[2J\x9b\rpad\n\ud800 in µm"), {})
    told = tuple(Event(1, "refused", None, text) for text in ("zeroing refused", "zeroed; again"))
    for sink in (messages, status):
        sink.write(replace(make_results(1)[0], events=told), RUN)
        sink.wait()
        sink.close()
    lines = ("\\x1b[2J\\x9b\\rpad\\n\\ud800 in µm", "zeroing refused", "zeroed; again")
    assert said.getvalue() == "".join(f"{start}edge-sr: {line}\n" for line in lines)
    assert bool(shown.getvalue()) == bool(start)


def test_the_hint_comes_ever_more_seldom_until_the_first_scan():
    stream, now_s = io.StringIO(), [0.0]
    messages = MessageSink(stream, hint=lambda: "is it powered?", clock_s=lambda: now_s[0])
    for now_s[0] in np.arange(0, 60, 0.5):
        messages.wait()
    hints = [f"edge-sr: no scan in {silent_s} s: is it powered?" for silent_s in (5, 10, 20, 40)]
    assert stream.getvalue().splitlines() == hints
    messages.write(make_results(1)[0], RUN)
    now_s[0] = 1000.0
    messages.wait()
    assert stream.getvalue().splitlines() == hints


def test_a_pattern_not_to_be_believed_is_reported_once_a_contact():
    stream = io.StringIO()
    messages = MessageSink(stream)
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    for number in range(12):
        pressed = number % 6 < 4
        result = runtime.push(make_scan(number, press_counts=3000 if pressed else 0))
        doubtful = {"trusted": False, "untrusted_reason": "unfamiliar"} if pressed and number % 2 else {}
        messages.write(replace(result, **doubtful), RUN)
    line = "edge-sr: sensor 4: pattern not to be believed: readings like no contact"
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2 and all(one.startswith(line) for one in lines)


class TestStatus:
    def make(self):
        self.now_s = 0.0
        self.stream = Terminal()
        return StatusSink(self.stream, clock_s=lambda: self.now_s)

    def shown(self):
        return [line.removesuffix("\x1b[K") for line in self.stream.getvalue().split("\r")[1:]]

    @pytest.mark.parametrize(
        ("columns", "line"),
        [
            (160, "EMULATED | 4 contact not checked 3007 counts 22 mm2 | 6 no stored baseline for sensor 6"),
            (53, "EMULATED | 4 contact not checked 3007 counts 22 ..."),
            (3, "..."),
        ],
    )
    def test_a_narrow_terminals_line_has_fewer_words_and_none_cut(self, columns, line, monkeypatch):
        monkeypatch.setenv("COLUMNS", str(columns))
        sink = self.make()
        for result in make_results(8):
            sink.write(result, RUN)
        sink.close()
        shown = self.shown()[-1].rstrip("\n").removesuffix("\x1b[K")
        assert shown.startswith(line) and len(shown) <= max(columns - 1, 4), shown

    @pytest.mark.parametrize(
        ("changes", "line"),
        [
            ({}, "4 contact not checked 3.00 N 22 mm2 "),
            ({"force_n": None}, "4 contact not checked 3000 counts 22 mm2 "),
            ({"trusted": True}, "4 contact 3.00 N "),
            ({"trusted": False, "untrusted_reason": "stuck"}, "4 contact NOT BELIEVED (stuck) 3.00 N "),
            ({"state": "baseline_in_doubt", "trusted": False}, "4 BASELINE IN DOUBT: zero the free pad"),
            ({"dead": {3: "stuck", 7: "silent"}}, "4 contact without taxel 3,7 not checked "),
            ({"source": "replay"}, "REPLAY | 4 contact "),
            ({"state": "zeroing", "notes": (Note("zeroing", "9 scans left"),)}, "4 9 scans left"),
        ],
    )
    def test_the_line_of_a_sensor_says_what_a_person_must_know(self, changes, line):
        sink = self.make()
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE}, counts_per_newton=1000)
        sink.write(replace(runtime.push(make_scan(0, press_counts=3000)), **changes), {})
        assert (sink.line() + " ").startswith(line) and sink.line().isascii()

    def test_the_line_shows_silence_at_most_ten_times_a_second(self, monkeypatch):
        monkeypatch.setenv("COLUMNS", "200")
        sink, (first, other) = self.make(), make_results(1)
        for _ in range(101):
            sink.write(first, {})
            self.now_s += 1 / 64
        assert len(self.shown()) == 1 + 100 // 7 and "no scan" not in self.shown()[-1]  # every 7/64 s
        self.now_s += 3.2
        sink.wait()
        assert self.shown()[-1].startswith("EMULATED | no scan for 3 s | 4 idle")
        sink.write(other, {})  # of another finger, beside which the first must not stand as if it were there
        assert "4 no scan for 3 s" in sink.line() and "6 no scan" not in sink.line()

    def test_a_window_that_was_closed_ends_nothing(self):
        leader, follower = os.openpty()
        stream, result = os.fdopen(follower, "w"), make_results(1)[0]
        sink = StatusSink(stream, clock_s=itertools.count(step=0.2).__next__)
        sink.write(result, {})
        os.close(leader)
        sink.write(result, {})
        sink.close()
        with contextlib.suppress(OSError):  # it still has what nobody took
            stream.close()
