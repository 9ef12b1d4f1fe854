import os

import pytest

from edge import commands
from edge.commands import LONGEST_LINE_BYTES, LineCommands, stdin_commands


@pytest.fixture
def pipe():
    ends = list(os.pipe())
    yield ends
    for end in ends:
        try:
            os.close(end)
        except OSError:
            continue


def test_commands_come_as_lines_however_they_are_cut(pipe):
    lines = LineCommands(pipe[0])
    assert lines.poll() == []
    for piece in (b'{"cmd": ', b'"reset"}', b'\n{"cmd": "reset"}\n{"cmd"'):
        os.write(pipe[1], piece)
        got = lines.poll()
    assert got == ["reset", "reset"]
    os.write(pipe[1], b':"reset"}\r\n')
    assert lines.poll() == ["reset"]
    assert lines.refused == 0


@pytest.mark.parametrize(
    "line",
    [b"reset", b"{}", b'{"cmd": "rest"}', b'{"cmd": ["reset"]}', b'["reset"]', b"\xff\xfe", b"[" * 4000, b"1e999"],
)
def test_other_lines_are_counted(pipe, line):
    lines = LineCommands(pipe[0])
    os.write(pipe[1], line + b'\n\n  \n{"cmd": "reset"}\n')
    assert lines.poll() == ["reset"]
    assert lines.refused == 1


def test_a_line_without_end_stays_bounded_and_is_counted_once(pipe):
    lines = LineCommands(pipe[0])
    for _ in range(20):
        os.write(pipe[1], b"x" * 4000)
        assert lines.poll() == []
        assert len(lines._partial) <= LONGEST_LINE_BYTES + 1
    os.write(pipe[1], b'{"cmd": "reset"}\n{"cmd": "reset"}\n')
    assert lines.poll() == ["reset"]
    assert lines.refused == 1


def test_a_line_cut_for_its_length_is_no_command(pipe):
    lines = LineCommands(pipe[0])
    for piece in (b'{"cmd": "reset", "x": "', *[b"x" * 4000] * 3, b'"}\n'):
        os.write(pipe[1], piece)
        assert lines.poll() == []
    assert lines.refused == 1


def test_the_end_of_the_pipe_ends_commands_but_keeps_the_last_line(pipe):
    lines = LineCommands(pipe[0])
    os.write(pipe[1], b'{"cmd": "reset"}')
    assert lines.poll() == []
    os.close(pipe[1])
    assert lines.poll() == ["reset"]
    assert lines.poll() == []
    os.close(pipe[0])
    assert lines.poll() == [], "a pipe that has ended is not touched again"


def test_a_terminal_and_a_missing_stdin_are_left_alone(monkeypatch):
    leader, follower = os.openpty()
    with os.fdopen(follower) as terminal:
        monkeypatch.setattr(commands.sys, "stdin", terminal)
        assert stdin_commands() is None
    assert stdin_commands() is None  # closed
    monkeypatch.setattr(commands.sys, "stdin", None)
    assert stdin_commands() is None
    os.close(leader)


def test_a_pipe_is_listened_to(monkeypatch, pipe):
    with os.fdopen(os.dup(pipe[0])) as stdin:
        monkeypatch.setattr(commands.sys, "stdin", stdin)
        lines = stdin_commands()
        assert lines is not None
        os.write(pipe[1], b'{"cmd": "reset"}\n')
        assert lines.poll() == ["reset"]
