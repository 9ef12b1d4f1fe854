"""Sinks that make a run the demo: its robot, its scenes, and what it prints beside the truth."""

import os
import shutil
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, TextIO

from edge.cli.demo_map import DemoMap
from edge.cli.demo_scenes import DemoRobot, DemoScenes
from edge.cli.demo_score import DemoScore, Scored, score_picture, score_table
from edge.inference.bundled import demo_recording
from edge.perception.event import Event
from edge.pipeline.commands import RESET, Commands
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.terminal.heatmap import choose_palette
from edge.terminal.text_wrap import drawn

if TYPE_CHECKING:
    from edge.view.live_view import LiveView


class Demo:
    """Parts of the demo around one run.

    Args:
        model: that is scored.
        source: the demo's, open.
        stream: of what is printed.
        view: the live page, which shows the map; None without.
        loops: the demo goes on after its end, so that each part is printed once it is complete.
        maps: the demo makes a map; False where the user does.
    """

    def __init__(
        self, model: Scored, source: Source, stream: TextIO, view: "LiveView | None", *, loops: bool, maps: bool
    ) -> None:
        recording = demo_recording()
        self._stream, self._view, self._loops = stream, view, loops
        self._score = DemoScore(recording, model, self._completed)
        show = None if view is None else view.show_map
        self._map = DemoMap(recording, show, self._completed) if maps else None
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
        columns = shutil.get_terminal_size().columns
        if isinstance(part, DemoMap):
            if part.begun:
                print(f"\n{part.text(columns, palette)}", file=stream)
            return
        scores = part.scores()
        if not scores:
            print(f"\nnone of {part.taps} taps scored: the run ended before a tap had a pattern", file=stream)
            return
        print(f"\n{len(scores)} of {part.taps} taps scored at their peak, against the simulated truth:", file=stream)
        print(score_table(scores), file=stream)
        print(f"\ntap {scores[-1].tap + 1}:\n{score_picture(scores[-1], columns, palette)}", file=stream)
