"""Command line of the emulated controller on an emulated robot, which states its poses and taps where it is asked to.

    python -m firmware_bridge.emulation.robot_main FILE

The first line it prints is the port. Each further one is a pose as JSON, with the time at which the pad was there.
After the line "follow" on stdin it waits, after each tap that a proposal may follow, for a line with the place of the
next one in [mm], such as [2.35, 0], or null for the next one of the recording. Otherwise it plays the recording, and
ends with it, or when stdin is closed.
"""

import argparse
import json
import os
import select
import sys
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import BridgeError
from firmware_bridge.poses import POSE_FIELDS
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track

_OPTIONS: Final = ("tap", "option_counts", "option_pose")


class Robot:
    """Robot that moves the pad of a recording: states its poses, and plays the taps that it is asked for.

    Args:
        recording: of one sensor, with its rate.
        options: arrays `tap` (n,), -1 outside of taps; `option_counts` (o, f, 3, rows, cols) of taps that may take the
            place of any but the first; `option_pose` (o, 5). Empty for a recording without.
    """

    def __init__(self, recording: Recording, options: Mapping[str, NDArray[Any]]) -> None:
        self._options = options
        rate_hz = recording.rate_hz or 0.0
        poses = recording.poses if rate_hz else ()
        self._poses = {round(one.time_ns * rate_hz / 1e9): [*astuple(one.pose), one.holds] for one in poses}
        tap = options.get("tap", np.zeros(0, dtype=int))
        begins = np.flatnonzero((tap[1:] > tap[:-1]) & (tap[1:] > 0)) + 1
        self._taps = {int(first): int(np.flatnonzero(tap == tap[first])[-1]) + 1 for first in begins}
        self._asked: deque[list[float] | None] = deque()
        self._steered = False
        self._partial = b""
        self._stated: deque[list[Any] | None] = deque()

    def played(self, track: Track) -> Iterator[NDArray[np.int32]]:
        """Yield the scans of one round."""
        self._asked.clear()
        number = 0
        while number < len(track.counts):
            if number in self._taps and self._steered:
                moving = track.counts[number - 10 : number]  # the free pad, while the robot moves to the tap
                option = yield from self._waits(moving)
                self._asked.clear()
                if option is not None:
                    self._stated.append([*self._options["option_pose"][option].tolist(), True])
                    taken = (*moving, *self._options["option_counts"][option])
                    self._stated.extend([None] * (len(taken) - 1))
                    yield from taken
                    number = self._taps[number]
            self._stated.append(self._poses.get(number))
            yield track.counts[number]
            number += 1

    def take(self, text: bytes) -> None:
        """Take lines that ask for the next tap."""
        *lines, self._partial = (self._partial + text).split(b"\n")
        for asked in map(json.loads, lines):
            if asked == "follow":
                self._steered = True
            else:
                self._asked.append(asked)

    def state(self, controller: int, time_ns: int) -> None:
        """Print the pose of a scan that was sent, if it has one."""
        pose = self._stated.popleft() if self._stated else None
        if pose is not None:
            line = dict(zip((*POSE_FIELDS, "holds"), pose, strict=True)) | {"time_ns": time_ns}
            with suppress(BlockingIOError):  # who does not read it goes without
                os.write(sys.stdout.fileno(), f"{json.dumps(line)}\n".encode())

    def _waits(self, free: NDArray[np.int32]) -> Generator[NDArray[np.int32], None, int | None]:
        """Yield scans of the free pad until a tap is asked for, and return its number; None for the recording's."""
        for scan in range(500):  # a robot that is not asked any more taps by the recording
            if self._asked:
                place = self._asked.popleft()
                if place is None:
                    return None
                away = self._options["option_pose"][:, :2] - np.array(place)
                return int(np.hypot(*away.T).argmin())
            self._stated.append(None)
            yield free[scan % len(free)]
        return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the recording named on the command line, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m firmware_bridge.emulation.robot_main", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", type=Path, help="recording of one sensor")
    parser.add_argument("--rate-hz", type=float, help="scans a second (default: as recorded)")
    parser.add_argument("--loop", action="store_true", help="begin again after the last scan")
    options = parser.parse_args(arguments)
    try:
        recording = load_recording(options.file)
        robot = Robot(recording, _options(options.file))
        settings = {"rate_hz": options.rate_hz, "loop": options.loop}
        _play(robot, Emulator([recording], **settings, on_scan=robot.state, played=robot.played))
    except KeyboardInterrupt:
        return 130
    except (BridgeError, ValueError) as error:
        parser.error(str(error))
    return 0


def _play(robot: Robot, emulator: Emulator) -> None:
    with suppress(OSError):
        os.set_blocking(sys.stdout.fileno(), False)
    with emulator:
        sys.stdout.write(f"{emulator.port}\n")
        sys.stdout.flush()
        while not emulator.wait(0.05):
            if select.select([0], [], [], 0)[0]:
                text = os.read(0, 4096)
                if not text:
                    return
                robot.take(text)


def _options(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a recording that are for the robot; none for one without them."""
    if path.suffix != ".npz":
        return {}
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in _OPTIONS} if set(_OPTIONS) <= set(data.files) else {}


if __name__ == "__main__":
    sys.exit(main())
