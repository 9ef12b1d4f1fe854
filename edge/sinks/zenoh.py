"""Scans, patterns and events over zenoh, from many grippers to one place. docs/middleware.md describes the messages.

zenoh's own threads send: `put` queues a message and returns. zenoh drops silently what the network does not take in
time; readers notice the gaps in `scan`.
"""

import json
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import orjson

from edge.errors import SinkError, UsageError
from edge.perception.event import Event
from edge.perception.record_fields import maps_of
from edge.perception.result import Result
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.sinks.json_records import CountersInTurn, event_record, pack, record
from firmware_bridge.errors import how_to_install

if TYPE_CHECKING:
    import zenoh

CLOSED: Final = {
    "mode": "peer",
    "listen/endpoints": [],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
}
"""Settings that keep discovery and listening off unless a configuration turns them on; zenoh's defaults turn all on."""


class ZenohSink(Sink):
    """Publisher of KEY/SENSOR/scan, KEY/SENSOR/pattern and KEY/event, alive as KEY/alive/ID."""

    def __init__(self, target: str, source: Source) -> None:
        """Open a session; it does not matter whether a subscriber is there, now or later."""
        self._target, self._source = target, source.kind
        self._key, configuration = parsed_target(target)
        try:
            import zenoh
        except ImportError as error:
            raise SinkError(f"zenoh: needs eclipse-zenoh: {how_to_install('zenoh')}") from error
        self._failure = zenoh.ZError
        self._turns = CountersInTurn()
        congestion = zenoh.CongestionControl
        self._congestion = congestion.BLOCK if source.kind == "replay" else congestion.DROP
        with opening():
            self._session = zenoh.open(_configured(configuration))
            self.zid = str(self._session.zid())  # which the time stamp of every message holds, too
            self._events = self._publisher(f"{self._key}/event", "application/json")
            self._read = True  # until a result shows that there is no subscriber
            self._alive = self._session.liveliness().declare_token(f"{self._key}/alive/{self.zid}")
        self._publishers: dict[str, tuple[zenoh.Publisher, zenoh.Publisher]] = {}

    @property
    def trouble(self) -> str | None:
        """Trouble where there was no subscriber when the last result was put, else None."""
        return None if self._read else f"nobody subscribes to zenoh:{self._target}: check its reader, or the router"

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Put the scan, and its pattern where that is new."""
        publishers = self._publishers.get(result.scan.sensor) or self._declare(result.scan.sensor)
        text = record(result, self._turns.of(result, counters))
        self._read = any(map(_matched, (*publishers, self._events)))
        self.put(publishers[0], orjson.dumps(text, option=orjson.OPT_SERIALIZE_NUMPY))
        if result.pattern is not None and result.reused_from is None:
            self.put(publishers[1], pack(text, maps_of(result)))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Put an event."""
        self.put(self._events, orjson.dumps(event_record(event, counters, self._source)))

    def close(self) -> None:
        """Send what is under way, and end; subscribers to KEY/alive/* are notified by zenoh.

        It takes half a second at most: a peer that stands still would delay zenoh for ten.
        """

        def close() -> None:
            with suppress(self._failure):  # it took too long, after everything was put without an error
                self._session.close()

        closing = threading.Thread(target=close, name="zenoh-close", daemon=True)
        closing.start()
        closing.join(0.5)

    def _declare(self, sensor: str) -> "tuple[zenoh.Publisher, zenoh.Publisher]":
        base = f"{self._key}/{chunks(sensor)}"
        scans = self._publisher(f"{base}/scan", "application/json")
        self._publishers[sensor] = scans, self._publisher(f"{base}/pattern", "application/octet-stream")
        return self._publishers[sensor]

    def _publisher(self, key: str, encoding: str) -> "zenoh.Publisher":
        return self._session.declare_publisher(key, encoding=encoding, congestion_control=self._congestion)

    def put(self, publisher: "zenoh.Publisher", message: bytes) -> None:
        """Send a message, with a time stamp."""
        try:
            publisher.put(message, timestamp=self._session.new_timestamp())
        except self._failure as error:
            raise SinkError(f"zenoh cannot send: {_reason(error)}") from error


def chunks(sensor: str) -> str:
    """Return a sensor's name as part of a key, quoted as in a web address: `urllib.parse.unquote` gives it back."""
    return quote(sensor, safe="/" if all(sensor.split("/")) else "")


def parsed_target(target: str) -> tuple[str, dict[str, Any] | Path]:
    """Return key and configuration of a target; a UsageError where it has another form."""
    key, asked, option = target.partition("?")
    if not all(key.split("/")) or set(key) & set("*$#") or key.startswith("@") or "/@" in key:
        raise UsageError(
            f"zenoh:{target} has {key!r} for a key: expected words with '/' between, without any of * $ # @"
        )
    name, _, value = option.partition("=")
    if not asked:
        return key, {**CLOSED, "connect/endpoints": ["tcp/127.0.0.1:7447"]}  # of a router here, at zenoh's usual port
    if name == "connect" and all("/" in endpoint for endpoint in value.split(",")):
        return key, {**CLOSED, "connect/endpoints": value.split(",")}
    if name == "config" and value:
        return key, Path(value)
    raise UsageError(
        f"zenoh:{target} has {option!r} after its key: expected zenoh:KEY, zenoh:KEY?connect=tcp/HOST:7447 or "
        "zenoh:KEY?config=FILE.json5"
    )


@contextmanager
def opening() -> Iterator[None]:
    """Turn zenoh's error while something is opened into a SinkError."""
    import zenoh

    try:
        yield
    except zenoh.ZError as error:
        raise SinkError(f"zenoh cannot be opened: {_reason(error)}") from error


def _configured(configuration: dict[str, Any] | Path) -> "zenoh.Config":
    """Return zenoh's configuration, with everything off in CLOSED that the user does not turn on."""
    import zenoh

    config = zenoh.Config()
    if isinstance(configuration, Path):
        untouched = {name: config.get_json(name) for name in CLOSED}
        try:
            config = zenoh.Config.from_file(configuration)
        except zenoh.ZError as error:
            raise SinkError(f"{configuration} is not a zenoh configuration: {_reason(error)}") from error
        configuration = {name: CLOSED[name] for name, text in untouched.items() if config.get_json(name) == text}
    for name, value in configuration.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _matched(publisher: "zenoh.Publisher") -> bool:
    # A property, although zenoh's own stubs make it a method, which would always be true.
    return publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]


def _reason(error: Exception) -> str:
    """Return zenoh's reason without the place in its source, which follows " at "."""
    text = str(error).strip().partition(f" at {os.sep}")[0]
    return text.strip().splitlines()[-1].lstrip(" =")
