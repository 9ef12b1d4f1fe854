"""Map of the demo's slide, beside the truth."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from edge.cli.demo_scenes import SLIDE, scene_of
from edge.evaluation.metrics import boundary_distance_mm
from edge.mapping.live_map import MapState
from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.terminal.heatmap import Palette, Panel, draw
from firmware_bridge.poses.timed_pose import TimedPose

_MARGIN_MM: Final = 1.0
"""Part of the map that is drawn around the letter, in [mm]."""
_WIDEST: Final = 72


class DemoMap(Sink):
    """Sink that fuses the results of the slide alone into a map.

    Attributes:
        begun: True once the slide has begun.
        complete: True once it is over.
    """

    def __init__(
        self,
        recording: Path,
        show: Callable[[MapState], object] | None,
        on_complete: Callable[["DemoMap"], object] = lambda made: None,
    ) -> None:
        """Load the truth.

        Args:
            recording: .npz that has, in addition to `counts` and `scene`: `letter` (H, H), True where the letter is
                raised; `letter_px_per_mm`; `letter_centre_mm` in the object's plane.
            show: takes the states of the map.
            on_complete: called with this, once, when the slide is over.
        """
        with np.load(recording, allow_pickle=False) as data:
            self._letter = data["letter"]
            px_per_mm = float(data["letter_px_per_mm"])
            x_mm, y_mm = data["letter_centre_mm"].tolist()
        self._scenes = scene_of(recording)
        size_mm = len(self._letter) / px_per_mm
        self._sink = MapSink(ObjectMap(size_mm, px_per_mm, centre_mm=(x_mm, y_mm)), show=show)
        self._on_complete = on_complete
        self.begun = self.complete = False

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Take poses, before the results that belong to them."""
        self._sink.pose(poses)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Fuse the results of the slide."""
        scene = self._scenes.get(result.scan.counts.tobytes())
        if scene == SLIDE:
            self.begun = True
            self._sink.write(result, counters)
        elif scene is not None and self.begun and not self.complete:
            self.complete = True
            self._on_complete(self)

    def wait(self) -> None:
        """Show what has come since the last state."""
        self._sink.wait()

    def close(self) -> None:
        """Take the presses that have not ended, and show the last state."""
        self._sink.close()

    def text(self, columns: int, palette: Palette) -> str:
        """Return the map's distance from the truth, and both as pictures."""
        whole = self._sink.whole
        if not whole.fused:
            return f"the letter is not on the map: {self._sink.summary()}"
        contact = np.nan_to_num(whole.contact()[0])
        px_per_mm = whole.grid.px_per_mm
        away_mm = float(boundary_distance_mm(contact[None], self._letter[None], 0.5, 1 / px_per_mm)[0])
        rows, cols = (np.flatnonzero(self._letter.any(axis=axis)) for axis in (1, 0))
        margin = round(_MARGIN_MM * px_per_mm)
        shown = tuple(slice(max(0, one[0] - margin), one[-1] + 1 + margin) for one in (rows, cols))
        length_mm = (cols[-1] + 1 - cols[0]) / px_per_mm
        title = f"map of a letter of {length_mm:.0f} mm, from one slide: {whole.fused} patterns fused, "
        panels = [
            Panel("map", contact[shown], 0.0, 1.0, "touched"),
            Panel("truth", self._letter[shown].astype(np.float64), 0.0, 1.0, "touched"),
        ]
        pictures = "\n\n".join(draw([panel], columns, palette, widest=_WIDEST) for panel in panels)
        return f"{title}outline {away_mm:.2f} mm from the truth\n{pictures}"
