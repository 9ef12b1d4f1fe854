"""Registry of the sinks, by the names that a user writes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from edge.errors import UsageError
from edge.inference.contract import Contract
from edge.pipeline.sink import NOW, RunFacts, Sink
from edge.sinks.ros2.topic_names import base_topic
from firmware_bridge.extras import how_to_install

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
    """Raise a UsageError where a sink is there twice: both would write to the same place."""
    for text in texts:
        if texts.count(text) > 1:
            raise UsageError(f"sink {text!r} is there {texts.count(text)} times: leave one")


def open_sink(text: str, contract: Contract, run: RunFacts = NOW) -> Sink:
    """Open the sink that `text` names, of FORMS; the contract names the maps that will come, and their shapes.

    Raises:
        UsageError: no such form, and the forms are listed; a sink in metres, and a model whose patterns have no unit
            that is known; or what the sink needs is not installed.
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
