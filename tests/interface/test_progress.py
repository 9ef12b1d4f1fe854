"""Bars on a real pseudo-terminal, read as a terminal would show them; none anywhere else."""

import contextlib
import fcntl
import io
import os
import re
import signal
import struct
import subprocess
import sys
import termios
from functools import partial

import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import ROOT, write_model

from edge.cli import main as cli
from edge.pipeline import replay_setup as recordings
from edge.sinks import status_line as status
from edge.terminal.progress_bar import SECONDS, Progress, tracked

CLEARED = re.compile(r"\r *\r$")
RATE = re.compile(r"scan/s|s/scan")
"""Rate, as seconds per scan below one a second."""


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


@pytest.mark.parametrize(("options", "shown"), [([], True), (["--sink", "status"], False), (["--paced"], False)])
@pytest.mark.parametrize("to", ["-", "out.jsonl"])
def test_a_replay_at_full_speed_shows_one_instead_of_the_live_line(
    tmp_path, monkeypatch, capfd, terminal, options, shown, to
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recordings, "Progress", partial(Progress, stream=terminal.stream, delay_s=0))
    monkeypatch.setattr(status, "StatusSink", partial(status.StatusSink, terminal.stream))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    write_model(tmp_path / "tiny.onnx")
    path = write_recording(tmp_path / "finger.csv", make_counts(7), rate_hz=1000)
    assert (
        cli.main(["replay", str(path), "--model", str(tmp_path / "tiny.onnx"), "--sink", f"jsonl:{to}", *options]) == 0
    )
    written = capfd.readouterr().out if to == "-" else (tmp_path / to).read_text()
    assert written.count("\n") == 7
    said = terminal.said()
    assert ("replay" in said and bool(RATE.search(said)) and bool(CLEARED.search(said))) == shown
    lives = "--sink" in options or ("--paced" in options and to != "-")  # records may go to the same terminal
    assert ("REPLAY" in said) == lives


@pytest.fixture(params=[80])
def terminal(request):
    made = Terminal(request.param)
    yield made
    made.close()


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def test_a_bar_with_rate_and_remaining_time_comes_after_two_seconds(terminal):
    clock = Clock()
    with Progress("poses", 400, "pose", stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 1.9
        bar.advance(38)
        assert terminal.said() == ""
        clock.now_s += 0.1
        bar.advance(2)
        shown = terminal.said()
        assert re.search(r"^\r?poses  10%\|.+\| 20\.0pose/s 00:18 left\s*$", shown), shown
        assert "\n" not in shown
    assert CLEARED.search(terminal.said())


def test_what_has_ended_shows_no_bar_any_more(terminal):
    clock = Clock()
    with Progress("poses", 400, "pose", stream=terminal.stream, clock_s=clock) as bar:
        pass
    clock.now_s += 3
    bar.advance()
    assert terminal.said() == ""


def test_units_that_were_there_before_took_no_time_now(terminal):
    clock = Clock()
    with Progress("poses", 400, "pose", done=300, stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 2.0
        bar.advance(20)
        assert re.search(r"poses  80%.* 10\.0pose/s 00:08 left", terminal.said())


@pytest.mark.parametrize("terminal", [40], indirect=True)
def test_forty_columns_hold_it(terminal):
    clock = Clock()
    with Progress("run times", 10**6, "run", stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 10
        bar.advance(100_000)
        (shown,) = terminal.said().split("\r")[1:] or [""]
        assert len(shown) <= 40 and "10.0krun/s 01:30 left" in shown


def test_a_wait_shows_what_is_left_of_it_and_a_note_but_no_rate(terminal):
    clock = Clock()
    with Progress("watching", 60, SECONDS, stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 15
        bar.note("95 scans/s")
        bar.reach(15)
        assert re.search(r"watching  25%\|.+\| 00:45 left, 95 scans/s", terminal.said())
        bar.note("94 scans/s")
        assert terminal.said() == ""
        bar.note("93 scans/s", at_once=True)
        assert "93 scans/s" in terminal.said()


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_whatever_ends_it_the_line_is_cleared(terminal, stop):
    clock = Clock()
    with pytest.raises(stop), Progress("poses", 400, "pose", stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 3
        bar.advance(1)
        assert "left" in terminal.said()
        raise stop
    assert CLEARED.search(terminal.said())


def test_lines_of_others_stand_alone(terminal):
    clock = Clock()
    with Progress("poses", 400, "pose", stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 3
        bar.advance(30)
        terminal.said()
        with bar.aside():
            terminal.stream.write("a line\n")
            terminal.stream.flush()
        assert re.match(r"\r +\ra line\r\n\r?poses ", terminal.said())


def test_nothing_at_all_where_no_terminal_is_and_for_all_but_the_first_of_torchruns_processes(terminal, monkeypatch):
    clock, pipe = Clock(), io.StringIO()
    for stream, rank in ((pipe, "0"), (terminal.stream, "1")):
        monkeypatch.setenv("RANK", rank)
        with Progress("poses", 400, "pose", stream=stream, clock_s=clock) as bar:
            for _ in range(400):
                clock.now_s += 1
                bar.advance()
                bar.note("x")
    assert pipe.getvalue() == terminal.said() == ""


def test_a_window_that_is_closed_ends_no_work(terminal):
    clock = Clock()
    with Progress("poses", 400, "pose", stream=terminal.stream, clock_s=clock) as bar:
        clock.now_s += 3
        bar.advance()
        os.close(terminal.ours)
        terminal.ours = None
        bar.note("nobody sees it", at_once=True)
        bar.advance()
        with bar.aside():
            pass


def test_what_is_tracked_comes_whole_and_must_tell_how_much_it_is():
    assert list(tracked([1, 2, 3], "counting", "thing")) == [1, 2, 3]
    assert list(tracked(iter([1, 2]), "counting", "thing", 2)) == [1, 2]
    with pytest.raises(TypeError, match=r"has no length: pass `total`"):
        next(tracked(iter([1]), "counting", "thing"))


AT_ONCE = """
import sys
from edge.cli import main as cli
from edge.terminal import progress_bar as progress
progress.Progress.__init__.__kwdefaults__["delay_s"] = 0.0
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("watched", [True, False])
def test_a_command_shows_its_bar_on_a_terminal_and_leaves_no_trace_when_it_is_stopped(tmp_path, watched):
    """`edge-sr baseline` for an hour of scans, stopped by Ctrl-C."""
    terminal = Terminal(60)
    write_recording(tmp_path / "rest.csv", make_counts(100))
    source = ["demo"] if watched else [f"replay:{tmp_path / 'rest.csv'}", "--rate-hz", "1000"]
    command = [sys.executable, "-c", AT_ONCE, "baseline", "--source", *source, "--out", str(tmp_path / "zero.json")]
    process = subprocess.Popen(
        [*command, "--scans", "360000"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=terminal.stream if watched else subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    if watched:
        said = ""
        while not RATE.search(said):
            assert process.poll() is None, said
            said += terminal.said()
        assert re.search(r"zeroing   0%\|.*(?:scan/s|s/scan) .* left", said)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        assert re.search(r"\r +\redge-sr: stopped before every sensor was zeroed", terminal.said())
    else:
        _, said = process.communicate(timeout=60)  # the recording ends before
        assert said.startswith(b"edge-sr: ") and b"\r" not in said and b"\x1b" not in said
    assert process.returncode == 3
    terminal.close()
