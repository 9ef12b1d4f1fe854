"""Frames of the live page: results and events, packed for the viewers. No I/O, no clock."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.inference.contract import Contract
from edge.mapping.sink import MapState
from edge.perception.event import Event
from edge.sinks.json_encoding import event_record, pack, record
from edge.view.run_snapshot import MAX_FPS, Newest, NumberedEvent, Point, RunSnapshot
from firmware_bridge.errors import harmless
from firmware_bridge.links.base import SourceKind
from firmware_bridge.links.replay_player import PlayerState
from firmware_bridge.schedule import SENSOR_SILENT_NS


class Run(NamedTuple):
    """Facts that do not change during a run: of its source, and of the model that it begins with.

    A viewer that reconnects notices by the `id` that this is another run.
    """

    name: str
    kind: SourceKind
    model: str
    contract: Contract
    id: str


class Frames:
    """Frames of one moment; viewers at the same state get the same bytes.

    Attributes:
        now_ns: the moment, in [ns].
        map: state of the map; None where none is made.
    """

    def __init__(self, snapshot: RunSnapshot, now_ns: int, source: SourceKind | None) -> None:
        self.now_ns = now_ns
        self._source = source
        self._snapshot = snapshot
        self._newest = dict(snapshot.newest)
        self._packed: dict[tuple[str, int], bytes] = {}
        self.map = snapshot.map
        self._maps: dict[int, bytes] = {}

    @property
    def numbers(self) -> dict[str, int]:
        """Number of the newest result of every sensor."""
        return {sensor: newest.number for sensor, newest in self._newest.items()}

    def result(self, sensor: str, since: int) -> bytes:
        """Return the newest result of a sensor, with the trace after number `since`."""
        if (sensor, since) not in self._packed:
            self._packed[sensor, since] = self._pack(self._newest[sensor], since)
        return self._packed[sensor, since]

    def events(self, since: int) -> list[tuple[int, bytes]]:
        """Return the latest events after number `since`, with their numbers."""
        return [(sent.number, self._event(sent)) for sent in self._snapshot.events(since)]

    def map_since(self, seen: MapState | None) -> bytes:
        """Return what has changed on the map, which must be made, since a state that a viewer has; None for none."""
        if self.map is None:
            raise ValueError("no map is made")
        number = 0 if seen is None else seen.number
        if number not in self._maps:
            self._maps[number] = _map_frame(self.map, seen)
        return self._maps[number]

    def silent(self) -> dict[str, float]:
        """Return the silent sensors, and for how long each has been silent, in [s]."""
        away_ns = {sensor: self.now_ns - newest.received_ns for sensor, newest in self._newest.items()}
        return {sensor: round(ns / 1e9, 1) for sensor, ns in away_ns.items() if ns > SENSOR_SILENT_NS}

    def _event(self, sent: NumberedEvent) -> bytes:
        fields = event_record(sent.event, sent.counters, self._source)
        return _event(fields, self.now_ns - sent.received_ns, {"number": sent.number})

    def _pack(self, newest: Newest, since: int) -> bytes:
        result = newest.result
        first_ns = self._snapshot.first_ns or 0
        header: dict[str, Any] = {
            **record(result, newest.counters),
            "kind": "result",
            "note_kinds": [note.kind for note in result.notes],
            "untrusted_text": result.untrusted_text,
            "rate_hz": None if newest.rate_hz is None else round(newest.rate_hz, 2),
            "age_s": _seconds(self.now_ns - newest.received_ns),
            # The loop may have added points since; they belong to the next frame, which begins after this one.
            "trace": [
                _drawn(point, first_ns)
                for point in self._snapshot.points(result.scan.sensor, since)
                if point.number <= newest.number
            ],
        }
        taps = None if result.window is None else result.window[: result.taps_used, 2]
        maps = {"zeroed": result.zeroed, "pattern": result.pattern, "deviation": result.deviation, "taps": taps}
        return pack(header, {name: values for name, values in maps.items() if values is not None})


def _map_frame(state: MapState, seen: MapState | None) -> bytes:
    box = state.since(seen)
    header = {
        "kind": "map",
        "number": state.number,
        "pixels": state.grid.pixels,
        "px_per_mm": state.grid.px_per_mm,
        "centre_mm": state.grid.centre_mm,
        "from": [0, 0] if box is None else [box.top, box.left],
        "pads": {name: [pose.x_mm, pose.y_mm, pose.turn_deg] for name, pose in state.pads.items()},
        "counts": state.counts,
    }
    if box is None:
        return pack(header, {})
    part = np.s_[box.top : box.bottom, box.left : box.right]
    return pack(header, {"contact": state.contact[part], "doubted": state.doubted[part]})


def hello(run: Run, recording: Path | None) -> bytes:
    """Return the first frame that a viewer gets."""
    contract = run.contract
    height, width = contract.pattern_shape
    header = {
        "kind": "hello",
        "version": 1,
        "run": run.id,
        "name": harmless(run.name),
        "source": run.kind,
        "model": run.model,
        "taps": contract.taps,
        "pattern_unit": contract.output_unit,
        "full_scale": contract.output_full_scale,
        "contact_level": contract.contact_level,
        "pixel_pitch_mm": contract.pitch_mm / contract.scale,
        "taxel_pitch_mm": contract.pitch_mm,
        "rows": contract.rows,
        "cols": contract.cols,
        "height": height,
        "width": width,
        "wrench": contract.traction_scale is not None,
        "checks": bool(contract.trust),
        "recording": _path(recording),
        "max_fps": MAX_FPS,
    }
    return pack(header, {})


def state(
    recording: Path | None,
    viewers: int,
    silent: dict[str, float],
    played: PlayerState | None = None,
    recorded: tuple[float, int] | None = None,
) -> bytes:
    """Return the frame of the run's state apart from its results; `recorded` is length in [s] and size in bytes."""
    header = {"kind": "state", "recording": _path(recording), "viewers": viewers, "silent": silent}
    header["recorded_s"], header["recorded_bytes"] = (None, None) if recorded is None else recorded
    return pack(header | {"replay": None if played is None else played._asdict()}, {})


def refused(time_ns: int, why: str, source: SourceKind | None) -> bytes:
    """Return the answer to a message that is no command: without a number, since it is no event of the run."""
    return _event(event_record(Event(time_ns, "refused", None, why), {}, source), 0, {})


def _event(fields: Mapping[str, Any], age_ns: int, number: Mapping[str, int]) -> bytes:
    return pack({**fields, **number, "kind": "event", "age_s": _seconds(age_ns)}, {})


def _path(path: Path | None) -> str | None:
    return None if path is None else harmless(str(path))


def _drawn(point: Point, first_ns: int) -> list[float | None]:
    values = (point.force_counts, 1), (point.area_mm2, 2), (point.force_n, 4), (point.shear_ratio, 3)
    return [_seconds(point.time_ns - first_ns), *(None if value is None else round(value, n) for value, n in values)]


def _seconds(ns: int) -> float:
    return round(ns / 1e9, 3)
