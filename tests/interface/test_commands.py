import os
import signal
import sys
import threading
import time

import pytest

from edge.cli.user_commands import user_commands
from edge.pipeline.commands import RESET, ZERO, Command, CommandLines, Commands, obey, read_stdin
from edge.terminal.stop_signals import handled

OPEN = []


def lines_of(descriptor):
    commands = Commands()
    lines = CommandLines(commands, descriptor)
    OPEN.append(lines)
    commands.ask(lines.read)
    return lines, commands


def polled_stdin():
    commands = Commands()
    with read_stdin(commands):
        return commands.poll()


@pytest.fixture
def pipe():
    ends = list(os.pipe())
    yield ends
    while OPEN:
        OPEN.pop().close()
    for end in ends:
        try:
            os.close(end)
        except OSError:
            continue


def test_commands_come_as_lines_however_they_are_cut(pipe):
    _, commands = lines_of(pipe[0])
    assert commands.poll() == []
    for piece in (b'{"cmd": ', b'"reset"}', b'\n{"cmd": "reset"}\n{"cmd"'):
        os.write(pipe[1], piece)
        got = commands.poll()
    assert got == [RESET, RESET]
    os.write(pipe[1], b':"reset"}\r\n')
    assert commands.poll() == [RESET]
    assert commands.refused == 0


@pytest.mark.parametrize(
    "line",
    [b"reset", b"{}", b'{"cmd": "rest"}', b'{"cmd": ["reset"]}', b'["reset"]', b"\xff\xfe", b"[" * 4000, b"1e999"],
)
def test_other_lines_are_counted(pipe, line):
    _, commands = lines_of(pipe[0])
    os.write(pipe[1], line + b'\n\n  \n{"cmd": "reset"}\n')
    assert commands.poll() == [RESET]
    assert commands.refused == 1


def test_a_line_without_end_stays_bounded_and_is_counted_once(pipe):
    _, commands = lines_of(pipe[0])
    for _ in range(20):
        os.write(pipe[1], b"x" * 4000)
        assert commands.poll() == []
    os.write(pipe[1], b'{"cmd": "reset"}\n{"cmd": "reset"}\n')
    assert commands.poll() == [RESET]
    assert commands.refused == 1


def test_a_line_cut_for_its_length_is_no_command(pipe):
    _, commands = lines_of(pipe[0])
    for piece in (b'{"cmd": "reset", "x": "', *[b"x" * 4000] * 3, b'"}\n'):
        os.write(pipe[1], piece)
        assert commands.poll() == []
    assert commands.refused == 1


def test_the_end_of_the_pipe_ends_commands_but_keeps_the_last_line(pipe):
    _, commands = lines_of(pipe[0])
    os.write(pipe[1], b'{"cmd": "reset"}')
    assert commands.poll() == []
    os.close(pipe[1])
    assert commands.poll() == [RESET]
    assert commands.poll() == []
    os.close(pipe[0])
    assert commands.poll() == [], "a pipe that has ended is not touched again"


def test_a_terminal_and_a_missing_stdin_are_left_alone(monkeypatch):
    leader, follower = os.openpty()
    with os.fdopen(follower) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        os.write(leader, b'{"cmd": "reset"}\n')
        assert polled_stdin() == []
    assert polled_stdin() == []  # closed
    monkeypatch.setattr(sys, "stdin", None)
    assert polled_stdin() == []
    os.close(leader)


def test_a_pipe_is_listened_to(monkeypatch, pipe):
    with os.fdopen(os.dup(pipe[0])) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        os.write(pipe[1], b'{"cmd": "reset"}\n')
        assert polled_stdin() == [RESET]


@pytest.mark.parametrize(
    ("line", "command"),
    [
        (b'{"cmd": "zero"}', ZERO),
        (b'{"cmd": "zero", "sensor": "4"}', Command("zero", "4")),
        (b'{"cmd": "zero", "sensor": null, "force": true}', Command("zero", None, True)),
        (b'{"force": false, "sensor": "6", "cmd": "zero"}', Command("zero", "6", False)),
    ],
)
def test_zeroing_names_a_sensor_or_all_and_may_be_forced(pipe, line, command):
    _, commands = lines_of(pipe[0])
    os.write(pipe[1], line + b"\n")
    assert commands.poll() == [command] and commands.refused == 0


@pytest.mark.parametrize(
    "more",
    [
        *(b'"sensor": 4', b'"force": 1', b'"force": "no"', b'"sensors": "4"', b'"sensor": []', b'"sensor": ""'),
        *(rb'"sensor": "\ud800"', rb'"sensor": "\u001b[2J"', b'"sensor": "' + b"4" * 65 + b'"'),
    ],
)
def test_a_zeroing_that_is_not_understood_is_none(pipe, more):
    """Least of all one of every sensor."""
    _, commands = lines_of(pipe[0])
    os.write(pipe[1], b'{"cmd": "zero", ' + more + b"}\n")
    assert commands.poll() == [] and commands.refused == 1


class Told:
    def __init__(self):
        self.done = []

    def reset(self):
        self.done.append("reset")

    def zero(self, name=None, *, force=False):
        self.done.append((name, force))


def test_a_signal_asks_once_for_zeroing_and_is_let_go_afterwards():
    before = signal.getsignal(signal.SIGUSR1)
    runtime = Told()
    commands = Commands()
    with handled(["SIGUSR1"], lambda *_: commands.signalled.add(ZERO)):
        obey(commands, runtime)
        assert runtime.done == []
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGUSR1)
        obey(commands, runtime)
        obey(commands, runtime)
    assert runtime.done == [(None, False)]
    assert signal.getsignal(signal.SIGUSR1) is before


def test_all_places_are_asked_and_obeyed_in_their_order(monkeypatch, pipe):
    with os.fdopen(os.dup(pipe[0])) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        runtime = Told()
        with user_commands() as everything:
            os.write(pipe[1], b'nonsense\n{"cmd": "reset"}\n{"cmd": "zero", "sensor": "4", "force": true}\n')
            os.kill(os.getpid(), signal.SIGUSR1)
            deadline_s = time.monotonic() + 20
            while len(runtime.done) < 3 and time.monotonic() < deadline_s:  # a thread reads stdin
                obey(everything, runtime)
            assert everything.refused == 1
    runtime.done.remove((None, False))  # the signal's, which may come between those of stdin
    assert runtime.done == ["reset", ("4", True)]


def test_commands_of_many_threads_come_each_once_and_in_their_threads_order():
    commands, got = Commands(), []

    def ask(name):
        for number in range(200):
            commands.put(Command("zero", f"{name}/{number}"))
            commands.refuse()

    threads = [threading.Thread(target=ask, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        got += commands.poll()
    got += commands.poll()
    for name in "abcd":
        mine = [one.sensor for one in got if one.sensor and one.sensor.startswith(name)]
        assert mine == [f"{name}/{number}" for number in range(200)]
    assert len(got) == commands.refused == 800
