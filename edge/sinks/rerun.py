"""Patterns, forces and events in a Rerun viewer as they come, or in an .rrd file that it opens later."""

import socket
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from edge.errors import SinkError, UsageError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink, check_new
from firmware_bridge.errors import how_to_install
from firmware_bridge.schedule import NS_PER_S

_NUMBERS: Final = ("force_counts", "force_n", "area_mm2", "interval_mm", "mismatch")
_MAPS: Final = ("pattern", "deviation")


def check_target(target: str) -> None:
    """Raise a UsageError where a target is none of the forms that `RerunSink` takes."""
    host, _, port = target.rpartition(":")
    if not (target == "view" or target.endswith(".rrd") or (host and port.isdecimal())):
        raise UsageError(
            f"sink 'rerun:{target}' names {target!r}, expected rerun:view for a viewer of its own, rerun:HOST:PORT for "
            "one that is open, usually at port 9876, or rerun:FILE.rrd"
        )


class RerunSink(Sink):
    """Sender to a viewer of Rerun 0.24 or later, the versions that LeRobot takes included.

    A pattern that is not believed is at SENSOR/not_believed/pattern, so that nobody takes it for one at SENSOR/pattern;
    both are cleared as soon as the newest scan has no pattern.
    """

    def __init__(self, target: str, contract: Contract, source: Source) -> None:
        """Open a viewer, connect to one, or begin a file; a SinkError where Rerun is missing, too old, or fails."""
        try:
            rerun: Any = import_module("rerun")
            installed = version("rerun-sdk")
        except (ImportError, PackageNotFoundError) as error:
            raise SinkError(f"rerun: needs rerun-sdk: {how_to_install('rerun')}") from error
        if tuple(map(int, installed.split(".")[:2])) < (0, 24):
            raise SinkError(f"rerun: rerun-sdk is {installed}, expected 0.24 or later: {how_to_install('rerun')}")
        self._rerun = rerun
        self._stream: Any = rerun.RecordingStream(f"tactile_edge_sr, {source.kind}")
        self._of_maps = {"meter": 1000.0, "depth_range": (0.0, contract.output_full_scale), "colormap": "viridis"}
        self._first_ns: int | None = None
        self._shown: dict[str, str] = {}  # where the newest pattern of each sensor is shown
        try:
            if target == "view":
                self._stream.spawn()
            elif target.endswith(".rrd"):
                check_new(Path(target))
                self._stream.save(target)
            else:
                host, _, port = target.rpartition(":")
                # Rerun itself would wait for a viewer for ever, with all that is sent in memory.
                socket.create_connection((host, int(port)), 2.0).close()
                self._stream.connect_grpc(f"rerun+http://{target}/proxy")
        except (OSError, OverflowError, RuntimeError, ValueError) as error:
            raise SinkError(f"rerun:{target}: {error}") from error

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Send the numbers of a scan, and its maps where they are new."""
        rerun, sensor = self._rerun, result.scan.sensor
        self._at(result.scan.time_ns)
        for name in _NUMBERS:
            value = getattr(result, name)
            if value is not None:
                self._stream.log(f"{sensor}/{name}", rerun.Scalars(value))
        for event in result.events:
            self._stream.log("events", rerun.TextLog(f"sensor {sensor}: {event.text}"))
        place = "" if result.pattern is None else sensor if result.trusted is True else f"{sensor}/not_believed"
        before = self._shown.get(sensor, "")
        if before and place != before:
            for name in _MAPS:
                self._stream.log(f"{before}/{name}", rerun.Clear(recursive=False))
        self._shown[sensor] = place
        if place and (place != before or result.reused_from is None):
            for name in _MAPS:
                if (values := getattr(result, name)) is not None:
                    self._stream.log(f"{place}/{name}", rerun.DepthImage(values, **self._of_maps))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Send an event."""
        self._at(event.time_ns)
        self._stream.log("events", self._rerun.TextLog(event.text))

    def _at(self, time_ns: int) -> None:
        self._first_ns = time_ns if self._first_ns is None else self._first_ns
        self._stream.set_time("scan_time", duration=(time_ns - self._first_ns) / NS_PER_S)

    def close(self) -> None:
        """Send what is under way, and end."""
        self._stream.disconnect()
