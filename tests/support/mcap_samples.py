"""Helpers for tests of MCAP recordings: a recording, and reading one with the public package."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from edge_samples import BASELINE, FakeModel, fake_source, make_contract, make_scan
from mcap.reader import make_reader
from mcap.writer import Writer

from edge.cli import main as cli
from edge.perception.runtime import Runtime
from edge.sinks.mcap import McapSink
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan, VendorReading

OFFSET_NS = 1_700_000_000_000_000_000
SURE = make_contract(interval_factor=1.6)
TURNED = Mounting(tuple(np.rot90(np.arange(16).reshape(4, 4)).ravel().tolist()), True, (1, -1, 1))


def odd_scans(count: int = 12) -> list[Scan]:
    """Return scans of two sensors with all that scans may have: gaps, old readings, device times, a vendor's words."""
    scans = []
    for number in range(count):
        press = 3000 + 40 * number if number % 4 > 1 else 0
        scan = make_scan(number, press_counts=press, absent=(3, 7) if number % 5 == 2 else (), stale=(1,), noise=3)
        scans.append(replace(scan, device_ns=None if number % 3 else scan.time_ns - 1234))
        newtons = np.random.default_rng(number).normal(size=(3, 4, 4)).astype(np.float32)
        vendor = VendorReading(newtons, np.full((4, 4), 300.5, np.float32) if number % 2 else None)
        other = make_scan(number, sensor="left/6", press_counts=press, noise=2)
        scans.append(replace(other, time_ns=other.time_ns + 77 * (number % 2), vendor=vendor if number % 4 else None))
    return scans


def make_results(scans: list[Scan], **settings):
    baselines = {name: replace(BASELINE, sensor=name) for name in ("4", "left/6")}
    settings = {"source": "device", "baselines": baselines, "unix_time_s": lambda: OFFSET_NS / 1e9} | settings
    runtime = Runtime(FakeModel(SURE), **settings)
    return [runtime.push(scan) for scan in scans]


def record_into(path: Path, results, **settings) -> Path:
    sink = McapSink(path, SURE, fake_source(unix_offset_ns=OFFSET_NS, **settings))
    for result in results:
        sink.write(result, {"dropped": 2})
    sink.close()
    return path


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz that `edge-sr convert` makes of a recording, next to it."""
    assert cli.main(["convert", str(path), str(path.with_suffix(".npz"))]) == 0
    with np.load(path.with_suffix(".npz")) as arrays:
        return dict(arrays)


def messages_of(path: Path) -> dict[str, list]:
    """Return (log time, data) by topic, as the public package reads a whole file, its sums checked."""
    by_topic = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            by_topic[channel.topic].append((message.log_time, message.data))
    return by_topic


def content(scan: Scan) -> list:
    vendor = [getattr(scan.vendor, name, None) for name in ("newtons", "temperature_k", "ups_hz")]
    arrays = [scan.counts, scan.fresh, scan.renewed, *vendor]
    return [scan.sensor, scan.number, scan.time_ns, scan.device_ns, *(a if a is None else a.tobytes() for a in arrays)]


def messages_alone(
    path: Path,
    to: Path,
    topics: str | tuple[str, ...] | None = None,
    start_ns: int | None = None,
    more: Path | None = None,
    metadata: Mapping[str, dict[str, str]] = MappingProxyType({}),
    kinds: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Copy messages of these topics and times (all by default), as tools do: without attachments, with other metadata.

    Those of `more`, another recording, follow. Messages of some `kinds` are called others.
    """
    with to.open("wb") as target:
        writer = Writer(target)
        writer.start()
        for name, fields in metadata.items():
            writer.add_metadata(name, fields)
        for one in filter(None, (path, more)):
            channels: dict[int, int] = {}
            with one.open("rb") as source:
                for schema, channel, message in make_reader(source).iter_messages(topics, starting_at=start_ns):
                    if schema is not None and channel.id not in channels:
                        kind = writer.register_schema(kinds.get(schema.name, schema.name), schema.encoding, schema.data)
                        channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
                    writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return to
