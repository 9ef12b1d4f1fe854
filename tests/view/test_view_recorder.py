"""Recordings that a viewer of the live page asks for, and what `edge-sr --view` does with a port and a recording."""

import json
import re
import socket
import threading
import time

import numpy as np
import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import wait_for
from view_samples import CONTRACT, TIMEOUT_S, Press

from edge.api import Event, Sink, SinkError
from edge.cli.main import main
from edge.sinks.registry import open_sink
from edge.view.recorder import Recorder
from firmware_bridge.recording.formats import load_recording

AT = time.struct_time((2026, 11, 22, 5, 6, 7, 6, 326, 0))


class Disk(Sink):
    """Takes so many results, or does not close; leaves three of them out."""

    unwritten = 3

    def __init__(self, takes=9, closes=True):
        self.takes, self.closes, self.closed, self.told = takes, closes, 0, []

    def write(self, result, counters):
        self.takes -= 1
        if self.takes < 0:
            raise SinkError("disk full")

    def tell(self, event, counters):
        self.told.append(event)

    def close(self):
        self.closed += 1
        if not self.closes:
            raise SinkError("no room for the end")


def make_recorder(directory, opener=None):
    told = []
    recorder = Recorder(directory, told.append, local_time=lambda: AT)
    recorder.open_sink = opener or (lambda text: open_sink(text, CONTRACT))
    return recorder, told


def ask(recorder, told, on):
    """Ask for a recording or its end, and go on until it has come, or cannot."""
    before = len(told)
    recorder.record(on)
    wait_for(lambda: recorder.wait() or len(told) > before)
    return recorder.path


def test_what_comes_while_it_is_on_is_recorded(tmp_path):
    recorder, told = make_recorder(tmp_path)
    press = Press()
    recorder.write(press.next(), {})
    path = ask(recorder, told, True)
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
    assert {event.kind for event in told} == {"note"}
    assert [event.text for event in told] == [f"recording into {path}", f"recorded into {path}"]
    [track] = load_recording(path).tracks
    np.testing.assert_array_equal(track.counts, [result.scan.counts for result in results])


def test_nobody_waits_until_a_file_is_open(tmp_path):
    opens = threading.Event()
    disk = Disk()
    recorder, told = make_recorder(tmp_path, lambda text: opens.wait(TIMEOUT_S) and disk)
    results = Press().take(3)
    recorder.record(True)
    recorder.write(results[0], {})
    assert (recorder.path, recorder.unwritten, told, disk.takes) == (None, 0, [], 9)
    opens.set()
    wait_for(lambda: recorder.wait() or recorder.path)
    recorder.write(results[1], {})
    assert disk.takes == 8 and told[0].text == f"recording into {recorder.path}"
    event = Event(1, "lost", None, "gone")
    recorder.tell(event, {})
    assert disk.told == [event] and recorder.unwritten == 3
    recorder.record(False)
    assert recorder.unwritten == 3


@pytest.mark.parametrize("wanted", [True, False])
def test_one_whose_file_opens_late_is_ended_well(tmp_path, wanted):
    """It is not wanted any more, or the run has ended, once its file is open."""
    opens = threading.Event()
    disk = Disk()
    recorder, told = make_recorder(tmp_path, lambda text: opens.wait(TIMEOUT_S) and disk)
    recorder.record(True)
    if wanted:
        threading.Timer(0.2, opens.set).start()
    else:
        recorder.record(False)
        opens.set()
        wait_for(lambda: recorder.wait() or disk.closed)
    recorder.close()
    assert disk.closed == 1 and [event.text.split()[0] for event in told] == ["recording", "recorded"]


def test_recordings_in_one_second_leave_each_other_alone(tmp_path):
    recorder, told = make_recorder(tmp_path)
    paths = []
    for result in Press().take(3):
        paths.append(ask(recorder, told, True))
        recorder.write(result, {})
        ask(recorder, told, False)
    assert len(set(paths)) == 3 and all(path.exists() for path in paths)


@pytest.mark.parametrize("name", ["nowhere", "a" * 300])
def test_a_place_where_nothing_can_be_made_ends_no_run(tmp_path, name):
    recorder, told = make_recorder(tmp_path / name)
    assert ask(recorder, told, True) is None
    recorder.write(Press().next(), {})
    assert [event.kind for event in told] == ["sink"] and told[0].text.startswith("not recording: ")


@pytest.mark.parametrize("scans_come", [True, False])
def test_a_failure_ends_the_recording_and_no_run(tmp_path, scans_come):
    disk = Disk(takes=2)
    recorder, told = make_recorder(tmp_path, lambda text: disk)
    ask(recorder, told, True)
    if scans_come:
        for result in Press().take(5):
            recorder.write(result, {})
    else:
        disk.takes, disk.wait = 0, lambda: disk.write(None, {})
        recorder.wait()
        del disk.wait
    assert recorder.path is None
    wait_for(lambda: recorder.wait() or disk.closed)
    assert [(event.kind, event.text) for event in told[1:]] == [("sink", "the recording has ended: disk full")]
    assert ask(recorder, told, True) is not None


def test_the_next_begins_behind_the_end_of_the_one_before(tmp_path):
    written = threading.Event()
    disk = Disk()
    disk.close = written.wait
    recorder, told = make_recorder(tmp_path, lambda text: disk)
    path = ask(recorder, told, True)
    recorder.record(False)
    recorder.record(True)
    assert recorder.path is None
    assert [(event.kind, event.text[:14]) for event in told[1:]] == [("refused", "not recording:")]
    written.set()
    ask(recorder, told, False)
    assert told[-1].text == f"recorded into {path}"
    assert ask(recorder, told, True) is not None


def test_one_that_cannot_be_finished_is_told(tmp_path):
    recorder, told = make_recorder(tmp_path, lambda text: Disk(closes=False))
    ask(recorder, told, True)
    recorder.close()
    assert told[-1].kind == "sink" and told[-1].text.endswith("could not be finished: no room for the end")


def test_a_port_in_use_is_one_line_and_5(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["--source", "slcan:/dev/no-such-port", "--view", str(port)]) == 5
    assert capsys.readouterr().err == (
        f"edge-sr: no live page: cannot listen on 127.0.0.1:{port}: address in use; "
        "name another port with --view, or 0 for any free one\n"
    )


def test_a_recording_is_played_as_if_live_where_somebody_is_to_look(tmp_path):
    path = write_recording(tmp_path / "press.csv", make_counts(20), rate_hz=1000)
    for number, (options, live) in enumerate((([], False), (["--paced"], True), (["--view", "0"], True))):
        records, begun_ns = tmp_path / f"{number}.jsonl", time.monotonic_ns()
        assert main(["replay", str(path), "--sink", f"jsonl:{records}", *options]) == 0
        first = json.loads(records.read_text().splitlines()[0])
        assert (first["time_ns"] >= begun_ns) == live, options
