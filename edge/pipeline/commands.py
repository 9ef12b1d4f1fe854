"""Commands to a run in one queue, and poses in another: from keys, signals, viewers and JSON lines on stdin."""

import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Literal

from edge.errors import UsageError
from edge.pipeline.pose_queue import LONGEST_BYTES, PoseQueue, json_object
from edge.terminal.stop_signals import handled
from edge.validation import check_kind
from firmware_bridge.scans.scan import is_sensor_name

if TYPE_CHECKING:
    from edge.perception.runtime import Runtime

WAITING: Final = 64  # commands that may wait until the loop takes them


@dataclass(frozen=True, slots=True)
class Command:
    """Request of a user that is carried out between two scans."""

    name: Literal["reset", "zero"]  # "reset" forgets earlier taps
    sensor: str | None = None  # to zero; None for all
    force: bool = False  # zero it even if it is in contact

    def __post_init__(self) -> None:
        # Any other name would zero: unlike a reset, a zeroing cannot be undone.
        sensor_named = self.sensor is None or (isinstance(self.sensor, str) and is_sensor_name(self.sensor))
        if self.name not in ("reset", "zero") or not sensor_named or not isinstance(self.force, bool):
            raise UsageError(
                f"{self}, expected 'reset' or 'zero', a sensor's name as text, such as '4', and True or False"
            )

    def carry_out(self, runtime: "Runtime") -> None:
        """Ask it of a runtime."""
        if self.name == "reset":
            runtime.reset()
        else:
            runtime.zero(self.sensor, force=self.force)


FORMS: Final = '{"cmd": "zero"} with "sensor" and "force" as wanted, {"cmd": "reset"}'
RESET: Final = Command("reset")
ZERO: Final = Command("zero")


class Commands:
    """Queue of users' commands; any thread puts, and the loop takes between two scans."""

    def __init__(self) -> None:
        self.refused = 0  # messages that were no command, or came when too many waited
        self.reason: str | None = None  # why the first of them was refused since the reason was taken
        self.poses = PoseQueue()  # a queue of its own: a stream of poses must not hold up a command
        self._lock = threading.Lock()
        self._waiting: SimpleQueue[Command] = SimpleQueue()
        self._producers: list[Callable[[], object]] = []

    @property
    def full(self) -> bool:
        """True if no more should be put before the loop takes what waits, at least four times a second."""
        return self._waiting.qsize() >= WAITING

    def put(self, command: Command) -> None:
        """Put a command into the queue; a handler of signals may call it, too, also while another is put."""
        check_kind("command", command, "carry_out", 'a Command, such as Command("zero")')
        self._waiting.put(command)

    def refuse(self, reason: str | None = None) -> None:
        """Count a message that is not a command; the reason is for the user, where its sender is not told."""
        with self._lock:
            self.refused += 1
            self.reason = self.reason or reason

    def ask(self, producer: Callable[[], object]) -> None:
        """Register a producer without a thread; it is called before commands are taken and must never wait."""
        self._producers.append(producer)

    def poll(self) -> list[Command]:
        """Return the commands since the last call; never waits."""
        for produce in self._producers:
            produce()
        commands: list[Command] = []
        while not self._waiting.empty():
            commands.append(self._waiting.get_nowait())
        return commands


@contextmanager
def command_lines(commands: Commands, descriptor: int) -> Iterator[None]:
    """Take lines of a file descriptor, which stays open, as commands within a with statement."""
    woken, waking = os.pipe()

    def follow() -> None:
        data, partial = b"\n", b""
        with suppress(OSError, ValueError):  # the other end is gone, which ends commands but not the run
            while data:
                if woken in select.select([descriptor, woken], [], [])[0]:
                    return
                data = os.read(descriptor, 1 << 16)  # all that a pipe holds, some 500 poses
                *lines, partial = (partial + (data or b"\n")).split(b"\n")
                partial = partial[: LONGEST_BYTES + 1]
                for line in lines:
                    _take_line(commands, line)

    # A pose without a time has that of its arrival, and the loop may be waiting for a scan.
    thread = threading.Thread(target=follow, name="command-lines", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.write(waking, b"!")
        thread.join()
        for end in (woken, waking):
            os.close(end)


def _take_line(commands: Commands, line: bytes) -> None:
    if not line.strip():
        return
    parsed = json_object(line) or {}
    command = runtime_command(parsed)
    if parsed.get("cmd") == "pose":
        commands.poses.put_fields(parsed, time.monotonic_ns())
    elif command is not None:
        commands.put(command)
    else:
        shown = ascii(line[:60].decode(errors="replace"))
        commands.refuse(f"a line on stdin is refused: {shown}{'...' * (len(line) > 60)}, expected {FORMS}, or a pose")


def runtime_command(parsed: Mapping[str, Any]) -> Command | None:
    """Return the command to the runtime that parsed JSON stands for; None if it is not one."""
    if parsed.get("cmd") == "reset":
        return RESET
    # A misspelt key must not turn "zero sensor 4" into "zero all".
    if parsed.get("cmd") != "zero" or parsed.keys() - {"cmd", "sensor", "force"}:
        return None
    # A name that no sensor can have is neither looked up nor shown: a stranger may have written it.
    with suppress(UsageError):
        return Command("zero", parsed.get("sensor"), parsed.get("force", False))
    return None


@contextmanager
def read_stdin(commands: Commands) -> Iterator[None]:
    """Take lines of stdin as commands, unless there is no stdin or it is a terminal, which has keys."""
    with ExitStack() as reading:
        if sys.stdin is not None and not sys.stdin.closed and not sys.stdin.isatty():
            with suppress(OSError):  # a replaced stdin is not a file of the system
                reading.enter_context(command_lines(commands, sys.stdin.fileno()))
        yield


KEYS: Final = {ord("r"): RESET, ord("z"): ZERO, ord("Z"): Command("zero", force=True)}


@contextmanager
def terminal_keys(commands: Commands) -> Iterator[None]:
    """Take keys as commands within a with statement, if stdin is a terminal; Ctrl-C and Ctrl-Z remain signals.

    A shell restores the terminal itself after a program that a signal has ended or stopped, and gives it back without a
    signal: each look sets it for keys again where it is set for lines.
    """
    if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
        yield
        return
    descriptor = sys.stdin.fileno()

    def take_keys() -> None:
        with suppress(OSError, termios.error):  # the terminal was closed, which ends keys but not the run
            if _in_front(descriptor):
                if termios.tcgetattr(descriptor)[3] & termios.ICANON:
                    tty.setcbreak(descriptor, termios.TCSANOW)
                if select.select([descriptor], [], [], 0)[0]:
                    for key in os.read(descriptor, 64):
                        if key in KEYS:
                            commands.put(KEYS[key])

    before = None
    with suppress(termios.error):
        before = termios.tcgetattr(descriptor)
        commands.ask(take_keys)
    try:
        yield
    finally:
        with suppress(termios.error):
            if before is not None and _in_front(descriptor):
                termios.tcsetattr(descriptor, termios.TCSANOW, before)


def _in_front(descriptor: int) -> bool:
    """Return whether this program is the one that its terminal listens to; another uses it else."""
    with suppress(OSError):  # not the terminal of this session, or closed
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    return False


@contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    zero_on_signal = handled(["SIGUSR1"], lambda *_: commands.put(ZERO))
    with zero_on_signal, read_stdin(commands), terminal_keys(commands):
        yield commands
