"""Facts of a run that its sinks need beside its results."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from edge.pipeline.commands import Commands
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.pad_frame import PadFrame


@dataclass(frozen=True, slots=True)
class RunFacts:
    """Facts of a run.

    Attributes:
        lossless: wait for slow readers and disks, rather than leave records out.
        mountings: of the sensors, by name.
        frames: places of the pads on the robot, by sensor name.
        geometry: of the sensors.
        unix_offset_ns: added to the time of a scan gives [ns] since 1970; None where scans are of now.
        source: kind of the source, written with events.
        origin: kind of source that the scans come from, where a recording names it.
        stop: set when the run is to end: then no slow reader is waited for.
        commands: takes those that come over a sink that was asked to accept them.
        fields: those of JSON records, such as "force_n,pattern"; None for all.
    """

    lossless: bool = True
    mountings: Mapping[str, Mounting] = field(default_factory=dict)
    frames: Mapping[str, PadFrame] = field(default_factory=dict)
    geometry: SensorGeometry = USPA44
    unix_offset_ns: int | None = None
    source: str | None = None
    origin: SourceKind | None = None
    stop: threading.Event = field(default_factory=threading.Event)
    commands: Commands | None = None
    fields: str | None = None


NOW: Final = RunFacts()
"""Facts of a run of scans of now, of which nothing else is known."""
