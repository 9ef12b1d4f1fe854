"""Sink that fuses the results of a run into a map, shows it now and then, and writes its files at the end."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from edge.errors import SinkError
from edge.mapping.live_map import LiveMap, MapState
from edge.mapping.map_files import check_npz, save_npz, save_png
from edge.mapping.object_map import ObjectMap
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from firmware_bridge.in_place import check_writable, write_in_place
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.pose_track import PoseTrack
from firmware_bridge.poses.timed_pose import TimedPose

SHOW_NS: Final = 250_000_000
"""Time between two states that are shown, in [ns], of a map of SHOWN_PX pixels; larger ones are shown less often."""
SHOWN_PX: Final = 240 * 240


class MapSink(Sink):
    """Fusion of results at the poses that belong to them.

    Attributes:
        whole: the map.
        without_pose: patterns without a pose, which are left out.
    """

    def __init__(
        self,
        whole: ObjectMap,
        *,
        npz: Path | None = None,
        png: Path | None = None,
        show: Callable[[MapState], object] | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Check that the files can be written.

        Args:
            whole: the map to fuse into.
            npz: file of the layers, written on `close`.
            png: picture, written on `close`.
            show: called with the map's state a few times a second; it must not wait.
            clock_ns: monotonic, in [ns].

        Raises:
            SinkError: a file exists, or cannot be written.
        """
        self.whole = whole
        self.without_pose = 0
        self.show = show
        self._files = [(path, save) for path, save in ((npz, self._save_npz), (png, self._save_png)) if path]
        for path, _ in self._files:
            if path.exists():
                raise SinkError(f"{path} exists: give another name, or delete it first")
            try:
                check_writable(path)
            except OSError as error:
                raise SinkError(f"cannot write {path}: {error.strerror}") from error
        self._facts: dict[str, str] = {}
        self._tracks: dict[str | None, PoseTrack] = {}
        self._pads: dict[str, PadPose] = {}
        self._live = LiveMap(whole.grid)
        self._clock_ns = clock_ns
        self._pause_ns = SHOW_NS * max(1, whole.grid.pixels**2 // SHOWN_PX)
        self._due_ns = 0
        self._unseen = False

    @property
    def trouble(self) -> str | None:  # noqa: D102 - of Sink
        if self.without_pose and not self.whole.fused:
            return f"{self.without_pose} patterns came without a pose, so the map is empty: send poses of the pad"
        return None

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Take poses, before the results that belong to them."""
        for one in poses:
            self._tracks.setdefault(one.sensor, PoseTrack()).add(one.time_ns, one.pose, holds=one.holds)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Fuse a result at the pose that its pad had at its scan.

        Raises:
            UsageError: its pattern is not in [mm].
        """
        sensor = result.scan.sensor
        track = self._tracks.get(sensor) or self._tracks.get(None)
        pose = None if track is None else track.at(result.scan.time_ns)
        if pose is None:
            self._pads.pop(sensor, None)
            self.without_pose += result.pattern is not None
        else:
            self._pads[sensor] = pose
        self._facts = {"model": result.model, "source": result.source}
        self.whole.add(result, pose)
        self._unseen = True
        self._show()

    def wait(self) -> None:
        """Show what has come since the last state, once no scan follows."""
        self._show()

    def close(self) -> None:
        """Take the presses that have not ended, show the last state, and write the files; nothing fused, no file.

        Raises:
            SinkError: a file cannot be written.
        """
        self.whole.finish()
        self._due_ns, self._unseen = 0, True
        self._show()
        if not self.whole.fused:
            return
        for path, save in self._files:
            try:
                write_in_place(path, save, check_npz if path.suffix == ".npz" else partial(Path.stat))
            except (OSError, ValueError, KeyError) as error:
                raise SinkError(f"cannot write {path}: {error}") from error

    def summary(self) -> str:
        """Return what the map holds, in a line."""
        whole = self.whole
        parts = [f"{whole.fused} patterns fused"]
        left_out = {"not believed": whole.doubted, "too light": whole.light, "outside the map": whole.outside}
        left_out["without a pose"] = self.without_pose
        parts += [f"{count} {why}" for why, count in left_out.items() if count]
        written = " and ".join(str(path) for path, _ in self._files if path.exists())
        return f"map: {', '.join(parts)}; {written or 'no file'} written"

    def _save_npz(self, path: Path) -> None:
        save_npz(path, self.whole, **self._facts)

    def _save_png(self, path: Path) -> None:
        save_png(path, self.whole)

    def _show(self) -> None:
        if self.show is None or not self._unseen or self._clock_ns() < self._due_ns:
            return
        self._due_ns, self._unseen = self._clock_ns() + self._pause_ns, False
        whole = self.whole
        counts = {"fused": whole.fused, "doubted": whole.doubted, "light": whole.light, "outside": whole.outside}
        self.show(self._live.next(*whole.contact(), self._pads, counts | {"without_pose": self.without_pose}))
