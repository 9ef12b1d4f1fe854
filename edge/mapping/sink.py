"""Sink that fuses the results of a run into a map, shows it now and then, and writes its npz at the end."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from math import hypot
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import SinkError
from edge.mapping.object_map import MapLayers, ObjectMap
from edge.perception.result import Result
from edge.pipeline.sink import Sink, check_new
from firmware_bridge.in_place import write_in_place
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import GAP_NS, PadPose
from firmware_bridge.schedule import SENSOR_SILENT_NS


class MapState(NamedTuple):
    """State of a map as it is shown."""

    contact: NDArray[np.float32]  # (H, W), probability of a touch; NaN where nothing came, -1 where all was doubted
    pads: Mapping[str, PadPose]  # by sensor
    counts: Mapping[str, int]  # patterns by their fate
    size_mm: float
    centre_mm: tuple[float, float]


SHOW_NS: Final = 500_000_000  # time between two states that are shown; longer for a larger map, which costs more
MOST_SHOWN_PX: Final = 500  # along a side of a map as it is shown, of a larger one every second or third


class MapSink(Sink):
    """Fusion of results at their poses into `whole`, a map; after a reset, as for a new object, the next one."""

    uses_poses = True

    def __init__(
        self,
        whole: ObjectMap,
        *,
        npz: Path | None = None,
        show: Callable[[MapState], object] | None = None,
        origin: SourceKind | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Take the file to write on `close` and at a reset, later ones with a number, or raise a SinkError.

        `show` is called with the map's state a few times a second and must not wait. `origin` is the kind of source
        that the scans of a recording come from.
        """
        self.whole = whole
        self.without_pose = self.together = 0  # patterns left out, the latter of pads at one place by their poses
        self.show, self.origin = show, origin
        self._before: Counter[str] = Counter()
        self._written: list[Path] = []
        self._path = self._first_path = npz
        if npz is not None:
            check_new(npz)
        self._facts: dict[str, str] = {}
        self._pads: dict[str, tuple[PadPose, int]] = {}
        self._clock_ns = clock_ns
        self._due_ns = 0
        self._unseen = False

    @property
    def fused(self) -> int:
        """Patterns on all maps."""
        return self._before["fused"] + self.whole.fused

    @property
    def trouble(self) -> str | None:  # noqa: D102 - of Sink
        if self.without_pose and not self.fused:
            return f"{self.without_pose} patterns came without a pose, so the map is empty: send poses of the pad"
        if self.together:
            why = "each pose needs the name of its sensor"
            return f"{self.together} patterns of two pads at one place are left out: {why}"
        return None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Fuse a result at its pose, on the next map if taps were forgotten."""
        if any(event.kind == "reset" for event in result.events):
            self._begin_next()
        sensor, pose = result.scan.sensor, result.pose
        if pose is None:
            self._pads.pop(sensor, None)
            self.without_pose += result.pattern is not None
        else:
            self._pads[sensor] = pose, result.scan.time_ns
            if len(self._pads) > 1 and self._is_shared(sensor, pose, result.scan.time_ns):
                self.together += result.pattern is not None
                pose = None
        self._facts = {"model": result.model, "source": result.source, "origin": self.origin or result.source}
        self.whole.add(result, pose)
        self._unseen = True
        self._show()

    def wait(self) -> None:
        """Show what has come since the last state, once no scan follows."""
        self._show()

    def close(self) -> None:
        """Take the presses that have not ended, write the file, and show the last state."""
        self._save()
        self._due_ns, self._unseen = 0, True
        self._show()

    def summary(self) -> str:
        """Return what the map holds, in a line."""
        counts = self._before + Counter(self._counts)
        parts = [f"{counts['fused']} patterns fused"]
        left_out = {"doubted": "not believed", "light": "too light", "outside": "outside the map"}
        left_out |= {"without_pose": "without a pose", "together": "of two pads at one place"}
        parts += [f"{counts[name]} {why}" for name, why in left_out.items() if counts[name]]
        emulated = " (EMULATED)" if self._facts.get("origin") == "emulated" else ""
        return f"map{emulated}: {', '.join(parts)}; {' and '.join(map(str, self._written)) or 'no file'} written"

    @property
    def _counts(self) -> dict[str, int]:
        return self.whole.counts | {"without_pose": self.without_pose, "together": self.together}

    def _is_shared(self, sensor: str, pose: PadPose, time_ns: int) -> bool:
        """Return whether another pad is within half a pad by its pose: then one has poses that are not its own."""
        near_mm = USPA44.rows * USPA44.pitch_mm / 2
        return any(
            abs(time_ns - at_ns) <= GAP_NS and hypot(pose.x_mm - other.x_mm, pose.y_mm - other.y_mm) < near_mm
            for name, (other, at_ns) in self._pads.items()
            if name != sensor
        )

    def _begin_next(self) -> None:
        self._save()
        self._before += Counter(self.whole.counts)
        self.whole = self.whole.blank()
        first, number = self._first_path, 1 + len(self._written)  # one that was written may be gone by now
        while first is not None and _numbered(first, number).exists():
            number += 1
        self._path = None if first is None else _numbered(first, number)

    def _save(self) -> None:
        """Take the presses that have not ended, and write the file of the map; nothing fused, no file."""
        self.whole.finish()
        path = self._path
        if path is None or not self.whole.fused or path in self._written:
            return
        try:
            write_in_place(path, partial(save_npz, whole=self.whole, **self._facts), check_npz)
        except (OSError, ValueError, KeyError) as error:
            raise SinkError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}") from error
        self._written.append(path)

    def _show(self) -> None:
        if self.show is None or not self._unseen or self._clock_ns() < self._due_ns:
            return
        grid = self.whole.grid
        step = -(-grid.pixels // MOST_SHOWN_PX)
        self._due_ns, self._unseen = self._clock_ns() + SHOW_NS * step**2, False
        seen_ns = max((time_ns for _, time_ns in self._pads.values()), default=0)
        pads = {name: pose for name, (pose, at_ns) in self._pads.items() if seen_ns - at_ns <= SENSOR_SILENT_NS}
        contact, doubted = self.whole.contact()
        contact[np.isnan(contact) & (doubted > 0)] = -1
        size_mm = grid.pixels / grid.px_per_mm
        self.show(MapState(contact[::step, ::step], pads, self._counts, size_mm, grid.centre_mm))


def _numbered(path: Path, number: int) -> Path:
    return path if number == 1 else path.with_stem(f"{path.stem}-{number}")


FORMAT: Final = "tactile-object-map"


def save_npz(path: Path, whole: ObjectMap, **facts: str) -> None:
    """Write the layers of a map, its place and its counts; facts are added as texts."""
    layers = whole.layers()
    arrays: dict[str, Any] = {name: getattr(layers, name) for name in MapLayers.__dataclass_fields__}
    arrays |= {f"{name}_patterns": np.array(count) for name, count in whole.counts.items()}
    arrays |= {name: np.array(text) for name, text in facts.items()}
    arrays |= {"px_per_mm": np.array(whole.grid.px_per_mm), "centre_mm": np.array(whole.grid.centre_mm)}
    np.savez_compressed(path, format=np.array(FORMAT), version=np.array(1), **arrays)


def check_npz(path: Path) -> None:
    """Read a file back, as its readers will; raises ValueError or KeyError if it is not a map."""
    with np.load(path, allow_pickle=False) as data:
        shapes = {data[name].shape for name in MapLayers.__dataclass_fields__}
        if str(data["format"]) != FORMAT or len(shapes) != 1:
            raise ValueError(f"{path} is not a map")
