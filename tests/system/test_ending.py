"""A signal ends `edge-sr` in time, whatever its clients, sinks and model are doing: processes, sockets and pipes."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress

import pytest
from bridge_samples import make_counts, write_recording
from cli_samples import EDGE_SR
from edge_samples import ended, write_model
from view_samples import HANDSHAKE, LONG_PING

LONG_S = 12.0
"""Five seconds are promised; a busy machine may take longer, and what is mended here took a minute or for ever."""
# The page over a network that takes little at a time, where over loopback the system would take megabytes in; and what
# ends a viewer that does not read comes much later than the signal.
NARROW = """
import socket, sys
from edge.cli import main as cli
from edge.view import server

def listen(host, port, listen=server.listen):
    listening = listen(host, port)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    return listening

server.listen, server.GONE_S = listen, 60.0
sys.exit(cli.main(sys.argv[1:]))
"""
# A lock that is never given back, which keeps the program in C as a graph does that goes round for ever.
ENDLESS = """
import ctypes
from edge.terminal.stop_signals import stop_on_signals

lock, library = ctypes.create_string_buffer(64), ctypes.CDLL(None)
with stop_on_signals():
    print("begun", flush=True)
    while True:
        library.pthread_mutex_lock(lock)
"""


PIPES = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def test_a_viewer_that_pings_and_never_reads_holds_up_no_end():
    command = [sys.executable, "-c", NARROW, "--source", "demo:loop", "--view", "0"]
    with ended(subprocess.Popen(command, **PIPES)) as process:
        address = next(line for line in process.stderr if line.startswith(b"live page: "))
        viewer = socket.create_connection(("127.0.0.1", int(address.strip().rpartition(b":")[2].strip(b"/"))))
        viewer.sendall(HANDSHAKE)
        stop = threading.Event()

        def ping():
            with suppress(OSError):
                while not stop.is_set():
                    viewer.sendall(100 * LONG_PING)

        pinging = threading.Thread(target=ping)
        pinging.start()
        time.sleep(1.5)  # by then all buffers between us are full
        try:
            process.send_signal(signal.SIGTERM)
            words = process.communicate(timeout=LONG_S)[1]
        finally:
            stop.set()
            process.kill()
            pinging.join()
            viewer.close()
    assert process.returncode == 0 and b"EMULATED demo:" in words


def test_a_full_pipe_that_nobody_reads_holds_up_no_end(tmp_path):
    recording = write_recording(tmp_path / "long.csv", make_counts(3000), 100.0)
    options = ("--model", str(write_model(tmp_path / "tiny.onnx")), "--sink", "jsonl:-")
    command = [*EDGE_SR, "replay", str(recording), *options]
    with ended(subprocess.Popen(command, bufsize=0, **PIPES)) as process:
        assert process.stdout.read(1) == b"{"
        time.sleep(2)  # it is waiting for us
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_S) == 0
        words = process.stderr.read().decode()
    assert re.search("records left out for slow readers: 1$", words, re.MULTILINE) and "Traceback" not in words


# The kernel kills no first process of a container by a signal from within.
UNKILLED = "import os\nos.kill = lambda *signal: None\n"


@pytest.mark.parametrize(("before", "code"), [("", -signal.SIGKILL), (UNKILLED, 128 + signal.SIGKILL)])
def test_an_endless_model_is_killed(before, code):
    with ended(subprocess.Popen([sys.executable, "-c", before + ENDLESS], **PIPES)) as process:
        assert process.stdout.readline() == b"begun\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(LONG_S) == code
        assert process.stderr.read() == b"edge-sr: not ended 5 s after the signal: ended by force\n"


def test_kill_9_leaves_whole_records(tmp_path):
    """All but the last line of a file are whole, and hold what another sink has shown: sinks are served in order."""
    recording = write_recording(tmp_path / "played.csv", make_counts(200), rate_hz=400)
    command = [*EDGE_SR, "--source", f"replay:{recording}", "--rate-hz", "400"]
    command += ["--sink", f"jsonl:{tmp_path}/out.jsonl", "--sink", "jsonl:-"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
    with subprocess.Popen(command, **pipes) as process:
        shown = [process.stdout.readline() for _ in range(30)]
        process.send_signal(signal.SIGKILL)
        shown += process.stdout.read().split(b"\n")[:-1]
    assert process.returncode == -signal.SIGKILL
    lines = (tmp_path / "out.jsonl").read_bytes().split(b"\n")[:-1]
    assert [json.loads(line)["scan"] for line in lines] == list(range(len(lines)))
    assert len(lines) >= len(shown) >= 30
