"""Demo: an emulated sensor on an emulated robot, read over its pseudo-terminal."""

from collections.abc import Callable
from pathlib import Path
from typing import Self

from firmware_bridge.emulation.robot import Robot, tap_options
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links.base import Link, SourceKind, not_open
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import Scan


class DemoLink(Link):
    """Link to a recording played by the emulator, through the ordinary serial path.

    Attributes:
        emulator: the emulator, once the link was open.
    """

    def __init__(self, recording: str | Path, rate_hz: float | None = None, *, loop: bool = False) -> None:
        self.name = "demo"
        self.kind: SourceKind = "emulated"
        self.states_poses = True  # those of its robot
        self.emulator: Emulator | None = None
        self._recording = Path(recording)
        self._rate_hz = rate_hz
        self._loop = loop
        self._robot: Robot | None = None
        self._link: SlcanSerialLink | None = None
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Self:
        try:
            recording = load_recording(self._recording)
            robot = Robot(recording, tap_options(self._recording))
            settings = {"rate_hz": self._rate_hz, "loop": self._loop}
            emulator = Emulator([recording], **settings, on_scan=robot.state, played=robot.played)
        except (BridgeError, ValueError) as error:
            raise DeviceError(f"the emulator did not start: {error}") from error
        emulator.__enter__()
        self._robot, self.emulator, self._link = robot, emulator, SlcanSerialLink(emulator.port)
        try:
            self._link.__enter__()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        link, self._link = self._link, None
        if link is None or self.emulator is None:
            return
        try:
            link.__exit__(*exc_info)
            self._counts = link.counters()
        finally:
            self.emulator.hang_up()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the emulator ended too early."""
        if self._link is None or self.emulator is None:
            raise not_open()
        if self.ended:
            return []
        try:
            scans = self._link.read(timeout_s)
        except LinkLostError:
            if not self.emulator.played_out:  # else it has hung up, as everything was played
                raise
            self.ended = True
            return []
        self.trouble = self._link.trouble
        return scans

    def poses(self) -> list[TimedPose]:
        """Return the poses that the robot has stated since the last call."""
        stated = self._robot.stated if self._robot else ()
        return [stated.popleft() for _ in range(len(stated))] if stated else []

    def steer(self) -> Callable[[PadPose | None], None]:
        """Return the function that takes where the robot is to tap next, None for the next tap of the recording."""
        if self._robot is None:
            raise not_open()
        self._robot.steered = True
        return self._robot.asked.append

    def counters(self) -> dict[str, int]:
        """Return the counts of the serial link, the last ones after it was closed."""
        return self._link.counters() if self._link else dict(self._counts)
