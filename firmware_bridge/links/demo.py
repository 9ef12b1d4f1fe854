"""Demo: an emulated sensor on an emulated robot, read over its pseudo-terminal."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links.base import SourceKind, not_open
from firmware_bridge.links.serial_ports import PluggedAdapter
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import Scan

_Stated = tuple[PadPose, bool]  # a pose, and whether the pad rests there until the next


class Robot:
    """Robot that moves the pad of a recording of one sensor. Another thread may ask it, and take its poses.

    Once it is `steered` it waits, after each tap that a proposal may follow, for the place of the next one in [mm], or
    None for the next one of the recording. Otherwise it plays the recording.

    Attributes:
        asked: the places that it is asked for.
        steered: True once it waits for them.
        stated: its poses so far, with the times at which the pad was there.
    """

    def __init__(self, recording: Recording, options: Mapping[str, NDArray[Any]]) -> None:
        """Prepare to play a recording with these `tap_options`."""
        self.asked: deque[PadPose | None] = deque()
        self.steered = False
        self.stated: deque[TimedPose] = deque()
        self._options = options
        rate_hz = recording.rate_hz or recording.tracks[0].mean_rate_hz or 0.0
        self._poses: dict[int, _Stated] = {
            round(pose.time_ns * rate_hz / 1e9): (pose.pose, pose.holds) for pose in recording.poses if rate_hz
        }
        tap = options.get("tap", np.zeros(0, dtype=int))
        begins = np.flatnonzero((tap[1:] > tap[:-1]) & (tap[1:] > 0)) + 1
        self._taps = {int(first): int(np.flatnonzero(tap == tap[first])[-1]) + 1 for first in begins}
        self._of_scans: deque[_Stated | None] = deque()

    def played(self, track: Track) -> Iterator[NDArray[np.int32]]:
        """Yield the scans of one round."""
        self.asked.clear()
        number = 0
        while number < len(track.counts):
            if number in self._taps and self.steered:
                moving = track.counts[number - 10 : number]  # the free pad, while the robot moves to the tap
                option = yield from self._waits(moving)
                self.asked.clear()
                if option is not None:
                    self._of_scans.append((PadPose(*self._options["option_pose"][option].tolist()), True))
                    taken = (*moving, *self._options["option_counts"][option])
                    self._of_scans.extend([None] * (len(taken) - 1))
                    yield from taken
                    number = self._taps[number]
            self._of_scans.append(self._poses.get(number))
            yield track.counts[number]
            number += 1

    def state(self, controller: int, time_ns: int) -> None:
        """State the pose of a scan that was sent, if it has one."""
        stated = self._of_scans.popleft() if self._of_scans else None
        if stated is not None:
            self.stated.append(TimedPose(stated[0], time_ns, holds=stated[1]))

    def _waits(self, free: NDArray[np.int32]) -> Generator[NDArray[np.int32], None, int | None]:
        """Yield scans of the free pad until a tap is asked for, and return its number; None for the recording's."""
        for scan in range(500):  # a robot that is not asked any more taps by the recording
            if self.asked:
                place = self.asked.popleft()
                if place is None:
                    return None
                away = self._options["option_pose"][:, :2] - np.array((place.x_mm, place.y_mm))
                return int(np.hypot(*away.T).argmin())
            self._of_scans.append(None)
            yield free[scan % len(free)]
        return None


def tap_options(path: Path) -> dict[str, NDArray[Any]]:
    """Return the taps that may take the place of any but the first in a recording; nothing for one without them.

    `tap` (n,) numbers the recording's taps, -1 outside of them; `option_counts` (o, f, 3, rows, cols) are the scans of
    the others, and `option_pose` (o, 5) their poses.
    """
    names = ("tap", "option_counts", "option_pose")
    if path.suffix != ".npz":
        return {}
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in names} if set(names) <= set(data.files) else {}


class DemoLink(SlcanSerialLink):
    """Link to a recording played by the emulator, over the ordinary serial path.

    Attributes:
        emulator: the emulator, once the link was open.
    """

    def __init__(
        self, recording: str | Path, rate_hz: float | None = None, *, loop: bool = False, model: ModelMap = USPA44_MAP
    ) -> None:
        super().__init__("", model=model)
        self.name = "demo"
        self.lasts = self.fetches = False
        self.kind: SourceKind = "emulated"
        self.states_poses = True  # those of its robot
        self.emulator: Emulator | None = None
        self._recording = Path(recording)
        self._rate_hz = rate_hz
        self._loop = loop
        self._robot: Robot | None = None

    def __enter__(self) -> Self:
        try:
            recording = load_recording(self._recording)
            robot = Robot(recording, tap_options(self._recording))
            settings = {"rate_hz": self._rate_hz, "loop": self._loop}
            emulator = Emulator([recording], **settings, on_scan=robot.state, played=robot.played)
        except (BridgeError, ValueError) as error:
            raise DeviceError(f"the emulator did not start: {error}") from error
        emulator.__enter__()
        self._robot, self.emulator = robot, emulator
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
        stated = self._robot.stated if self._robot else ()
        return [stated.popleft() for _ in range(len(stated))] if stated else []

    def steer(self) -> Callable[[PadPose | None], None]:
        """Return the function that takes where the robot is to tap next, None for the next tap of the recording."""
        if self._robot is None:
            raise not_open()
        self._robot.steered = True
        return self._robot.asked.append
