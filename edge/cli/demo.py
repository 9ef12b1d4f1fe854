"""The demo around one run: its scenes, its score against the truth, and its map."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import boundary_distance_mm, psnr_db, rmse_percent
from edge.inference.bundled import demo_recording
from edge.inference.contract import Model
from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink, MapState
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.commands import RESET, Commands
from edge.pipeline.sink import Sink

if TYPE_CHECKING:
    from edge.view.server import LiveView


class Scene(IntEnum):
    """Part of the demo's recording, as numbered in it."""

    FREE = -1  # between the others, and while the figure is tapped
    FOREIGN = 0
    MAGNET = 1
    SLIDE = 2


_BEGINS: Final[dict[int, str]] = {
    Scene.FOREIGN: "now another surface is tapped, and then the first one again: no pattern is ever made from both",
    Scene.MAGNET: "now a magnet comes near the free pad, and stays while it is tapped: no contact reads like that",
    Scene.SLIDE: "now the pad slides along another object, a long letter: a map is made of its patterns",
}


class DemoRecording:
    """Facts on the demo's recording by the raw counts of its scans, so that a lost scan shifts nothing."""

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as data:
            self.arrays: dict[str, NDArray[Any]] = dict(data)
        counts = self.arrays["counts"]
        self.figure_taps = len(self.arrays["tap_pose"])
        self.scenes = dict(zip(map(_key, counts), self.arrays["scene"].tolist(), strict=True))
        played = zip(counts, self.arrays["tap"].tolist(), self.arrays["indentation_mm"].tolist(), strict=True)
        # Tap and indentation in [mm] of each scan of one.
        self.taps = {_key(scan): (tap, depth_mm) for scan, tap, depth_mm in played if tap >= 0}


def _key(counts: NDArray[np.integer]) -> bytes:
    return counts.astype(np.int32).tobytes()


@dataclass(frozen=True, slots=True)
class TapScore:
    """Error of one tap's pattern against its truth, (H, W) in the model's unit, at the tap's peak."""

    tap: int  # from 0
    pose: tuple[float, float, float]  # x and y in [mm], and turn in [deg], as the robot stated them
    result: Result
    truth: NDArray[np.float32]
    psnr_db: float
    rmse_percent: float  # of full scale
    alone_percent: float  # likewise, of a pattern of this tap alone


class DemoScore:
    """Score of the figure: of each tap the result with the largest force; `complete` once the last tap is over."""

    def __init__(self, recording: DemoRecording, model: Model) -> None:
        """Begin before the first tap."""
        self._recording, self._model = recording, model
        self._peaks: dict[int, tuple[Result, float]] = {}  # with the indentation in [mm], by number of the tap
        self.complete = False

    def add(self, result: Result) -> None:
        """Keep the result if it is the strongest of its tap."""
        key = _key(result.scan.counts)
        self.complete |= bool(self._peaks) and self._recording.scenes.get(key, Scene.FREE) != Scene.FREE
        if self.complete or key not in self._recording.taps or result.pattern is None:
            return
        tap, indentation_mm = self._recording.taps[key]
        if tap not in self._peaks or (result.force_counts or 0) > (self._peaks[tap][0].force_counts or 0):
            self._peaks[tap] = result, indentation_mm

    def scores(self) -> list[TapScore]:
        """Return the scores of the taps that got a pattern."""
        return [self._score(tap, *peak) for tap, peak in self._peaks.items()]

    def truth(self, result: Result) -> NDArray[np.float32] | None:
        """Return the true pattern (H, W) in [mm] of a scan of the figure; None of any other."""
        press = self._recording.taps.get(_key(result.scan.counts))
        return None if press is None else self._true_pattern(*press)

    def _true_pattern(self, tap: int, indentation_mm: float) -> NDArray[np.float32]:
        return self._recording.arrays["unit_patterns"][tap].astype(np.float32) * np.float32(indentation_mm)

    def _score(self, tap: int, result: Result, indentation_mm: float) -> TapScore:
        if result.pattern is None:
            raise ValueError("peak has no pattern, expected one kept by add")
        full_scale, truth = self._model.contract.output_full_scale, self._true_pattern(tap, indentation_mm)
        x_mm, y_mm, turn_deg = self._recording.arrays["tap_pose"][tap, :3].tolist()
        alone = result.pattern if result.taps_used < 2 else self._alone(result)
        error_db = float(psnr_db(result.pattern, truth, full_scale))
        errors = (float(rmse_percent(pattern, truth, full_scale)) for pattern in (result.pattern, alone))
        return TapScore(tap, (x_mm, y_mm, turn_deg), result, truth, error_db, *errors)

    def _alone(self, result: Result) -> NDArray[np.float32]:
        """Return the pattern of a result's newest tap alone."""
        contract = self._model.contract
        if result.window is None:
            raise ValueError("result has no window, expected one with a pattern")
        window = np.zeros((contract.taps, *result.window.shape[1:]), dtype=np.float32)
        window[0] = contract.scale_window(result.window)[0]
        return self._model.run(window)

    def text(self) -> str:
        """Return a table with a line for each tap, 50 columns wide, and what the taps together are worth."""
        scores, of = self.scores(), f"of {self._recording.figure_taps} taps scored"
        if not scores:
            return f"none {of}: the run ended before a tap had a pattern"
        lines = [f"{len(scores)} {of} at their peak, against the simulated truth:"]
        lines.append("tap    x    y turn use   PSNR  RMSE alone  +- time")
        lines.append("      mm   mm  deg taps    dB   %fs   %fs  um   us")
        for score in scores:
            interval_mm = score.result.interval_mm
            interval = "-" if interval_mm is None else f"{1000 * interval_mm:.0f}"  # half of 90 %, of touched pixels
            x_mm, y_mm, turn_deg = score.pose
            figures = f"{score.psnr_db:6.2f} {score.rmse_percent:5.2f} {score.alone_percent:5.2f}"
            place = f"{score.tap + 1:3d} {x_mm:4.1f} {y_mm:4.1f} {turn_deg:4.0f} {score.result.taps_used:3d}"
            lines.append(f"{place} {figures} {interval:>3s} {score.result.run_time_us or 0:4.0f}")
        last, off = scores[-1], "% of full scale off"
        gained = f"With all {last.result.taps_used} taps the pattern is {last.rmse_percent:.2f} {off}; by itself the "
        gained += f"last tap is {last.alone_percent:.2f} {off}."
        if last.result.taps_used < 2:
            gained = "Each pattern is of one tap: the model takes one, or the earlier ones were dropped."
        return "\n".join([*lines, gained])


class DemoMap(MapSink):
    """Map of the slide alone, beside the truth, a letter: `complete` is true once the slide is over."""

    def __init__(self, recording: DemoRecording, show: Callable[[MapState], object] | None) -> None:
        """Begin before the slide."""
        arrays = recording.arrays
        self._recording, self._letter = recording, arrays["letter"]
        px_per_mm, (x_mm, y_mm) = float(arrays["letter_px_per_mm"]), arrays["letter_centre_mm"].tolist()
        super().__init__(ObjectMap(len(self._letter) / px_per_mm, px_per_mm, centre_mm=(x_mm, y_mm)), show=show)
        self._begun = self.complete = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Fuse the results of the slide."""
        scene = self._recording.scenes.get(_key(result.scan.counts))
        if scene == Scene.SLIDE:
            self._begun = True
            super().write(result, counters)
        elif scene is not None:
            self.complete = self._begun

    def text(self) -> str:
        """Return the map's distance from the truth; nothing before the slide."""
        if not self._begun:
            return ""
        if not self.whole.fused:
            return f"the letter is not on the map: {self.summary()}"
        contact, px_per_mm = np.nan_to_num(self.whole.contact()[0]), self.whole.grid.px_per_mm
        away_mm = float(boundary_distance_mm(contact[None], self._letter[None], 0.5, 1 / px_per_mm)[0])
        columns = np.flatnonzero(self._letter.any(axis=0))
        length_mm = (columns[-1] + 1 - columns[0]) / px_per_mm
        fused = f"{self.whole.fused} patterns fused, outline {away_mm:.2f} mm from the truth"
        return f"map of a letter of {length_mm:.0f} mm, from one slide: {fused}"


class Demo(Sink):
    """Sink that makes a run the demo; it prints to `stream`, and shows its map on the live page, if there is one."""

    def __init__(
        self,
        model: Model,
        stream: TextIO,
        view: "LiveView | None",
        watching: Sequence[Sink],
        commands: Commands,
        *,
        loops: bool,
        maps: bool,
    ) -> None:
        """Begin the demo, announced to sinks that are `watching`; one that `loops` prints a part once that is over."""
        self._recording = recording = DemoRecording(demo_recording())
        self._stream, self._view, self._watching, self._commands, self._loops = stream, view, watching, commands, loops
        self._scene = Scene.FREE
        self.score = DemoScore(recording, model)
        if view is not None:
            view.show_truth(self.score.truth)
        # A sink of its own, where the user makes no map.
        self.map = DemoMap(recording, None if view is None else view.show_map) if maps else None
        self._unprinted = [self.score, *([] if self.map is None else [self.map])]
        taps = f"{str(recording.arrays['surface'])!r} {recording.figure_taps} times"
        sys.stderr.write(f"demo: an emulated sensor taps {taps}, turned by 5 degrees each time, zeroed first\n")

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Follow the demo."""
        self.score.add(result)
        self._announce(self._recording.scenes.get(_key(result.scan.counts), self._scene))
        complete = [part for part in self._unprinted if part.complete] if self._loops else []
        for part in complete:
            self._print(part)
        if complete and not self._unprinted:
            page = "" if self._view is None else f"live page: {self._view.url}; "
            sys.stderr.write(f"\n{page}the demo continues until Ctrl-C\n")

    def _announce(self, scene: int) -> None:
        """Announce the next scene; where the robot goes to another object and back, earlier taps are forgotten."""
        before, self._scene = self._scene, scene
        if scene != before and Scene.SLIDE in (scene, before):
            self._commands.put(RESET)
        if scene != before and scene in _BEGINS:
            event = Event(time.monotonic_ns(), "note", None, f"demo: {_BEGINS[scene]}")
            for sink in self._watching:
                sink.tell(event, {})

    def finish(self) -> None:
        """Print what was not printed while the demo went on."""
        for part in [*self._unprinted]:
            self._print(part)

    def _print(self, part: DemoScore | DemoMap) -> None:
        if text := part.text():
            self._stream.write(f"\n{text}\n")
        self._unprinted.remove(part)
