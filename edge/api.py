"""The runtime as a library: open a source, make a runtime, take every result or the newest.

    with open_source("slcan:serial=D30BL366") as source:
        for result in Stream(source, open_runtime("stsr-int8", source)):
            print(result.force_counts)

A control loop calls `stream.latest()` instead, which returns the newest result with its age and never waits. A request
that cannot be met raises a BridgeError or an EdgeError with one clear line.
"""

import importlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edge.errors import EdgeError, ModelError, NoResultError, SinkClosedError, SinkError, UsageError, WindowError
from edge.inference.bundled import (
    DEFAULT_MODEL,
    POSED_MODEL,
    bundled_models,
    demo_recording,
    example_recording,
    find_model,
)
from edge.inference.contract import Contract, Model
from edge.perception.event import Event, Note
from edge.perception.result import NextTap, Result, Wrench
from edge.perception.runtime import Runtime
from edge.pipeline.commands import Command, Commands
from edge.pipeline.pose_queue import PoseQueue
from edge.pipeline.result_stream import Latest, Stream, paired, pump
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.runtime_setup import infer, load_model, open_recording, open_runtime
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.pipeline.source_setup import links_to, sensor_settings
from edge.sinks.registry import Fan, open_sink
from firmware_bridge.errors import (
    BaselineRefusedError,
    BridgeError,
    DeviceError,
    LinkLostError,
    NoDeviceError,
    RecordingError,
    SensorFileError,
    SourceError,
)
from firmware_bridge.links.base import SourceKind
from firmware_bridge.links.registry import DEMO_LOOP
from firmware_bridge.pad_geometry import USPA44, USPA46, SensorGeometry
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.scans.can_id_maps import ID_MAPS, ModelMap, layout_c
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorFile, load_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines

if TYPE_CHECKING:
    from edge.doctor.examine import examine
    from edge.mapping.sink import MapSink, ObjectMap
    from edge.perception.patches import Patch, PatchEvent, PatchEvents, patches
    from edge.pipeline.baseline_capture import take_baselines
    from edge.pose_sources import PoseSource, open_poses
    from firmware_bridge.links.discovery import devices

# Modules that only some callers need, above all onnxruntime, are imported on use, for start-up time and memory.
_ON_USE: Final = {
    "edge.doctor.examine": ["examine"],
    "edge.mapping.sink": ["MapSink", "ObjectMap"],
    "edge.perception.patches": ["Patch", "PatchEvent", "PatchEvents", "patches"],
    "edge.pipeline.baseline_capture": ["take_baselines"],
    "edge.pose_sources": ["PoseSource", "open_poses"],
    "firmware_bridge.links.discovery": ["devices"],
}
# fmt: off
__all__ = [
    "DEFAULT_MODEL", "DEMO_LOOP", "ID_MAPS", "POSED_MODEL", "USPA44", "USPA46", "Baseline", "BaselineRefusedError",
    "BridgeError", "Command", "Commands", "Contract", "DeviceError", "EdgeError", "Event", "Fan", "Latest",
    "LinkLostError", "MapSink", "Model", "ModelError", "ModelMap", "NextTap", "NoDeviceError",
    "NoResultError", "Note", "ObjectMap", "Pad", "PadPose", "Patch", "PatchEvent", "PatchEvents", "PoseQueue",
    "PoseSource", "RecordingError", "Result", "Runtime", "Scan", "SensorFile", "SensorFileError", "SensorGeometry",
    "Sink", "SinkClosedError", "SinkError", "Source", "SourceError", "SourceKind", "Statistics", "Stream",
    "TimedPose", "UsageError", "WindowError", "Wrench", "bundled_models", "demo_recording", "devices", "examine",
    "example_recording", "find_model", "infer", "layout_c", "load_baselines", "load_model", "load_sensor_file",
    "open_poses", "open_recording", "open_runtime", "open_sink", "open_source", "paired", "patches", "pump",
    "save_baselines", "take_baselines",
]
# fmt: on


def __getattr__(name: str) -> Any:
    """Return what is imported on use."""
    for module, names in _ON_USE.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def open_source(
    *texts: str,
    sensor: str | Path | None = None,
    id_map: str | ModelMap | None = None,
    rate_hz: float | None = None,
    give_up_s: float = math.inf,
) -> Source:
    """Return a source of scans for a with statement; it reopens links that are lost while it is open.

    Texts are forms of `edge-sr --source`, several with names, "left=slcan:..."; without any it is the adapter of the
    sensor file, or the one that is plugged in. What the doctor's `sensor` file states holds for every runtime of this
    source, before what a recording states. The id map, one of ID_MAPS or one of your own, as of `layout_c`, gives
    the pad, too. `rate_hz` is that at which a recording is played, and sets the deadlines of a device's patterns. A
    source that is away for `give_up_s` [s] is an error, at 0 at once. Raises SourceError, NoDeviceError,
    RecordingError, SensorFileError or UsageError.
    """
    if not give_up_s >= 0:
        raise UsageError(f"give_up_s is {give_up_s}, expected 0 or more")
    links, sensor_file = links_to(texts, sensor_settings(sensor, id_map), rate_hz)
    return Source(*links, sensor_file=sensor_file, rate_hz=rate_hz, give_up_s=give_up_s)
