"""Emulated robot that moves the pad of a recording: states its poses, and plays the taps that it is asked for."""

from collections import deque
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.recording.tracks import Recording, Track

_Stated = tuple[PadPose, bool]  # a pose, and whether the pad rests there until the next


class Robot:
    """Robot of a recording of one sensor. Another thread may ask it, and take its poses.

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
        rate_hz = recording.rate_hz or 0.0
        poses = recording.poses if rate_hz else ()
        self._poses: dict[int, _Stated] = {round(one.time_ns * rate_hz / 1e9): (one.pose, one.holds) for one in poses}
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
