"""Sinks that make a run the demo: its robot, its scenes, its map, and what it prints beside the truth."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO

import numpy as np

from edge.cli.demo_scenes import SLIDE, DemoRobot, DemoScenes, scene_of
from edge.cli.demo_score import DemoScore, score_picture, score_table
from edge.evaluation.metrics import boundary_distance_mm
from edge.inference.bundled import demo_recording
from edge.inference.model_interface import Model
from edge.mapping.live_map import MapState
from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.commands import RESET, Commands
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.terminal.heatmap import Palette, Panel, choose_palette, draw
from edge.terminal.text_wrap import columns, drawn

if TYPE_CHECKING:
    from edge.view.live_view import LiveView

_MARGIN_MM: Final = 1.0
"""Part of the map that is drawn around the letter, in [mm]."""
_WIDEST: Final = 72


class DemoMap(MapSink):
    """Map of the slide alone, beside the truth: `begun` and `complete` are true once the slide has, or is."""

    def __init__(
        self, recording: Path, show: Callable[[MapState], object] | None, on_complete: Callable[["DemoMap"], object]
    ) -> None:
        """Load the truth, the letter; `on_complete` is called once, when the slide is over."""
        with np.load(recording, allow_pickle=False) as data:
            self._letter = data["letter"]
            px_per_mm, centre_mm = float(data["letter_px_per_mm"]), data["letter_centre_mm"].tolist()
        super().__init__(ObjectMap(len(self._letter) / px_per_mm, px_per_mm, centre_mm=tuple(centre_mm)), show=show)
        self._scenes = scene_of(recording)
        self._on_complete = on_complete
        self.begun = self.complete = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Fuse the results of the slide."""
        scene = self._scenes.get(result.scan.counts.tobytes())
        if scene == SLIDE:
            self.begun = True
            super().write(result, counters)
        elif scene is not None and self.begun and not self.complete:
            self.complete = True
            self._on_complete(self)

    def text(self, palette: Palette) -> str:
        """Return the map's distance from the truth, and both as pictures."""
        if not self.whole.fused:
            return f"the letter is not on the map: {self.summary()}"
        contact = np.nan_to_num(self.whole.contact()[0])
        px_per_mm = self.whole.grid.px_per_mm
        away_mm = float(boundary_distance_mm(contact[None], self._letter[None], 0.5, 1 / px_per_mm)[0])
        rows, cols = (np.flatnonzero(self._letter.any(axis=axis)) for axis in (1, 0))
        margin = round(_MARGIN_MM * px_per_mm)
        shown = tuple(slice(max(0, one[0] - margin), one[-1] + 1 + margin) for one in (rows, cols))
        length_mm = (cols[-1] + 1 - cols[0]) / px_per_mm
        title = f"map of a letter of {length_mm:.0f} mm, from one slide: {self.whole.fused} patterns fused, "
        panels = [
            Panel("map", contact[shown], 0.0, 1.0, "touched"),
            Panel("truth", self._letter[shown].astype(np.float64), 0.0, 1.0, "touched"),
        ]
        pictures = "\n\n".join(draw([panel], columns(), palette, widest=_WIDEST) for panel in panels)
        return f"{title}outline {away_mm:.2f} mm from the truth\n{pictures}"


class Demo:
    """Parts of the demo around one run, which prints to `stream`, and shows its map on the live page, if there is one.

    Where it `loops`, it goes on after its end, and each part is printed once it is complete. It makes a map of its own
    where `maps` is true, and the user does not.
    """

    def __init__(
        self, model: Model, source: Source, stream: TextIO, view: "LiveView | None", *, loops: bool, maps: bool
    ) -> None:
        recording = demo_recording()
        self._stream, self._view, self._loops = stream, view, loops
        self._score = DemoScore(recording, model, self._completed)
        self._map = DemoMap(recording, None if view is None else view.show_map, self._completed) if maps else None
        # Without poses a model's taps must follow the paper's schedule, as the recording does.
        touch = source.steer() if model.contract.takes_poses else None
        self._robot = None if touch is None else DemoRobot(recording, touch)
        how = "where it is proposed" if self._robot else "by a fixed schedule"
        taps = f"{self._score.surface!r} {self._score.taps} times"
        sys.stderr.write(f"demo: an emulated sensor taps {taps}, {how}, zeroed first\n")

    def sinks(self, watching: Sequence[Sink], commands: Commands) -> list[Sink]:
        """Return the demo's sinks; scenes are announced to those of `watching`."""

        def tell(event: Event) -> None:
            for sink in watching:
                sink.tell(event, {})

        scenes = DemoScenes(demo_recording(), tell, lambda: commands.put(RESET))
        return [one for one in (self._score, self._robot, scenes, self._map) if one is not None]

    def finish(self) -> None:
        """Print what was not printed while the demo went on."""
        for part in (self._score, self._map):
            if part is not None and not (self._loops and part.complete):
                self._print(part)

    def _completed(self, part: DemoScore | DemoMap) -> None:
        if not self._loops:
            return
        self._print(part)
        if part is self._map or self._map is None:
            page = "" if self._view is None else f"live page: {self._view.url}; "
            sys.stderr.write(f"\n{page}the demo continues until Ctrl-C\n")

    def _print(self, part: DemoScore | DemoMap) -> None:
        stream = drawn(self._stream)
        palette = choose_palette(os.environ, terminal=stream.isatty(), encoding=stream.encoding)
        if isinstance(part, DemoMap):
            text = part.text(palette) if part.begun else ""
        elif scores := part.scores():
            text = f"{len(scores)} of {part.taps} taps scored at their peak, against the simulated truth:\n"
            text += f"{score_table(scores)}\n\ntap {scores[-1].tap + 1}:\n"
            text += score_picture(scores[-1], columns(), palette)
        else:
            text = f"none of {part.taps} taps scored: the run ended before a tap had a pattern"
        if text:
            stream.write(f"\n{text}\n")
