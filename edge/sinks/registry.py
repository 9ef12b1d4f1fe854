"""Registry of the sinks, by the names that a user writes, and the fan-out of a run's results to all of them."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

from edge.errors import SinkClosedError, SinkError, UsageError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.commands import Commands
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.validation import check_kind
from firmware_bridge.errors import as_typed, how_to_install
from firmware_bridge.poses import TimedPose

LOOK_NS: Final = 500_000_000
"""Pause between two checks of the sinks' trouble, in [ns]: discovery of a reader may take a moment."""
_UNWRITTEN: Final = attrgetter("unwritten")


class Fan(Sink):
    """Fan-out of results and events to several sinks; the failure of the last one ends the run."""

    def __init__(self, tell: Callable[[Event], object], clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Begin without a sink; `tell` is called first with the event of one that is given up or reports trouble."""
        self.failures: list[SinkError] = []  # of sinks given up
        self._sinks: list[Sink] = []
        self._given_up_unwritten = 0
        self._counters: Mapping[str, int] = {}  # the newest, also for a sink that fails while no scan comes
        self._tell = tell
        self._clock_ns = clock_ns
        self._look_ns = clock_ns() + LOOK_NS
        self._known_trouble: set[str] = set()

    def add(self, sink: Sink) -> None:
        """Add one open sink."""
        self._sinks.append(sink)

    @property
    def trouble(self) -> str | None:
        """Trouble that any of the sinks reports, or None."""
        return "; ".join(sorted(self._troubles())) or None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Pass on one result, or raise where no sink is left; a SinkClosedError if only their readers have gone."""
        self._counters = counters
        self._each("write", result, counters)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Pass on one event."""
        self._counters = counters
        self._each("tell", event, counters)

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Pass on poses."""
        self._each("pose", poses)

    def wait(self) -> None:
        """Pass on that no scan came."""
        self._each("wait")

    def close(self) -> None:
        """Close every sink; raises the error of the first that failed, now or before, unless another ends the run."""
        for sink in self._sinks:
            try:
                sink.close()
            except SinkError as error:
                self.failures.append(error)
        self._sinks = []
        if self.failures and sys.exception() is None:  # else the error that ended the run is reported
            raise self.failures[0]

    def _each(self, act: str, *given: object) -> None:
        for sink in tuple(self._sinks):
            if sink not in self._sinks:  # given up by an earlier call of this loop
                continue
            try:
                getattr(sink, act)(*given)
            except SinkError as error:
                self._give_up(sink, error)
        self.unwritten = self._given_up_unwritten + sum(map(_UNWRITTEN, self._sinks))
        if self._clock_ns() >= self._look_ns:
            self._look_ns = self._clock_ns() + LOOK_NS
            before, self._known_trouble = self._known_trouble, self._troubles()
            for trouble in sorted(self._known_trouble - before):
                self._tell_all(trouble)

    def _troubles(self) -> set[str]:
        return {sink.trouble for sink in self._sinks if sink.trouble is not None}

    def _give_up(self, sink: Sink, error: SinkError) -> None:
        self._sinks.remove(sink)
        self._given_up_unwritten += sink.unwritten
        closed = isinstance(error, SinkClosedError)
        if not closed:
            self.failures.append(error)
        try:
            sink.close()
        except SinkError as another:
            self.failures.append(another)
        if not self._sinks:
            self.unwritten = self._given_up_unwritten
            raise self.failures[0] if self.failures else error
        self._tell_all(f"{error}; the other sinks continue")

    def _tell_all(self, text: str) -> None:
        event = Event(self._clock_ns(), "sink", None, text)
        self._tell(event)
        self.tell(event, self._counters)


class Form(NamedTuple):
    """Form of a sink: as a user writes it, and what it is."""

    text: str
    about: str


def check_sink(text: str) -> tuple[str, str]:
    """Return name and target of the sink that `text` names, or raise a UsageError; nothing is opened."""
    check_kind("sink", text, "partition", "text, as after --sink")
    name, _, target = text.partition(":")
    form = FORMS.get(name)
    if name == "npz" and target:
        made = Path(target).with_suffix(".mcap")
        then = f"edge-sr convert {as_typed(made)} {as_typed(target)}"
        raise UsageError(f"no sink {text!r}: record by --sink {as_typed(f'mcap:{made}')}, then {then}")
    if form is None or (text != name if form.text == name else not target):
        raise UsageError(f"no sink {text!r}; sinks are {', '.join(form.text for form in FORMS.values())}")
    match name:
        case "mcap" if not target.endswith(".mcap"):
            raise UsageError(f"sink {text!r} names {target!r}, expected a file whose name ends in .mcap")
        case "zenoh":
            from edge.sinks.zenoh import parsed_target

            parsed_target(target)
        case "rerun":
            from edge.sinks.rerun import check_target

            check_target(target)
        case "ros2":
            _ros2_topic(target)
    return name, target


def check_apart(texts: Sequence[str]) -> None:
    """Raise a UsageError where a sink is there twice: both would write to the same place."""
    places: dict[tuple[str, str], str] = {}
    for text in texts:
        name, _, target = text.partition(":")
        place = name, os.path.realpath(target)
        if place in places:
            raise UsageError(f"sinks {places[place]!r} and {text!r} write to the same place: leave one out")
        places[place] = text


def open_sink(
    text: str,
    contract: Contract,
    source: Source,
    *,
    stop: threading.Event | None = None,
    commands: Commands | None = None,
    fields: str | None = None,
) -> Sink:
    """Open a sink of results, as `edge-sr --sink` names it; close it after the last result is written.

    `contract` is that of the model, `source` the open source of the scans: readers that are too slow miss records of a
    sensor, but never of a recording, unless `stop` is set. "ros2:TOPIC?commands" gives `commands`, those of the stream,
    zeroing and reset from the robot. `fields` of JSON records, such as "force_n,pattern", are all by default. Raises a
    UsageError where the form or a field does not exist or a package is missing, a SinkError where it cannot be opened.
    """
    name, target = check_sink(text)
    check_kind("contract", contract, "output_unit", "that of the model, as load_model(...).contract")
    check_kind("source", source, "sensor_file", "an open one: with open_source(...) as source")
    if name in ("mcap", "ros2", "rerun") and contract.output_unit != "mm":
        raise UsageError(f"{text}: the model's patterns are in {contract.output_unit!r}, expected mm: use another sink")
    # Each is imported only where it is used, which saves start-up time and memory.
    match name:
        case "jsonl":
            from edge.sinks.json_records import JsonLinesSink

            return JsonLinesSink(target, contract, source, stop=stop, fields=fields)
        case "mcap":
            from edge.sinks.mcap import McapSink

            return McapSink(Path(target), contract, source)
        case "shm":
            from edge.sinks.shm import SharedMemorySink

            return SharedMemorySink(target, contract)
        case "zenoh":
            from edge.sinks.zenoh import ZenohSink

            return ZenohSink(target, source)
        case "rerun":
            from edge.sinks.rerun import RerunSink

            return RerunSink(target, contract, source)
        case "ros2":
            with needs_cyclone_dds(text):
                from edge.sinks.ros2.sink import Ros2Sink
            topic, accepts = _ros2_topic(target)
            return Ros2Sink(topic, contract, source, commands if accepts else None)
        case "status":
            from edge.sinks.status_line import StatusSink

            return StatusSink()
        case _:
            raise AssertionError(f"FORMS has {name}, which nothing opens")


def _ros2_topic(target: str) -> tuple[str, bool]:
    """Return the topic of a target, and whether commands are accepted."""
    from edge.sinks.ros2.messages import base_topic  # no other sink needs the messages of ROS

    topic, asked, option = target.partition("?")
    if asked and option != "commands":
        raise UsageError(f"ros2:{target} has {option!r} after its topic, expected ros2:TOPIC or ros2:TOPIC?commands")
    return base_topic(topic), bool(asked)


@contextmanager
def needs_cyclone_dds(text: str) -> Iterator[None]:
    """Turn the error of an import without Cyclone DDS into a UsageError that tells how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "cyclonedds":
            raise
        raise UsageError(f"{text} needs Cyclone DDS: {how_to_install('ros2')}") from error


FORMS: Final = {
    "status": Form("status", "one live line (default on a terminal)"),
    "jsonl": Form("jsonl:FILE", "one JSON record a line; jsonl:- is stdout"),
    "mcap": Form(
        "mcap:FILE.mcap", "recording, for replay, Foxglove and ROS 2; edge-sr convert makes arrays for numpy of it"
    ),
    "shm": Form("shm:NAME", "latest values in shared memory"),
    "zenoh": Form("zenoh:KEY", "messages over zenoh; to a router with ?connect=tcp/HOST:7447"),
    "ros2": Form("ros2:TOPIC", "ROS 2 messages"),
    "rerun": Form("rerun:view", "a Rerun viewer; one that is open by HOST:PORT; FILE.rrd"),
}
"""Forms of sinks by their names, in the order of the help."""
