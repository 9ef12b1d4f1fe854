"""Robot of the demo: it is asked to tap where the runtime proposes."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from edge.perception.result import Result
from edge.pipeline.sink import Sink
from firmware_bridge.poses.pad_pose import PadPose


class DemoRobot(Sink):
    """Sink that passes on the proposal after each tap of the demo's figure, or that there is none."""

    def __init__(self, recording: Path, touch: Callable[[PadPose | None], object]) -> None:
        """Load the taps.

        Args:
            recording: .npz with `counts`, `tap` and `option_counts` as in `DemoScore`.
            touch: called with the pose of each proposal; None where nothing is proposed.
        """
        with np.load(recording, allow_pickle=False) as data:
            options = data["option_counts"]
            taps = np.concatenate([data["counts"][data["tap"] >= 0], options.reshape(-1, *options.shape[2:])])
        self._taps = {counts.tobytes() for counts in taps.astype(np.int32)}
        self._touch = touch
        self._tapping = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Ask for the next tap once this one is over."""
        if result.contact:
            self._tapping |= result.scan.counts.tobytes() in self._taps
        elif self._tapping and result.contact is False:
            self._tapping = False
            self._touch(None if result.next_tap is None else result.next_tap.target)

    def close(self) -> None:
        """Do nothing: the robot ends with its source."""
