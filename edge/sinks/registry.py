"""Registry of the sinks, by the names that a user writes, and the fan-out of a run's results to all of them."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from operator import methodcaller
from pathlib import Path
from typing import Final

from edge.errors import SinkClosedError, SinkError, UsageError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import NOW, RunFacts, Sink
from edge.sinks.ros2.cdr_messages import base_topic
from firmware_bridge.extras import how_to_install
from firmware_bridge.poses import TimedPose

LOOK_NS: Final = 500_000_000
"""Pause between two checks of the sinks' trouble, in [ns]: discovery of a reader may take a moment."""


class Fan(Sink):
    """Fan-out of results and events to several sinks.

    Attributes:
        failures: of sinks given up, in their order.
    """

    def __init__(self, tell: Callable[[Event], object], clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Begin without a sink; `tell` is called first with the event of one that is given up or reports trouble."""
        self.failures: list[SinkError] = []
        self._sinks: list[Sink] = []
        self._given_up_unwritten = 0
        self._counters: Mapping[str, int] = {}
        self._tell = tell
        self._clock_ns = clock_ns
        self._look_ns = clock_ns() + LOOK_NS
        self._known_trouble: set[str] = set()

    def add(self, sink: Sink) -> None:
        """Add one open sink; the failure of the last sink ends the run."""
        self._sinks.append(sink)

    @property
    def trouble(self) -> str | None:
        """Trouble that any of the sinks reports, or None."""
        return "; ".join(sorted(self._troubles())) or None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Pass on one result, or raise where no sink is left; a SinkClosedError if only their readers have gone."""
        self._each(methodcaller("write", result, counters), counters)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Pass on one event."""
        self._each(methodcaller("tell", event, counters), counters)

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Pass on poses."""
        self._each(methodcaller("pose", poses), self._counters)

    def wait(self) -> None:
        """Pass on that no scan came."""
        self._each(methodcaller("wait"), self._counters)

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

    def _each(self, act: Callable[[Sink], None], counters: Mapping[str, int]) -> None:
        self._counters = counters  # still true for a sink that fails while no scan comes
        for sink in tuple(self._sinks):
            if sink not in self._sinks:  # given up by an earlier call of this loop
                continue
            try:
                act(sink)
            except SinkError as error:
                self._give_up(sink, error, counters)
        self.unwritten = self._given_up_unwritten + sum(sink.unwritten for sink in self._sinks)
        if self._clock_ns() >= self._look_ns:
            self._look_ns = self._clock_ns() + LOOK_NS
            known, self._known_trouble = self._known_trouble, self._troubles()
            for trouble in sorted(self._known_trouble - known):
                self._tell_all(trouble, counters)

    def _troubles(self) -> set[str]:
        return {sink.trouble for sink in self._sinks if sink.trouble is not None}

    def _give_up(self, sink: Sink, error: SinkError, counters: Mapping[str, int]) -> None:
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
        self._tell_all(f"{error}; the other sinks continue", counters)

    def _tell_all(self, text: str, counters: Mapping[str, int]) -> None:
        event = Event(self._clock_ns(), "sink", None, text)
        self._tell(event)
        self.tell(event, counters)


FORMS: Final = {
    "status": "one live line (default on a terminal)",
    "jsonl:FILE": "one JSON record a line",
    "jsonl:- (stdout)": "the same",
    "mcap:FILE.mcap": "recording, for replay, Foxglove and ROS 2; edge-sr convert makes arrays for numpy of it",
    "shm:NAME": "latest values in shared memory",
    "zenoh:KEY": "messages over zenoh; to a router with ?connect=tcp/HOST:7447",
    "ros2:TOPIC": "ROS 2 messages",
    "ros2:TOPIC?commands": "the same, with resets and zeroings from the robot",
}
"""Forms of a sink, and what each is, for the help."""


def check_sink(text: str) -> tuple[str, str]:
    """Return form and target of the sink that `text` names, or raise a UsageError; nothing is opened."""
    form, _, target = text.partition(":")
    if form == "npz" and target:
        made = Path(target).with_suffix(".mcap")
        raise UsageError(f"no sink {text!r}: record by --sink mcap:{made}, then edge-sr convert {made} {target}")
    if text != "status" and (form not in ("jsonl", "mcap", "shm", "zenoh", "ros2") or not target):
        raise UsageError(f"no sink {text!r}; sinks are {', '.join(FORMS)}")
    if form == "mcap" and not target.endswith(".mcap"):
        raise UsageError(f"sink {text!r} names {target!r}, expected a file whose name ends in .mcap")
    if form == "ros2":
        _ros2_topic(target)
    if form == "zenoh":
        from edge.sinks.zenoh import parsed_target

        parsed_target(target)
    return form, target


def check_apart(texts: Sequence[str]) -> None:
    """Raise a UsageError where a sink is there twice: both would write to the same place."""
    for text in texts:
        if texts.count(text) > 1:
            raise UsageError(f"sink {text!r} is there {texts.count(text)} times: leave one")


def open_sink(text: str, contract: Contract, run: RunFacts = NOW) -> Sink:
    """Open the sink that `text` names, of FORMS; the contract names the maps that will come, and their shapes.

    Raises:
        UsageError: no such form; a sink in metres for patterns of an unknown unit; a package is not installed.
        SinkError: the sink cannot be opened.
    """
    # Each is imported only where it is used, which saves start-up time and memory.
    form, target = check_sink(text)
    if form == "status":
        from edge.sinks.status_line import StatusSink

        return StatusSink()
    if form == "jsonl":
        from edge.sinks.jsonl import JsonLinesSink

        return JsonLinesSink(target, run)
    if form == "mcap":
        _check_unit(text, contract)
        from edge.sinks.mcap import McapSink

        return McapSink(Path(target), contract, run)
    if form == "shm":
        from edge.sinks.shm import SharedMemorySink

        return SharedMemorySink(target, contract)
    if form == "zenoh":
        from edge.sinks.zenoh import ZenohSink

        return ZenohSink(target, run)
    with needs_cyclone_dds(text):
        from edge.sinks.ros2.sink import Ros2Sink
    _check_unit(text, contract)
    topic, accepts = _ros2_topic(target)
    return Ros2Sink(topic, run=run if accepts else replace(run, commands=None))


def _check_unit(text: str, contract: Contract) -> None:
    if contract.output_unit != "mm":
        raise UsageError(f"{text}: the model's patterns are in {contract.output_unit!r}, expected mm: use another sink")


def _ros2_topic(target: str) -> tuple[str, bool]:
    """Return the topic of a target, and whether commands are accepted."""
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
