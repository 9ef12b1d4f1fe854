"""`edge-sr --view` as a user runs it."""

import json
import os
import re
import signal
import socket
import subprocess
import sys

import pytest
from edge_samples import ROOT
from view_samples import TIMEOUT_S, frame
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from edge.cli.main import main
from edge.pipeline import replay_setup as recordings
from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.formats import load_recording

DEMO = (sys.executable, "-m", "edge.cli.main", "--source", "demo")


@pytest.fixture(scope="module")
def watched_run(tmp_path_factory):
    """The demo with two viewers, ended by Ctrl-C while they look: what everybody got."""
    folder, recorded = tmp_path_factory.mktemp("recorded"), []
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [*DEMO, "--view", "0", "--sink", "jsonl:-", "--view-record-dir", str(folder)]
    # Signals as from a terminal: who started the tests may have SIGINT ignored.
    with subprocess.Popen(command, env=environment, text=True, preexec_fn=_hear_interrupts, **pipes) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            lines = iter(process.stderr.readline, "")
            url = next(line for line in lines if line.startswith("live page: ")).split()[2]
            settings = {"origin": url.rstrip("/"), "compression": None}
            with connect(f"ws{url[4:]}ws", **settings) as first, connect(f"ws{url[4:]}ws", **settings) as second:
                hello, result = frame(first)[0], frame(first, "result")[0]
                while frame(second, "result")[0]["scan"] < 20:
                    pass
                first.send('{"cmd": "record", "on": true}')
                first.send('{"cmd": "zero", "sensor": "9"}')
                notes = []
                while not all(any(note.startswith(told) for note in notes) for told in ("recording", "zeroing")):
                    notes.append(frame(first, "event")[0]["note"])
                while len(recorded) < 2:
                    recorded.append(frame(first, "result")[0]["scan"])
                process.send_signal(signal.SIGINT)
                output, errors = process.communicate(timeout=TIMEOUT_S)
                closed = []
                for viewer in (first, second):
                    with pytest.raises(ConnectionClosed) as caught:
                        while True:
                            viewer.recv(TIMEOUT_S)
                    closed.append(caught.value.rcvd)
        finally:
            process.kill()
    return {
        "url": url,
        "hello": hello,
        "result": result,
        "output": output,
        "errors": errors,
        "closed": closed,
        "code": process.returncode,
        "notes": notes,
        "recordings": [load_recording(path) for path in folder.iterdir()],
    }


def _hear_interrupts():
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_the_address_is_told_and_is_this_machines_alone(watched_run):
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", watched_run["url"])


def test_an_emulated_run_is_told_as_such(watched_run):
    assert watched_run["hello"]["source"] == "emulated" and watched_run["hello"]["name"] == "demo"
    assert watched_run["result"]["source"] == "emulated"


def test_ctrl_c_ends_it_cleanly_with_viewers_attached(watched_run):
    assert watched_run["code"] == 0
    assert [(close.code, close.reason) for close in watched_run["closed"]] == [(1001, "the run has ended")] * 2
    assert "EMULATED demo:" in watched_run["errors"] and "Traceback" not in watched_run["errors"]


def test_what_viewers_ask_is_done(watched_run):
    """Either may come first, as the file is opened in a thread of its own."""
    told = [note for note in watched_run["notes"] if note.startswith(("recording", "zeroing"))]
    begun, refused = sorted(told)
    assert begun.startswith("recording into ")
    assert refused == "zeroing refused: no sensor 9, there are 4"


def test_the_end_of_the_run_ends_the_recording_well(watched_run):
    [recording] = watched_run["recordings"]
    assert [track.sensor for track in recording.tracks] == ["4"] and len(recording.tracks[0].counts) > 2


def test_records_on_stdout_are_records_alone(watched_run):
    scans = [json.loads(line)["scan"] for line in watched_run["output"].splitlines()]
    assert len(scans) > 10 and scans == list(range(len(scans)))


def test_a_port_in_use_is_one_line_and_5(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["--source", "slcan:/dev/no-such-port", "--view", str(port)]) == 5
    assert capsys.readouterr().err == (
        f"edge-sr: no live page: cannot listen on 127.0.0.1:{port}: address in use; "
        "name another port with --view, or 0 for any free one\n"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--view-host", "0.0.0.0"], "--view-host requires --view"),
        (["--view-token", "x" * 20], "--view-token requires --view"),
        (["--view-record-dir", "."], "--view-record-dir requires --view"),
        (
            ["--view", "0", "--view-record-dir", "/dev/null"],
            "--view-record-dir /dev/null: expected a folder that may be",
        ),
        (["--view", "0", "--view-record-dir", "/no/such"], "--view-record-dir /no/such: expected a folder that may be"),
        (["--view", "0", "--view-token", "short"], "a token of 5 characters for the live page: expected at least 12"),
    ],
)
def test_what_makes_no_sense_is_one_line_and_2(capsys, arguments, words):
    assert main(["--source", "demo", *arguments]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert words in errors[-1]


@pytest.mark.parametrize("port", ["65536", "-1", "http"])
def test_what_is_no_port_is_usage(capsys, port):
    with pytest.raises(SystemExit) as caught:
        main(["--source", "demo", f"--view={port}"])
    assert caught.value.code == 2 and "argument --view" in capsys.readouterr().err


def test_a_recording_is_played_at_its_speed_where_somebody_is_to_look(monkeypatch):
    paced = []

    def refuse(path, **settings):
        paced.append(settings["paced"])
        raise RecordingError(f"{path} is only asked for")

    monkeypatch.setattr(recordings, "open_recording", refuse)
    for options in ([], ["--paced"], ["--view"]):
        assert main(["replay", "press.mcap", *options]) == 2
    assert paced == [False, True, True]
