"""Recordings that a viewer of the live page asks for."""

import json
import re
import threading
import time

import numpy as np
from view_samples import CONTRACT, TIMEOUT_S, Press, wait_for

from edge.errors import SinkError
from edge.perception.event import Event
from edge.pipeline.commands import Command, Commands, obey
from edge.pipeline.sink import Sink
from edge.sinks.registry import open_sink
from edge.view.recorder import Recorder
from edge.view.viewer_commands import execute
from edge.view.viewer_state import Viewer
from firmware_bridge.recording.formats import load_recording


class Failing(Sink):
    """Takes so many results, or does not close."""

    def __init__(self, takes, closes=True):
        self.takes, self.closes, self.closed = takes, closes, 0

    def write(self, result, counters):
        self.takes -= 1
        if self.takes < 0:
            raise SinkError("disk full")

    def close(self):
        self.closed += 1
        if not self.closes:
            raise SinkError("no room for the end")


class TestRecorder:
    AT = time.struct_time((2026, 11, 22, 5, 6, 7, 6, 326, 0))

    def recorder(self, directory, opener=None):
        told = []
        opener = opener or (lambda text: open_sink(text, CONTRACT))
        recorder = Recorder(directory, told.append, local_time=lambda: self.AT)
        recorder.open_sink = opener
        return recorder, told

    def begin(self, recorder):
        """Ask for a recording, and go on until its file is open, or cannot be."""
        recorder.record(True)
        wait_for(lambda: recorder.wait() or recorder._opening is None)
        return recorder.path

    def end(self, recorder):
        """Ask for its end, and go on until it is written."""
        recorder.record(False)
        wait_for(lambda: recorder.wait() or recorder._closing is None)

    def test_what_comes_while_it_is_on_is_recorded(self, tmp_path):
        recorder, told = self.recorder(tmp_path)
        press = Press()
        recorder.write(press.next(), {})
        path = self.begin(recorder)
        assert path is not None and re.fullmatch(r"edge-20261122-050607\.\w+", path.name)
        results = press.take(3)
        for result in results:
            recorder.write(result, {})
        recorder.record(True)  # as from a second viewer
        recorder.record(False)
        recorder.record(False)
        recorder.write(press.next(), {})
        recorder.close()
        assert recorder.path is None
        assert [event.text for event in told] == [f"recording into {path}", f"recorded into {path}"]
        assert [event.kind for event in told] == ["note", "note"]
        [track] = load_recording(path).tracks
        np.testing.assert_array_equal(track.counts, [result.scan.counts for result in results])

    def test_nobody_waits_until_a_file_is_open(self, tmp_path):
        disk = threading.Event()
        sink = Failing(takes=9)
        recorder, told = self.recorder(tmp_path, lambda text: disk.wait(TIMEOUT_S) and sink)
        results = Press().take(3)
        recorder.record(True)
        recorder.write(results[0], {})
        assert (recorder.path, told, sink.takes) == (None, [], 9)
        disk.set()
        wait_for(lambda: recorder.wait() or recorder.path)
        recorder.write(results[1], {})
        assert sink.takes == 8 and told[0].text == f"recording into {recorder.path}"

    def test_one_that_is_not_wanted_any_more_once_its_file_is_open_ends_at_once(self, tmp_path):
        disk = threading.Event()
        sink = Failing(takes=9)
        recorder, told = self.recorder(tmp_path, lambda text: disk.wait(TIMEOUT_S) and sink)
        recorder.record(True)
        recorder.record(False)
        disk.set()
        wait_for(lambda: recorder.wait() or sink.closed)
        recorder.close()
        assert sink.closed == 1 and [event.text.split()[0] for event in told] == ["recording", "recorded"]

    def test_the_end_of_the_run_waits_for_one_that_is_being_opened(self, tmp_path):
        sink = Failing(takes=9)
        recorder, told = self.recorder(tmp_path, lambda text: time.sleep(0.2) or sink)
        recorder.record(True)
        recorder.close()
        assert sink.closed == 1 and [event.text.split()[0] for event in told] == ["recording", "recorded"]

    def test_a_second_recording_in_the_same_second_leaves_the_first_alone(self, tmp_path):
        recorder, _ = self.recorder(tmp_path)
        paths = []
        for result in Press().take(3):
            paths.append(self.begin(recorder))
            recorder.write(result, {})
            self.end(recorder)
        assert len(set(paths)) == 3 and all(path.exists() for path in paths)

    def test_the_end_of_the_run_ends_it(self, tmp_path):
        recorder, _ = self.recorder(tmp_path)
        path = self.begin(recorder)
        recorder.write(Press().next(), {})
        recorder.close()
        assert path is not None and path.exists()

    def test_a_place_where_nothing_can_be_made_is_told_and_ends_no_run(self, tmp_path):
        recorder, told = self.recorder(tmp_path / "nowhere")
        self.begin(recorder)
        recorder.write(Press().next(), {})
        assert recorder.path is None
        assert [event.kind for event in told] == ["sink"] and told[0].text.startswith("not recording: ")

    def test_a_failure_while_it_is_on_ends_the_recording_and_no_run(self, tmp_path):
        sink = Failing(takes=2)
        recorder, told = self.recorder(tmp_path, lambda text: sink)
        self.begin(recorder)
        for result in Press().take(5):
            recorder.write(result, {})
        assert recorder.path is None
        self.end(recorder)
        assert sink.closed == 1
        assert [(event.kind, event.text) for event in told[1:]] == [("sink", "the recording has ended: disk full")]
        assert self.begin(recorder) is not None

    def test_nobody_waits_for_the_end_of_one_and_the_next_begins_behind_it(self, tmp_path):
        written = threading.Event()
        sink = Failing(takes=9)
        sink.close = written.wait
        recorder, told = self.recorder(tmp_path, lambda text: sink)
        path = self.begin(recorder)
        recorder.record(False)
        recorder.record(True)
        assert recorder.path is None
        assert [(event.kind, event.text[:14]) for event in told[1:]] == [("refused", "not recording:")]
        written.set()
        self.end(recorder)
        assert told[-1].text == f"recorded into {path}"
        assert self.begin(recorder) is not None

    def test_a_failure_while_nothing_comes_ends_the_recording_and_no_run(self, tmp_path):
        sink = Failing(takes=9)
        sink.takes, sink.wait = 0, lambda: sink.write(None, {})
        recorder, told = self.recorder(tmp_path, lambda text: sink)
        self.begin(recorder)
        recorder.wait()
        assert recorder.path is None and told[-1].text == "the recording has ended: disk full"

    def test_a_name_that_the_disk_cannot_have_is_told_and_ends_no_run(self, tmp_path):
        recorder, told = self.recorder(tmp_path / ("a" * 300))
        self.begin(recorder)
        assert told[-1].kind == "sink" and "not recording: cannot record into" in told[-1].text

    def test_one_that_cannot_be_finished_is_told(self, tmp_path):
        recorder, told = self.recorder(tmp_path, lambda text: Failing(takes=9, closes=False))
        self.begin(recorder)
        recorder.close()
        assert told[-1].kind == "sink" and told[-1].text.endswith("could not be finished: no room for the end")

    def test_events_and_what_is_left_out_go_through(self, tmp_path):
        class Slow(Failing):
            unwritten = 3

            def tell(self, event, counters):
                self.told = event

        sink = Slow(9)
        recorder, _ = self.recorder(tmp_path, lambda text: sink)
        assert recorder.unwritten == 0
        self.begin(recorder)
        event = Event(1, "lost", None, "gone")
        recorder.tell(event, {})
        assert sink.told is event and recorder.unwritten == 3
        recorder.record(False)
        assert recorder.unwritten == 3

    def test_to_record_is_not_to_zero(self):
        class Untouched:
            def reset(self):
                raise AssertionError

            zero = reset

        asked = Commands()
        execute('{"cmd": "record", "on": true}', Viewer(), asked)
        obey(asked, Untouched())

    def test_commands_to_record_are_done_and_the_others_handed_on(self, tmp_path):
        recorder, _ = self.recorder(tmp_path, lambda text: Failing(9))
        commands = Commands()
        commands.record = recorder.record
        for message in ({"cmd": "zero"}, {"cmd": "record", "on": True}, {"cmd": "reset"}, {"cmd": "jump"}):
            execute(json.dumps(message), Viewer(), commands)
        assert recorder.path is None  # not before the loop asks
        assert list(commands.poll()) == [Command("zero"), Command("reset")]
        wait_for(lambda: recorder.wait() or recorder.path is not None)
        assert commands.refused == 1
