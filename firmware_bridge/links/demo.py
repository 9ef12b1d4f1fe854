"""Demo: an emulated sensor on an emulated robot in a process of its own, read over its pseudo-terminal."""

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import Link, SourceKind, not_open
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.scans.scan import Scan

END_TIMEOUT_S: Final = 5.0


class DemoLink(Link):
    """Link to a recording played by the emulator, through the ordinary serial path.

    The emulator ends with this link, and with this process however it ends.
    """

    def __init__(self, recording: str | Path, rate_hz: float | None = None, *, loop: bool = False) -> None:
        self.name = "demo"
        self.kind: SourceKind = "emulated"
        self.states_poses = True  # those of its robot
        self._recording = str(recording)
        self._rate_hz = rate_hz
        self._loop = loop
        self._process: subprocess.Popen[bytes] | None = None
        self._partial = b""
        self._link: SlcanSerialLink | None = None
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Self:
        command = [sys.executable, "-m", "firmware_bridge.emulation.robot_main"]
        command += [] if self._rate_hz is None else ["--rate-hz", str(self._rate_hz)]
        command += ["--loop"] if self._loop else []
        # A session of its own: Ctrl-C is for this process, which must close the link before the emulator ends.
        self._process = subprocess.Popen(
            [*command, "--", self._recording],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,  # lines after the first are read as they come
            start_new_session=True,
        )
        try:
            self._link = SlcanSerialLink(_await_port(self._process))
            self._link.__enter__()
        except BaseException:
            self._collect_ended()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        link, self._link = self._link, None
        try:
            if link is not None:
                link.__exit__(*exc_info)
                self._counts = link.counters()
        finally:
            self._collect_ended()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the emulator ended too early."""
        if self._link is None or self._process is None:
            raise not_open()
        if self.ended:
            return []
        try:
            scans = self._link.read(timeout_s)
        except LinkLostError:
            # It hangs up when it has played everything, and only then ends without an error.
            if not _ends_well(self._process):
                raise
            self.ended = True
            return []
        self.trouble = self._link.trouble
        return scans

    def poses(self) -> list[TimedPose]:
        """Return the poses that the robot has stated since the last call."""
        stdout = None if self._process is None else self._process.stdout
        if stdout is None or not select.select([stdout], [], [], 0)[0]:
            return []
        *lines, self._partial = (self._partial + os.read(stdout.fileno(), 1 << 16)).split(b"\n")
        return [_timed_pose(line) for line in lines]

    def steer(self) -> Callable[[PadPose | None], None]:
        """Return the function that takes where the robot is to tap next, None for the next tap of the recording."""
        self._ask("follow")
        return lambda pose: self._ask(None if pose is None else [pose.x_mm, pose.y_mm])

    def _ask(self, asked: str | list[float] | None) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it has ended, which the next read shows
                self._process.stdin.write(f"{json.dumps(asked)}\n".encode())

    def counters(self) -> dict[str, int]:
        """Return the counters of the serial link, the last ones after it was closed."""
        return self._link.counters() if self._link else dict(self._counts)

    def _collect_ended(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        with process:  # closes the pipes, which ends the emulator, and waits
            if process.stdin:
                process.stdin.close()
            try:
                process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _await_port(process: subprocess.Popen[bytes]) -> str:
    if process.stdout is None or process.stderr is None:
        raise ValueError("the emulator's output is not a pipe")
    readable, _, _ = select.select([process.stdout], [], [], 20)
    port = process.stdout.readline().decode().strip() if readable else ""
    if port:
        return port
    process.kill()
    last_words = process.stderr.read().decode().strip().rpartition("\n")[2]
    raise DeviceError(f"the emulator did not start: {last_words or 'silent for 20 s'}")


def _timed_pose(line: bytes) -> TimedPose:
    fields = json.loads(line)
    time_ns, holds = fields.pop("time_ns"), fields.pop("holds")
    return TimedPose(PadPose(**fields), time_ns, holds=holds)


def _ends_well(process: subprocess.Popen[bytes]) -> bool:
    try:
        return process.wait(END_TIMEOUT_S) == 0
    except subprocess.TimeoutExpired:
        return False
