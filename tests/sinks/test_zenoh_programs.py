"""Programs that put results over zenoh: their end."""

import os
import re
import select
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from bridge_samples import write_recording
from edge_samples import ended, make_scan, write_model
from zenoh_samples import CONTRACT, ENVIRONMENT, consume, endpoint, hear_interrupts

from edge.terminal.forced_end import EXIT_FORCED

zenoh = pytest.importorskip("zenoh")

__all__ = ["consume", "endpoint"]


def sending(*words, **settings):
    """A program that puts every scan, and hears signals as from a terminal."""
    command = [sys.executable, "-m", "edge.cli.main", *words, "--every-scan"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE} | settings
    return ended(subprocess.Popen(command, env=ENVIRONMENT, preexec_fn=hear_interrupts, **pipes))


def until_quiet(pipe, quiet_s=1.0):
    while select.select([pipe], [], [], quiet_s)[0] and os.read(pipe.fileno(), 1 << 20):
        pass


class TestEndOfTheProgram:
    """Two seconds are promised; a busy machine may take longer."""

    def test_a_peer_that_is_gone_holds_up_no_end(self, endpoint, consume):
        consumer = consume(endpoint)
        with sending("--source", "demo:loop", "--sink", f"zenoh:grip?connect={endpoint}") as program:
            while consumer.next()[0] != "got":
                pass
            consumer.process.send_signal(signal.SIGSTOP)
            time.sleep(1)
            begin_s = time.monotonic()
            program.send_signal(signal.SIGTERM)
            words = program.communicate()[1].decode()
        assert program.returncode == 0 and "EMULATED demo:" in words
        assert time.monotonic() - begin_s < 9, "zenoh itself waits for ten seconds"

    def test_a_replay_that_waits_for_a_peer_that_is_gone_is_ended_by_force(self, endpoint, consume, tmp_path):
        model = write_model(tmp_path / "tiny.onnx", CONTRACT)
        press = np.where(np.arange(8000) < 110, 0, 2000 + 7 * np.arange(8000) % 997)
        noise = np.random.default_rng(1).integers(-2, 3, (8000, 3, 4, 4))
        counts = make_scan(0).counts + noise
        counts[:, 2] += press[:, None, None] // 16
        recording = write_recording(tmp_path / "long.csv", counts)
        consumer = consume(endpoint)
        words = ["replay", str(recording), "--zero", "--rate-hz", "2000", "--model", str(model)]
        sinks = ["--sink", "jsonl:-", "--sink", f"zenoh:grip?connect={endpoint}"]
        with sending(*words, *sinks, stdout=subprocess.PIPE) as program:
            while consumer.next()[0] != "got":
                pass
            consumer.process.send_signal(signal.SIGSTOP)
            until_quiet(program.stdout)  # what zenoh has no room for holds up everything, for five seconds at most
            program.send_signal(signal.SIGTERM)
            words = program.communicate()[1].decode()
        assert program.returncode == EXIT_FORCED
        assert re.search(r"edge-sr: not ended 1\.5 s after the signal, still in ZenohSink\._put .*: ended .*\n", words)
