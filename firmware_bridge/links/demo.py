"""Demo: an emulated sensor on an emulated robot, read over its pseudo-terminal."""

from collections import deque
from pathlib import Path
from typing import Self

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links.base import SourceKind
from firmware_bridge.links.serial_ports import PluggedAdapter
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.poses import TimedPose
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import Scan


class DemoLink(SlcanSerialLink):
    """Link to a recording played by the emulator, over the ordinary serial path."""

    def __init__(
        self, recording: str | Path, rate_hz: float | None = None, *, loop: bool = False, model: ModelMap = USPA44_MAP
    ) -> None:
        super().__init__("", model=model)
        self.name = "demo"
        self.lasts = self.fetches = False
        self.kind: SourceKind = "emulated"
        self.states_poses = True  # those of its robot
        self.emulator: Emulator | None = None  # the emulator, once the link was open
        self._recording = Path(recording)
        self._rate_hz = rate_hz
        self._loop = loop
        self._poses: dict[int, TimedPose] = {}  # by number of the scan in the recording
        self._length = self._sent = 0  # scans of the recording, and those that were sent
        self._stated: deque[TimedPose] = deque()

    def __enter__(self) -> Self:
        try:
            recording = load_recording(self._recording)
            emulator = Emulator([recording], rate_hz=self._rate_hz, loop=self._loop, on_scan=self._state)
        except (BridgeError, ValueError) as error:
            raise DeviceError(f"the emulator did not start: {error}") from error
        rate_hz = recording.rate_hz or recording.tracks[0].mean_rate_hz or 0.0
        self._poses = {round(pose.time_ns * rate_hz / 1e9): pose for pose in recording.poses}
        self._length, self._sent, self.emulator = len(recording.tracks[0].counts), 0, emulator
        emulator.__enter__()
        self._plugged = PluggedAdapter(emulator.port)
        try:
            return super().__enter__()
        except BaseException:
            emulator.hang_up()
            raise

    def __exit__(self, *exc_info: object) -> None:
        try:
            super().__exit__(*exc_info)
        finally:
            if self.emulator is not None:
                self.emulator.hang_up()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the emulator ended too early."""
        if self.ended:
            return []
        try:
            return super().read(timeout_s)
        except LinkLostError:
            if self.emulator is None or not self.emulator.played_out:  # else it has hung up, as everything was played
                raise
            self.ended = True
            return []

    def poses(self) -> list[TimedPose]:
        """Return the poses that the robot has stated since the last call."""
        return [self._stated.popleft() for _ in range(len(self._stated))]

    def _state(self, controller: int, time_ns: int) -> None:
        """State the pose of a scan that was sent, if it has one; in the emulator's thread."""
        pose = self._poses.get(self._sent % self._length)
        self._sent += 1
        if pose is not None:
            self._stated.append(TimedPose(pose.pose, time_ns, holds=pose.holds))
