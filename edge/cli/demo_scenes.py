"""Robot and scenes of the demo: where it taps next, and a line before and after each scene on its fault and outcome."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from firmware_bridge.poses.pad_pose import PadPose


class DemoRobot(Sink):
    """Sink that passes on the proposal after each tap of the demo's figure, or that there is none."""

    def __init__(self, recording: Path, touch: Callable[[PadPose | None], object]) -> None:
        """Load the taps; `touch` is called with the pose of each proposal, None where nothing is proposed."""
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


_FREE: Final = -1
_FOREIGN, _MAGNET, SLIDE = 0, 1, 2
_BEGINS: Final = {
    _FOREIGN: "demo: now another surface is tapped, and then the first one again: no pattern may be made from both",
    _MAGNET: "demo: now a magnet comes near the free pad, and stays while it is tapped: no contact reads like that",
    SLIDE: "demo: now the pad slides along another object, a long letter: a map is made of its patterns",
}


def scene_of(recording: Path) -> dict[bytes, int]:
    """Return the scene of each scan of a recording, by its counts; -1 outside of scenes."""
    with np.load(recording, allow_pickle=False) as data:
        pairs = zip(data["counts"], data["scene"].tolist(), strict=True)
        return {counts.astype(np.int32).tobytes(): scene for counts, scene in pairs}


class DemoScenes(Sink):
    """Sink that announces each scene of the demo, and its outcome unless it is cut off, as events of kind "note"."""

    def __init__(self, recording: Path, tell: Callable[[Event], object], reset: Callable[[], object]) -> None:
        """Load the scenes; `reset` is called where the robot goes on to another object."""
        self._scenes = scene_of(recording)
        self._tell = tell
        self._reset = reset
        self._scene = _FREE
        self._patterns = self._checked = self._untrusted = self._dropped = 0

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Follow the scenes."""
        scene = self._scenes.get(result.scan.counts.tobytes(), self._scene)
        if scene != self._scene:
            self._end()
            self._scene = scene
            if scene in _BEGINS:
                self._say(_BEGINS[scene])
            if scene == SLIDE:
                self._reset()
        self._dropped += sum(event.kind == "tap_dropped" for event in result.events)
        if result.pattern is not None:
            self._patterns += 1
            self._checked += result.trusted is not None
            self._untrusted += result.trusted is False

    def close(self) -> None:
        """Do nothing: a scene that was cut off has no outcome."""

    def _end(self) -> None:
        """Announce the outcome of the scene, and count from 0."""
        if self._scene == _FOREIGN:
            none = "no tap was dropped: this model takes one tap, or has not noticed the other surface"
            self._say(f"demo: {f'earlier taps were dropped {self._dropped} times' if self._dropped else none}")
        elif self._scene == _MAGNET:
            told = f"{self._untrusted} of {self._patterns} patterns with the magnet were not to be believed"
            none = f"none of {self._patterns} patterns with the magnet was checked"
            self._say(f"demo: {told if self._checked else none}")
        self._patterns = self._checked = self._untrusted = self._dropped = 0

    def _say(self, text: str) -> None:
        self._tell(Event(time.monotonic_ns(), "note", None, text))
