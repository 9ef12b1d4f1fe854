"""Registry of the sinks, by the names that a user writes."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from edge.errors import UsageError
from edge.inference.contract import Contract
from edge.pipeline.commands import Commands
from edge.pipeline.sink import Sink
from edge.sinks.ros2.topic_names import base_topic
from firmware_bridge.extras import how_to_install
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.pad_frame import PadFrame

FORMS: Final = (
    *("status", "jsonl:FILE", "jsonl:- (stdout)", "mcap:FILE.mcap"),
    *("shm:NAME", "zenoh:KEY", "ros2:TOPIC", "ros2:TOPIC?commands"),
)
_TARGETED: Final = ("jsonl", "mcap", "shm", "zenoh", "ros2")


def check_sink(text: str) -> tuple[str, str]:
    """Return form and target of the sink that `text` names; nothing is opened.

    Raises:
        UsageError: no such form (the forms are listed), or no target of this form.
    """
    form, _, target = text.partition(":")
    if form == "npz" and target:
        made = Path(target).with_suffix(".mcap")
        raise UsageError(f"no sink {text!r}: record by --sink mcap:{made}, then edge-sr convert {made} {target}")
    if text != "status" and (form not in _TARGETED or not target):
        raise UsageError(f"no sink {text!r}; sinks are {', '.join(FORMS)}")
    if form == "mcap" and not target.endswith(".mcap"):
        raise UsageError(f"sink {text!r} names {target!r}, expected a file whose name ends in .mcap")
    if form == "ros2":
        _ros2_topic(target)
    if form == "zenoh":
        from edge.sinks.zenoh import understood

        understood(target)
    return form, target


def check_apart(texts: Sequence[str]) -> None:
    """Check that each sink is there once: two would write to the same place.

    Raises:
        UsageError: a sink is there twice.
    """
    for text in texts:
        if texts.count(text) > 1:
            raise UsageError(f"sink {text!r} is there {texts.count(text)} times: leave one")


def open_sink(
    text: str,
    contract: Contract,
    *,
    lossless: bool = True,
    mountings: Mapping[str, Mounting] | None = None,
    frames: Mapping[str, PadFrame] | None = None,
    geometry: SensorGeometry = USPA44,
    unix_offset_ns: int | None = None,
    source: str | None = None,
    origin: SourceKind | None = None,
    stop: threading.Event | None = None,
    commands: Commands | None = None,
    fields: str | None = None,
) -> Sink:
    """Open the sink that `text` names.

    Args:
        text: one of FORMS.
        contract: names the maps that will come, and their shapes.
        lossless: wait for slow readers, rather than leave records out.
        mountings: of the sensors, by name.
        frames: places of the pads on the robot, by sensor name.
        geometry: of the sensors.
        unix_offset_ns: added to the time of a scan gives [ns] since 1970; None where scans are of now.
        source: kind of the source, written with events.
        origin: kind of source that the scans come from, where a recording names it.
        stop: set when the run is to end: then no slow reader is waited for.
        commands: takes those that come over a sink that was asked to accept them.
        fields: those of JSON records, such as "force_n,pattern"; None for all.

    Raises:
        UsageError: no such form, and the forms are listed; or a sink in metres, and a model whose patterns have no unit
            that is known.
        SinkError: the sink cannot be opened.
    """
    # Each is imported only where it is used, which saves start-up time and memory.
    form, target = check_sink(text)
    if form == "status":
        from edge.sinks.status_line import StatusSink

        return StatusSink()
    if form == "jsonl":
        from edge.sinks.json_encoding import chosen_fields
        from edge.sinks.jsonl import JsonLinesSink

        chosen = None if fields is None else chosen_fields(fields)
        return JsonLinesSink(target, lossless=lossless, source=source, stop=stop, fields=chosen)
    if form == "mcap":
        _check_unit(text, contract)
        from edge.sinks.mcap import McapSink

        return McapSink(
            Path(target),
            contract,
            lossless=lossless,
            mountings=mountings,
            frames=frames,
            geometry=geometry,
            unix_offset_ns=unix_offset_ns,
            origin=origin,
        )
    if form == "shm":
        from edge.sinks.shm import SharedMemorySink

        return SharedMemorySink(target, contract)
    if form == "zenoh":
        from edge.sinks.zenoh import ZenohSink

        return ZenohSink(target, lossless=lossless, source=source)
    try:
        from edge.sinks.ros2.sink import Ros2Sink
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "cyclonedds":
            raise
        raise UsageError(f"{text} needs Cyclone DDS: {how_to_install('ros2')}") from error
    _check_unit(text, contract)
    topic, accepts = _ros2_topic(target)
    return Ros2Sink(
        topic,
        geometry=geometry,
        frames=frames,
        commands=commands if accepts else None,
        unix_offset_ns=unix_offset_ns,
        source=source,
    )


def _check_unit(text: str, contract: Contract) -> None:
    """Check that patterns can be written in metres.

    Raises:
        UsageError: their unit is another than mm.
    """
    if contract.output_unit != "mm":
        raise UsageError(f"{text}: the model's patterns are in {contract.output_unit!r}, expected mm: use another sink")


def _ros2_topic(target: str) -> tuple[str, bool]:
    """Return the topic of a target, and whether commands are accepted.

    Raises:
        UsageError: the target has another form.
    """
    topic, asked, option = target.partition("?")
    if asked and option != "commands":
        raise UsageError(f"ros2:{target} has {option!r} after its topic, expected ros2:TOPIC or ros2:TOPIC?commands")
    return base_topic(topic), bool(asked)
