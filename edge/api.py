"""The runtime as a library: open a source, make a runtime, iterate over results.

    with open_source("slcan:serial=D30BL366") as source:
        for result in Stream(source, open_runtime("stsr-int8", source)):
            print(result.force_counts)

A source reads in a thread of its own; everything else happens in the thread that iterates and that makes the runtime. A
request that cannot be met raises a BridgeError or an EdgeError with one clear line.

`edge-sr` works through this module alone, except for its bench, its live page, and a doctor that asks for presses.
"""

import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from edge.doctor.unattended import examine
from edge.errors import EdgeError, MessageError, ModelError, SinkClosedError, SinkError, UsageError, WindowError
from edge.inference.bundled import DEFAULT_MODEL, DEMO_MODEL, TAXELS, bundled_models, demo_recording, find_model
from edge.inference.contract import Contract
from edge.inference.model_interface import Model
from edge.inference.timed_loading import unfinished_load
from edge.mapping.sink import MapSink, ObjectMap
from edge.perception.contact_options import IDLE_RESET_S, OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.event import Event, Note
from edge.perception.gain_learning import load_contact_model
from edge.perception.result import NextTap, Result
from edge.perception.runtime import Runtime
from edge.perception.wrench import Wrench
from edge.pipeline.baseline_capture import take_baselines
from edge.pipeline.commands import Command, Commands
from edge.pipeline.pose_queue import PoseQueue
from edge.pipeline.pump import pump
from edge.pipeline.result_stream import Stream
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.pipeline.source_setup import links_to, references, settled, with_recorded
from edge.pose_sources.open_poses import PoseSource, open_poses
from edge.sinks import registry as forms
from edge.sinks.fan_out import Fan
from edge.validation import check_positive, check_whole
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
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.can_id_maps import ID_MAPS, ModelMap, layout_c
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorFile, load_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines

if TYPE_CHECKING:
    from edge.inference.onnx_session import ModelSession
    from firmware_bridge.links.discovery import Found

# Modules that only some callers need, above all onnxruntime, are imported on use, for start-up time and memory.
__all__ = [
    "DEFAULT_MODEL",
    "DEMO_LOOP",
    "DEMO_MODEL",
    "ID_MAPS",
    "USPA44",
    "USPA46",
    "Baseline",
    "BaselineRefusedError",
    "BridgeError",
    "Command",
    "Commands",
    "Contract",
    "DeviceError",
    "EdgeError",
    "Event",
    "Fan",
    "LinkLostError",
    "MapSink",
    "MessageError",
    "Model",
    "ModelError",
    "ModelMap",
    "NextTap",
    "NoDeviceError",
    "Note",
    "ObjectMap",
    "Pad",
    "PadPose",
    "PoseQueue",
    "PoseSource",
    "RecordingError",
    "Result",
    "Runtime",
    "Scan",
    "SensorFile",
    "SensorFileError",
    "SensorGeometry",
    "Sink",
    "SinkClosedError",
    "SinkError",
    "Source",
    "SourceError",
    "SourceKind",
    "Statistics",
    "Stream",
    "TimedPose",
    "UsageError",
    "WindowError",
    "Wrench",
    "bundled_models",
    "choose_model",
    "demo_recording",
    "devices",
    "examine",
    "layout_c",
    "load_baselines",
    "load_model",
    "load_sensor_file",
    "open_poses",
    "open_recording",
    "open_runtime",
    "open_sink",
    "open_source",
    "pump",
    "save_baselines",
    "take_baselines",
    "unfinished_load",
]


def open_source(
    *texts: str,
    sensor: str | Path | None = None,
    id_map: str | ModelMap | None = None,
    rate_hz: float | None = None,
    give_up_s: float = math.inf,
    force: bool = False,
) -> Source:
    """Return a source of scans for a with statement; it reopens links that are lost while it is open.

    Args:
        texts: the forms of `edge-sr --source`: "slcan:serial=D30BL366", "replay:FILE", "demo", ...; several with names,
            "left=slcan:...". Without any, the adapter of the sensor file, or the one that is plugged in.
        sensor: file that `edge-sr doctor` wrote. The mountings, baselines, counts per newton and pads in it hold for
            every runtime of this source and take precedence over those in a recording.
        id_map: assignment of CAN ids to taxels, and with it the pad: one of ID_MAPS, or a map of your own, as
            `layout_c` makes one of a geometry.
        rate_hz: rate at which a recording is played; for a device, the rate that sets the deadlines of its patterns,
            in [Hz].
        give_up_s: longest time that a lost or silent source may be away, in [s]; at 0 its loss is an error at once.
        force: use a sensor file of an emulated sensor on a device, which opening the source refuses otherwise.

    Raises:
        SourceError: the form does not exist, a name occurs twice, or the sources are of several kinds.
        NoDeviceError: there is no adapter, or there are several and none was named.
        RecordingError: the recording cannot be used.
        SensorFileError: the sensor file cannot be used.
        UsageError: the id map does not exist or is not that of the sensor file; the rate or the time is out of range;
            a source is not a text.
    """
    if rate_hz is not None:
        check_positive("rate_hz", rate_hz)
    if not give_up_s >= 0:
        raise UsageError(f"give_up_s is {give_up_s}, expected 0 or more")
    known = settled(sensor, id_map)
    links = links_to(texts, known, rate_hz=rate_hz, give_up_s=give_up_s)
    return Source(*links, sensor_file=with_recorded(known, links), rate_hz=rate_hz, force=force)


def load_model(model: str | Path, threads: int = 1, stop: threading.Event | None = None) -> "ModelSession":
    """Load a model and its contract; call it in the thread that will run the model.

    Args:
        model: a file, or the name of a bundled one.
        threads: number of threads that share the work of one run.
        stop: event that ends the loading early.

    Raises:
        ModelError: the model does not exist or cannot be used; the message names the bundled ones or the fault.
        UsageError: the number of threads is out of range.
    """
    check_whole("threads", threads, 1)
    from edge.inference.onnx_session import ModelSession

    return ModelSession(find_model(model), threads, stop)


def choose_model(
    model: str | Path,
    budget_us: float,
    *,
    rate_hz: float | None = None,
    recalibrate: bool = False,
    stop: threading.Event | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> "ModelSession | None":
    """Load the most accurate model whose run time on this machine is within a budget, as `edge-sr --budget-us` does.

    Args:
        model: the best model that may be used: a file, or the name of a bundled one.
        budget_us: longest run time of a pattern, in [us].
        rate_hz: rate of the sensor, in [Hz]; 100 by default.
        recalibrate: measure again although stored run times exist.
        stop: event that ends the measurement early.
        tell: called with one line each about what is measured, what is wrong and which model was chosen.

    Returns:
        The model, or None if it was stopped.

    Raises:
        ModelError: the model cannot be used, or its contract does not state its error.
        UsageError: the budget or the rate is out of range.
    """
    check_positive("budget_us", budget_us)
    if rate_hz is not None:
        check_positive("rate_hz", rate_hz)
    from edge.budgeting import budget
    from edge.budgeting.run_time_cache import cache_path

    return budget.choose_model(
        find_model(model),
        budget_us,
        rate_hz=budget.USUAL_RATE_HZ if rate_hz is None else rate_hz,
        cache=cache_path(),
        recalibrate=recalibrate,
        stop=threading.Event() if stop is None else stop,
        tell=tell,
    )


def open_runtime(
    model: str | Path | Model,
    source: Source,
    *,
    baselines: Mapping[str, Baseline] | str | Path | None = None,
    counts_per_newton: float | Mapping[str, float] | None = None,
    pad: Pad | Mapping[str, Pad] | None = None,
    contact_on_counts: float = ON_COUNTS,
    contact_off_counts: float = OFF_COUNTS,
    idle_reset_s: float = IDLE_RESET_S,
    every_scan: bool = False,
    every_tap: bool = False,
    follow_drift: bool = True,
    fallback: bool = True,
    learn: bool = True,
    taps: int | None = None,
) -> Runtime:
    """Return a runtime that makes results of a source's scans; its defaults are those of `edge-sr`.

    Args:
        model: name of a bundled one, a file, or a model that `load_model` returned.
        source: open source of the scans.
        baselines: stored ones, or their file; they take precedence over those of the source's sensor file. A sensor
            without one is zeroed from its first 100 scans, during which its pad must be still and free.
        counts_per_newton: summed z per [N], of all sensors or by name; by default as in the sensor file. A name from
            which no scan arrives is reported as an event.
        pad: properties of the pad of all sensors, or of each by name, for models that use them; by default as in the
            sensor file.
        contact_on_counts: summed z at which a tap begins.
        contact_off_counts: summed z at which it ends.
        idle_reset_s: time without contact after which earlier taps are forgotten, in [s].
        every_scan: infer also where nothing has changed since the last pattern.
        every_tap: use also taps that are not expected to reduce the error.
        follow_drift: let the rest level follow the readings of a free pad.
        fallback: replace a pattern that is not to be believed by the smooth one.
        learn: learn the gains of the sensor from contacts; a `Stream` keeps them in the source's sensor file.
        taps: most taps of a pattern; None for all that the model takes, but one where it takes poses and the sensor has
            none: taps then follow the paper's schedule, each turned by 5 degrees from the one before.

    Raises:
        ModelError: the model does not exist, cannot be used, or is for another sensor.
        RecordingError: the baseline file cannot be used, or its taxel order is not that of the sensor file.
        UsageError: the source is not open; a baseline is of another grid; a number is out of range; `taps` is more than
            the model takes.
    """
    known, nominal = source.sensor_file, source.sensor_file.geometry == USPA44
    return Runtime(
        load_model(model) if isinstance(model, (str, Path)) else model,
        source=source.kind,
        estimator=load_estimator(TAXELS, (USPA44.rows, USPA44.cols)) if nominal else None,
        contacts=load_contact_model() if nominal and learn else None,
        geometry=known.geometry,
        baselines=references(baselines, known),
        counts_per_newton=(known.counts_per_newton or None) if counts_per_newton is None else counts_per_newton,
        mountings=known.mountings,
        pad=known.pads if pad is None else pad,
        measured=known.measured_pads if pad is None else None,
        options=RuntimeOptions(
            *(contact_on_counts, contact_off_counts, idle_reset_s),
            *(every_scan, every_tap, follow_drift, fallback, learn, taps),
        ),
        unix_time_s=source.unix_time_s,
    )


def open_recording(
    path: str | Path,
    *,
    sensor: str | Path | None = None,
    zero: bool = False,
    paced: bool = False,
    rate_hz: float | None = None,
) -> Source:
    """Open a recording as a source, to compute its results again as `edge-sr replay` does.

    Every scan gets a result, however slow the loop is, with the time, mounting and baseline of the recording.

    Args:
        path: .mcap, .npz or .csv.
        sensor: file that `edge-sr doctor` wrote, used instead of the recorded settings.
        zero: zero from the first 100 scans, instead of using the recorded baselines.
        paced: play at the recorded speed, as if live; a loop that is too slow loses scans, as with a sensor.
        rate_hz: scans a second of each sensor, where the file does not state it, or to play it at another speed.

    Raises:
        RecordingError: the recording cannot be used.
        SourceError: its rate is unknown or out of range.
        SensorFileError: the sensor file cannot be used.
    """
    from edge.pipeline import replay_setup as recordings

    return recordings.open_recording(path, sensor=sensor, zero=zero, paced=paced, rate_hz=rate_hz)


def open_sink(text: str, contract: Contract, source: Source, *, stop: threading.Event | None = None) -> Sink:
    """Open a sink of results, as `edge-sr --sink` names it; close it after the last result is written.

    Args:
        text: "jsonl:FILE", "npz:FILE.npz", "mcap:FILE.mcap", ...
        contract: contract of the model that makes the results.
        source: open source of the scans. Readers that are too slow miss records of a sensor, but never of a recording.
        stop: set when the run is to end: then the sink no longer waits for readers of a recording's records either.

    Raises:
        UsageError: the form does not exist (the message lists the forms), or the source is not open.
        SinkError: it cannot be opened.
    """
    return forms.open_sink(
        text,
        contract,
        lossless=source.kind == "replay",
        mountings=source.sensor_file.mountings,
        geometry=source.sensor_file.geometry,
        unix_offset_ns=source.unix_offset_ns,
        source=source.kind,
        origin=source.origin,
        stop=stop,
    )


def devices() -> "tuple[list[Found], list[str]]":
    """List what is plugged in with what prevents its use, and what could not be examined and why; opens nothing."""
    from firmware_bridge.links import discovery as devices

    return devices.devices()
