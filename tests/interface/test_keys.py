"""Keys on a real terminal, under a shell with jobs: every way out leaves the terminal as it was."""

import contextlib
import json
import os
import pty
import select
import signal
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, make_scan, write_model

from firmware_bridge.zeroing.baseline import save_baselines

TIMEOUT_S = 60.0
SCANS = 5000
# A shell of the least words. One that people use would mend the terminal itself after a job that was stopped or killed.
SHELL = """
import os, signal, sys
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
job = os.fork()
if job == 0:
    os.setpgid(0, 0)
    os.tcsetpgrp(0, os.getpgrp())
    for number in (signal.SIGTTOU, signal.SIGQUIT, signal.SIGINT):  # who started the tests may have left them out
        signal.signal(number, signal.SIG_DFL)
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
while True:
    status = os.waitpid(job, os.WUNTRACED)[1]
    os.tcsetpgrp(0, os.getpgrp())
    if not os.WIFSTOPPED(status):
        print(f"<ended {os.waitstatus_to_exitcode(status)}>", flush=True)
        os.read(0, 1)
        break
    print("<stopped>", flush=True)
    while True:
        word = b""
        while not word.endswith(b"."):
            word += os.read(0, 1)
        if word.strip() == b"fg.":
            os.tcsetpgrp(0, job)
        os.kill(-job, signal.SIGCONT)
        if word.strip() == b"fg.":
            break
"""


class Terminal:
    """A shell on a pseudo-terminal."""

    def __init__(self, folder: Path) -> None:
        write_model(folder / "tiny.onnx")
        save_baselines(folder / "zero.json", [BASELINE])
        counts = np.stack([make_scan(n, noise=3).counts for n in range(SCANS)])
        # Of many taxels: one alone that reads so much is not believed after a while, and then the pad may be zeroed.
        counts[:1400, 2, 1:3, 1:3] += 1000  # local, so that it needs no rest before it
        np.savez(
            folder / "rest.npz",
            format=np.array("tactile-recording"),
            version=np.array(1),
            sensor=np.array(["4"] * SCANS),
            scan=np.arange(SCANS),
            time_ns=np.arange(SCANS) * 5_000_000,
            counts=counts,
        )
        self.records = folder / "out.jsonl"
        command = ["-m", "edge.cli.main", "--model", folder / "tiny.onnx", "--sink", f"jsonl:{self.records}"]
        command += ["--source", f"replay:{folder / 'rest.npz'}", "--baseline", folder / "zero.json"]
        self.shown = b""
        self._process, self.leader = pty.fork()
        if self._process == 0:
            os.chdir(ROOT)
            os.environ["PYTHONPATH"] = str(ROOT)
            os.execv(sys.executable, [sys.executable, "-c", SHELL, *map(str, command)])
        self.until(lambda: not self.line_mode() and self.records.exists() and self.records.stat().st_size > 0)

    def wait_for(self, *texts):
        """Read until one of the texts is shown; it, and what was before, is taken."""
        end_s = time.monotonic() + TIMEOUT_S
        while not any(text.encode() in self.shown for text in texts):
            if not select.select([self.leader], [], [], max(end_s - time.monotonic(), 0))[0]:
                raise AssertionError(f"waited for {texts}, saw {self.shown[-600:]!r}")
            self.shown += os.read(self.leader, 65536)
        cut = min(self.shown.index(t.encode()) + len(t) for t in texts if t.encode() in self.shown)
        taken, self.shown = self.shown[:cut], self.shown[cut:]
        return taken.decode(errors="replace")

    def type(self, text):
        os.write(self.leader, text.encode())

    def line_mode(self):
        """Return True where the terminal waits for lines and echoes them."""
        mode = termios.tcgetattr(self.leader)[3]
        return bool(mode & termios.ICANON) and bool(mode & termios.ECHO)

    def until(self, condition):
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s, self.shown[-600:]
            if select.select([self.leader], [], [], 0.02)[0]:
                self.shown += os.read(self.leader, 65536)

    def events(self):
        lines = self.records.read_text().splitlines() if self.records.exists() else []
        found = [json.loads(line)["event"] for line in lines if line.endswith("}")]
        return [event for event in found if event]

    def close(self):
        with contextlib.suppress(OSError):
            os.kill(self._process, signal.SIGKILL)  # the terminal goes with its leader, and the job gets a signal
        os.close(self.leader)
        os.waitpid(self._process, 0)


@pytest.fixture
def terminal(tmp_path):
    shell = Terminal(tmp_path)
    yield shell
    shell.close()


def test_keys_zero_and_the_terminal_is_given_back_where_it_stops_and_ends(terminal):
    assert b"keys: r forgets earlier taps, z zeroes" in terminal.shown
    terminal.type("z")
    terminal.until(lambda: any("zeroing refused: sensor 4 is in contact" in event for event in terminal.events()))
    terminal.until(lambda: '"idle"' in terminal.records.read_text())
    terminal.type("xqz")
    terminal.until(lambda: any("zeroed on demand" in event for event in terminal.events()))

    terminal.type("\x1a")  # Ctrl-Z
    terminal.wait_for("<stopped>")
    assert terminal.line_mode()
    terminal.type("fg.\n")
    terminal.until(lambda: not terminal.line_mode())
    before = len(terminal.events())
    terminal.type("Z")
    terminal.until(lambda: len(terminal.events()) > before)

    terminal.type("\x1a")
    terminal.wait_for("<stopped>")
    size = terminal.records.stat().st_size
    terminal.type("bg.\n")
    terminal.until(lambda: terminal.records.stat().st_size > size + 50_000)
    assert terminal.line_mode(), "in the background it goes on, and leaves the terminal alone"
    terminal.type("fg.\n")
    terminal.until(lambda: not terminal.line_mode())
    terminal.type("\x03")  # Ctrl-C
    assert "scans, " in terminal.wait_for("<ended 0>")
    assert terminal.line_mode()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGQUIT, -signal.SIGQUIT)])
def test_signals_give_the_terminal_back(terminal, number, code):
    os.kill(os.tcgetpgrp(terminal.leader), number)
    terminal.wait_for(f"<ended {code}>")
    assert terminal.line_mode()


def test_a_second_ctrl_c_kills_and_yet_the_terminal_is_given_back(terminal):
    """Both at once, so that the first is not done yet."""
    job = os.tcgetpgrp(terminal.leader)
    os.kill(job, signal.SIGSTOP)
    terminal.wait_for("<stopped>")
    os.kill(job, signal.SIGTERM)
    os.kill(job, signal.SIGINT)
    terminal.type("fg.\n")
    terminal.wait_for("<ended ")
    assert terminal.line_mode()
