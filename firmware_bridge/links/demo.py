"""Demo: an emulated sensor in a process of its own, read over its pseudo-terminal."""

import select
import subprocess
import sys
from pathlib import Path
from typing import Final, Self

from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import Link, SourceKind
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.scan import Scan

START_TIMEOUT_S: Final = 20.0
END_TIMEOUT_S: Final = 5.0


class DemoLink(Link):
    """Link to a recording played by the emulator, through the ordinary serial path.

    The emulator ends with this link, and with this process however it ends.
    """

    def __init__(self, recording: str | Path, rate_hz: float | None = None, *, loop: bool = False) -> None:
        self.name = "demo"
        self.kind: SourceKind = "emulated"
        self.ended = False
        self.trouble: str | None = None
        self._recording = str(recording)
        self._rate_hz = rate_hz
        self._loop = loop
        self._process: subprocess.Popen[str] | None = None
        self._link: SlcanSerialLink | None = None
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Self:
        rate = [] if self._rate_hz is None else ["--rate-hz", str(self._rate_hz)]
        loop = ["--loop"] if self._loop else []
        # A session of its own: Ctrl-C is for this process, which must close the link before the emulator ends.
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "firmware_bridge.emulation.slcan_main",
                "--until-stdin-closes",
                *rate,
                *loop,
                "--",
                self._recording,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            self._link = SlcanSerialLink(_await_port(self._process))
            self._link.__enter__()
        except BaseException:
            self._reap()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        link, self._link = self._link, None
        try:
            if link is not None:
                link.__exit__(*exc_info)
                self._counts = link.counters()
        finally:
            self._reap()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; waits at most `timeout_s` for the first byte.

        Raises:
            LinkLostError: the emulator ended before the end of the recording.
        """
        if self._link is None or self._process is None:
            raise ValueError("the link is not open: use it in a with statement")
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

    def counters(self) -> dict[str, int]:
        """Return the counters of the serial link, the last ones after it was closed."""
        return self._link.counters() if self._link else dict(self._counts)

    def _reap(self) -> None:
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


def _await_port(process: subprocess.Popen[str]) -> str:
    if process.stdout is None or process.stderr is None:
        raise ValueError("the emulator's output is not a pipe")
    readable, _, _ = select.select([process.stdout], [], [], START_TIMEOUT_S)
    port = process.stdout.readline().strip() if readable else ""
    if port:
        return port
    process.kill()
    last_words = process.stderr.read().strip().rpartition("\n")[2]
    raise DeviceError(f"the emulator did not start: {last_words or f'silent for {START_TIMEOUT_S:.0f} s'}")


def _ends_well(process: subprocess.Popen[str]) -> bool:
    try:
        return process.wait(END_TIMEOUT_S) == 0
    except subprocess.TimeoutExpired:
        return False
