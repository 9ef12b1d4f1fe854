"""Commands on stdin, by signals, and as keys on a real terminal: every way out leaves the terminal as it was.

And bars on a real pseudo-terminal, none anywhere else; commands of advice.
"""

import contextlib
import fcntl
import io
import json
import os
import pty
import re
import select
import shlex
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock, call

import numpy as np
import pytest
from bridge_samples import make_counts
from bridge_samples import write_recording as write_counts
from cli_samples import write_recording
from edge_samples import BASELINE, ROOT, wait_for, write_model

from edge.api import PadPose, TimedPose
from edge.cli import main as cli
from edge.pipeline.commands import RESET, ZERO, Command, Commands, command_lines, user_commands
from edge.terminal.progress_bar import progress
from firmware_bridge.zeroing.baseline import save_baselines

OPEN = contextlib.ExitStack()


def lines_of(descriptor):
    commands = Commands()
    OPEN.enter_context(command_lines(commands, descriptor))
    return commands


def taken(commands, count):
    """Return the commands once so many came or were refused."""
    got = []
    wait_for(lambda: got.extend(commands.poll()) or len(got) + commands.refused >= count)
    return got


@pytest.fixture
def pipe():
    ends = list(os.pipe())
    yield ends
    OPEN.close()
    for end in ends:
        with contextlib.suppress(OSError):
            os.close(end)


@pytest.mark.parametrize(
    ("pieces", "expected", "refused"),
    [
        ([b'{"cmd": ', b'"reset"}', b'\n{"cmd": "reset"}\n{"cmd"', b':"reset"}\r\n'], [RESET] * 3, 0),
        ([b"x" * 4000] * 20 + [b'{"cmd": "reset"}\n{"cmd": "reset"}\n'], [RESET], 1),  # a line without end is one
        ([b'{"cmd": "zero", "sensor": null, "force": true}'], [Command("zero", None, True)], 0),  # its end ends a line
    ],
)
def test_commands_come_as_lines_however_they_are_cut(pipe, pieces, expected, refused):
    commands = lines_of(pipe[0])
    for piece in pieces:
        os.write(pipe[1], piece)
        time.sleep(0.005)
    os.close(pipe[1])
    assert taken(commands, len(expected) + refused) == expected and commands.refused == refused


@pytest.mark.parametrize(
    "line",
    [
        *(b"reset", b"{}", b'{"cmd": "rest"}', b'{"cmd": ["reset"]}', b'["reset"]', b"\xff\xfe", b"[" * 4000, b"1e999"),
        *(b'{"cmd": "zero", ' + more + b"}" for more in (b'"sensor": 4', b'"force": 1', b'"sensors": "4"')),
        *(
            b'{"cmd": "zero", "sensor": ' + name + b"}"
            for name in (b"[]", b'""', rb'"\ud800"', b'"' + b"4" * 65 + b'"')
        ),
    ],
)
def test_other_lines_are_counted(pipe, line):
    commands = lines_of(pipe[0])
    os.write(pipe[1], line + b'\n\n  \n{"cmd": "reset"}\n')
    assert taken(commands, 2) == [RESET] and commands.refused == 1


def test_poses_and_commands_part_and_bad_lines_stop_nothing(pipe):
    """Nobody polls, since the loop may wait for a scan: a pose without a time has that of its arrival."""
    commands, before_ns = lines_of(pipe[0]), time.monotonic_ns()
    whole = {"cmd": "pose", "x_mm": 1.5, "y_mm": 0, "turn_deg": 5, "error_mm": 0.2, "error_deg": 1}
    ahead_ns = before_ns + 500_000_000
    whole |= {"sensor": "4", "time_ns": ahead_ns, "holds": True}
    lines = [json.dumps(whole), '{"cmd": "pose"}', "nonsense", '{"cmd": "reset"}']
    lines.append('{"cmd": "pose", "x_mm": 1, "y_mm": -2.0}\n')
    os.write(pipe[1], "\n".join(lines).encode())
    poses = []
    wait_for(lambda: poses.extend(commands.poses.take()) or len(poses) == 2)
    assert poses[0] == TimedPose(PadPose(1.5, 0.0, 5.0, 0.2, 1.0), ahead_ns, "4", True)
    assert poses[1] == TimedPose(PadPose(1, -2), poses[1].time_ns)
    assert before_ns <= poses[1].time_ns <= time.monotonic_ns()
    assert commands.poll() == [RESET] and (commands.refused, commands.poses.refused) == (1, 1)
    assert commands.poses.take_reasons() == {"x_mm": "a pose is refused: x_mm is missing, expected a number"}


def test_all_places_are_asked_and_obeyed_in_their_order(stdin, pipe):
    with os.fdopen(os.dup(pipe[0])) as commands:
        stdin(commands)
        with user_commands() as everything:
            os.write(pipe[1], b'nonsense\n{"cmd": "reset"}\n{"cmd": "zero", "sensor": "4", "force": true}\n')
            os.kill(os.getpid(), signal.SIGUSR1)
            got = taken(everything, 4)
        assert everything.refused == 1
    with user_commands() as nothing:  # by a stdin that is closed
        assert nothing.poll() == []
    got.remove(ZERO)  # the signal's, which may come between those of stdin
    runtime = Mock()
    for command in got:
        command.carry_out(runtime)
    assert runtime.mock_calls == [call.reset(), call.zero("4", force=True)]


TIMEOUT_S = 60.0


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Options of a run of 25 s, of which the first four are pressed."""
    folder = tmp_path_factory.mktemp("long")
    # Pressed on many taxels: one alone that reads so much is not believed after a while, and then it may be zeroed.
    path = write_recording(folder / "rest.npz", [0] * 5000, period_ns=5_000_000)
    arrays = dict(np.load(path))
    arrays["counts"][:800, 2, 1:3, 1:3] += 1000  # local, so that it needs no rest before it
    np.savez(path, **arrays)
    save_baselines(folder / "zero.json", [BASELINE])
    options = ["--model", write_model(folder / "tiny.onnx"), "--baseline", folder / "zero.json"]
    return [*options, "--source", f"replay:{path}"]


class Terminal:
    """A shell on a pseudo-terminal, without its line editor, which would set the terminal itself."""

    def __init__(self, folder: Path, options: list) -> None:
        self.records = folder / "out.jsonl"
        command = [sys.executable, "-m", "edge.cli.main", *map(str, options), "--sink", f"jsonl:{self.records}"]
        self.shown = b""
        self._process, self.leader = pty.fork()
        if self._process == 0:
            os.chdir(ROOT)
            os.execvp("bash", ["bash", "--norc", "--noprofile", "--noediting", "-i"])
        self.type(shlex.join(command) + "\n")
        self.until(lambda: not self.line_mode() and self.records.exists() and self.records.stat().st_size > 0)

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
        lines = self.records.read_text().splitlines()
        return [event for line in lines if line.endswith("}") and (event := json.loads(line)["event"])]

    def close(self):
        with contextlib.suppress(OSError):
            os.kill(self._process, signal.SIGKILL)  # the terminal goes with its leader, and the job gets a signal
        os.close(self.leader)
        os.waitpid(self._process, 0)


@pytest.fixture
def terminal(tmp_path, long):
    shell = Terminal(tmp_path, long)
    yield shell
    shell.close()


def test_keys_zero_and_the_terminal_is_restored_on_stop_and_end(terminal):
    assert b"keys: r forgets earlier taps, z zeroes" in terminal.shown
    terminal.type("z")
    terminal.until(lambda: any("zeroing refused: sensor 4 is in contact" in event for event in terminal.events()))
    terminal.until(lambda: '"idle"' in terminal.records.read_text())
    terminal.type("xqz")
    terminal.until(lambda: any("zeroed on demand" in event for event in terminal.events()))

    terminal.type("\x1a")  # Ctrl-Z
    terminal.until(lambda: b"Stopped" in terminal.shown)
    assert terminal.line_mode()
    terminal.type("fg\n")
    terminal.until(lambda: not terminal.line_mode())
    before = len(terminal.events())
    terminal.type("Z")
    terminal.until(lambda: len(terminal.events()) > before)

    terminal.type("\x1a")
    terminal.until(lambda: terminal.shown.count(b"Stopped") == 2)
    size = terminal.records.stat().st_size
    terminal.type("bg\n")
    terminal.until(lambda: terminal.records.stat().st_size > size + 50_000)
    assert terminal.line_mode(), "in the background it goes on, and leaves the terminal alone"
    terminal.type("fg\n")
    terminal.until(lambda: not terminal.line_mode())
    terminal.type("\x03")  # Ctrl-C
    terminal.until(terminal.line_mode)
    terminal.type("echo ended by $?.\n")
    terminal.until(lambda: b"ended by 0." in terminal.shown)
    assert b"scans, " in terminal.shown


def test_the_program_restores_the_terminal_itself(terminal):
    """Bash does it at the end of a program that was stopped before, and so in the test above."""
    terminal.type("\x03")
    terminal.until(lambda: b"scans, " in terminal.shown)
    terminal.type("echo ended by $?.\n")
    terminal.until(lambda: b"ended by 0." in terminal.shown)
    assert terminal.line_mode()


@pytest.fixture
def window():
    """Both ends of a pseudo-terminal of 80 columns; ours is never waited for."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    os.set_blocking(ours, False)

    def said():
        said = b""
        with contextlib.suppress(OSError):
            while True:
                said += os.read(ours, 1 << 16)
        return said.decode()

    stream = os.fdopen(theirs, "w")
    made = SimpleNamespace(ours=ours, stream=stream, said=said)
    yield made
    with contextlib.suppress(OSError):  # what is left for a window that was closed
        stream.close()
    if made.ours is not None:
        os.close(ours)


@pytest.mark.parametrize("options", [[], ["--sink", "status"], ["--paced"]])
@pytest.mark.parametrize("to", ["-", "out.jsonl"])
def test_a_replay_shows_the_live_line(tmp_path, monkeypatch, capfd, window, options, to):
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "tiny.onnx")
    path = write_counts(tmp_path / "finger.csv", make_counts(7), rate_hz=1000)
    with contextlib.redirect_stderr(window.stream):
        assert cli.main(["replay", str(path), "--model", "tiny.onnx", "--sink", f"jsonl:{to}", *options]) == 0
    written = capfd.readouterr().out if to == "-" else (tmp_path / to).read_text()
    assert written.count("\n") == 7
    lives = "--sink" in options or to != "-"  # else records may go to the same terminal
    assert ("REPLAY | " in window.said()) == lives


def test_a_bar_comes_after_two_seconds_on_a_terminal_alone(window, monkeypatch):
    clock, pipe = SimpleNamespace(now_s=100.0), io.StringIO()
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now_s)
    with progress("poses", 400, "pose", done=100, stream=window.stream) as bar:
        clock.now_s += 1.9
        bar.update(38)
        assert window.said() == ""
        clock.now_s += 0.1
        bar.update(2)
        shown = window.said()
        assert re.search(r"^\r?poses:  35%\|.+20\.0pose/s", shown) and "\n" not in shown, shown
        os.close(window.ours)  # a window that is closed ends no work
        window.ours = None
        bar.update()
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
