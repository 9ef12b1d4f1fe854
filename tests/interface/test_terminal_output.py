"""Bars on a real pseudo-terminal, none anywhere else; and commands of advice."""

import contextlib
import fcntl
import io
import os
import re
import struct
import subprocess
import termios
from types import SimpleNamespace

import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import write_model

from edge.cli import main as cli
from edge.terminal.progress_bar import progress


class Terminal:
    """Both ends of a pseudo-terminal; ours is never waited for."""

    def __init__(self, columns):
        self.ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        os.set_blocking(self.ours, False)
        self.stream = os.fdopen(theirs, "w")

    def said(self):
        said = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                said += os.read(self.ours, 1 << 16)
        return said.decode()

    def close(self):
        if self.ours is not None:
            os.close(self.ours)
            self.ours = None
        with contextlib.suppress(OSError):  # what is left for a window that was closed
            self.stream.close()


@pytest.mark.parametrize("options", [[], ["--sink", "status"], ["--paced"]])
@pytest.mark.parametrize("to", ["-", "out.jsonl"])
def test_a_replay_shows_the_live_line(tmp_path, monkeypatch, capfd, terminal, options, to):
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "tiny.onnx")
    path = write_recording(tmp_path / "finger.csv", make_counts(7), rate_hz=1000)
    with contextlib.redirect_stderr(terminal.stream):
        assert cli.main(["replay", str(path), "--model", "tiny.onnx", "--sink", f"jsonl:{to}", *options]) == 0
    written = capfd.readouterr().out if to == "-" else (tmp_path / to).read_text()
    assert written.count("\n") == 7
    lives = "--sink" in options or to != "-"  # else records may go to the same terminal
    assert ("REPLAY | " in terminal.said()) == lives


@pytest.fixture
def terminal():
    made = Terminal(80)
    yield made
    made.close()


@pytest.fixture
def clock(monkeypatch):
    """Clock of the bars, which goes on as a test sets `now_s`."""
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now_s)
    return clock


def test_a_bar_comes_after_two_seconds_and_leaves_no_trace(terminal, clock):
    with progress("poses", 400, "pose", done=100, stream=terminal.stream) as bar:
        clock.now_s += 1.9
        bar.update(38)
        assert terminal.said() == ""
        clock.now_s += 0.1
        bar.update(2)
        shown = terminal.said()
        assert re.search(r"^\r?poses:  35%\|.+20\.0pose/s", shown) and "\n" not in shown, shown
        os.close(terminal.ours)  # a window that is closed ends no work
        terminal.ours = None
        bar.update()


def test_no_bar_without_a_terminal(clock):
    pipe = io.StringIO()
    with progress("poses", 400, "pose", stream=pipe) as bar:
        clock.now_s += 9
        bar.update()
    assert pipe.getvalue() == ""


ODD = ["a  b", "it's;$c`d", "tab\there\nthere", "back\\slash\x1b", "\x9b\u202eé\udcff"]


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize(
    ("command", "advice", "meant"),
    [
        (["record", "NAME.npz"], "cannot be recorded: ", ["NAME.mcap", "NAME.mcap", "NAME.npz"]),
        (["--sink", "npz:NAME.npz"], ", then ", ["NAME.mcap", "NAME.npz"]),
        (["--source", "NAME.csv"], "did you mean ", ["replay:NAME.csv"]),
    ],
)
def test_commands_of_advice_can_be_typed_whatever_the_file(name, command, advice, meant, capsys):
    """As bash takes it: its arguments that hold the name are those of the files."""
    assert cli.main([word.replace("NAME", name) for word in command]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    typed = line.partition(advice)[2].removesuffix("?")
    if not typed.startswith("edge-sr"):
        typed = f"edge-sr {typed}"
    script = 'edge-sr() { printf "%s\\0" "$@"; }; afterwards() { "$@"; }; ' + typed
    bash = ["bash", "-c", script.encode(errors="surrogateescape")]
    done = subprocess.run(bash, capture_output=True, check=True, env=os.environ | {"LC_ALL": "C.UTF-8"})
    words = done.stdout.decode(errors="surrogateescape").split("\0")
    assert [one for one in words if "." in one] == [one.replace("NAME", name) for one in meant]
