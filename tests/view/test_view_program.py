"""`edge-sr --view` as a user runs it."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import ROOT
from view_samples import TIMEOUT_S, frame
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from edge.cli.main import main
from firmware_bridge.recording.formats import load_recording

DEMO = (sys.executable, "-m", "edge.cli.main", "--source", "demo")


def hear_interrupts():
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_the_demo_serves_two_viewers_until_ctrl_c(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [*DEMO, "--view", "0", "--sink", "jsonl:-", "--view-record-dir", str(tmp_path)]
    # Signals as from a terminal: who started the tests may have SIGINT ignored.
    with subprocess.Popen(command, env=environment, text=True, preexec_fn=hear_interrupts, **pipes) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            lines = iter(process.stderr.readline, "")
            url = next(line for line in lines if line.startswith("live page: ")).split()[2]
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url), "of this machine alone"
            settings = {"origin": url.rstrip("/"), "compression": None}
            with connect(f"ws{url[4:]}ws", **settings) as first, connect(f"ws{url[4:]}ws", **settings) as second:
                hello, result = frame(first)[0], frame(first, "result")[0]
                assert (hello["kind"], hello["name"], hello["source"]) == ("hello", "demo", "emulated")
                assert result["source"] == "emulated"
                while frame(second, "result")[0]["scan"] < 20:
                    pass
                first.send('{"cmd": "record", "on": true}')
                first.send('{"cmd": "zero", "sensor": "9"}')
                notes = {}  # either may come first, as the file is opened in a thread of its own
                while not {"recording", "zeroing"} <= notes.keys():
                    note = frame(first, "event")[0]["note"]
                    notes[note.split()[0]] = note
                assert notes["zeroing"] == "zeroing refused: no sensor 9, there are 4"
                for _ in range(2):
                    frame(first, "result")
                process.send_signal(signal.SIGINT)
                output, errors = process.communicate(timeout=TIMEOUT_S)
                for viewer in (first, second):
                    with pytest.raises(ConnectionClosed) as caught:
                        while True:
                            viewer.recv(TIMEOUT_S)
                    close = caught.value.rcvd
                    assert close is not None and (close.code, close.reason) == (1001, "the run has ended")
        finally:
            process.kill()
    assert process.returncode == 0 and "EMULATED demo:" in errors and "Traceback" not in errors
    [path] = tmp_path.iterdir()
    [track] = load_recording(path).tracks
    assert track.sensor == "4" and len(track.counts) > 2
    scans = [json.loads(line)["scan"] for line in output.splitlines()]
    assert len(scans) > 10 and scans == list(range(len(scans))), "records on stdout are records alone"


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
