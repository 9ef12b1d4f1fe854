"""Run of `edge-sr`: a source through the runtime into sinks, and its summary; what only some runs need loads late."""

import argparse
import contextlib
import ctypes
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from edge.api import (
    DEFAULT_MODEL,
    DEMO_LOOP,
    POSED_MODEL,
    Commands,
    Contract,
    DeviceError,
    Fan,
    Sink,
    SinkClosedError,
    Source,
    Statistics,
    UsageError,
    find_model,
    load_baselines,
    load_model,
    open_recording,
    open_runtime,
    open_sink,
    open_source,
    pump,
    save_baselines,
)
from edge.cli.option_table import runtime_options
from edge.errors import SinkError
from edge.pipeline.commands import user_commands
from edge.pipeline.run_statistics import silence_hint
from edge.pipeline.sink import check_new
from edge.sinks.registry import check_apart
from edge.sinks.status_line import MessageSink
from edge.terminal.stop_signals import stop_on_signals
from firmware_bridge.errors import as_typed
from firmware_bridge.in_place import BACKUP_SUFFIX
from firmware_bridge.zeroing.baseline import FILE_FORMAT

if TYPE_CHECKING:
    from edge.api import MapSink
    from edge.cli.demo import Demo
    from edge.view.server import LiveView


def follow(
    options: argparse.Namespace,
    out: TextIO,
    err: TextIO,
    statistics: Statistics | None = None,
    mapping: "MapSink | None" = None,
) -> None:
    """Run `edge-sr` without a command, or with one that adds to it."""
    if options.source == ["demo"] and options.view is not None and not set(options.sink) - {"status"}:
        options.source = [DEMO_LOOP]  # a person may look at a page for long; a sink gets one round
    run(options, _source(options, inf if options.give_up_s is None else options.give_up_s), statistics, mapping)


def replay(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Run `edge-sr replay`."""
    from edge.api import example_recording

    files = [*options.file, *[example_recording()] * options.example]
    if not files:
        raise UsageError("which recording? name its FILE, or pass --example (edge-sr replay --help lists all options)")
    # Who opens the page sees its beginning; a sink is not kept waiting.
    looked_at = threading.Event() if options.view is not None and not set(options.sink) - {"status"} else None
    paced = options.paced or options.view is not None
    source = open_recording(
        *files,
        sensor=options.sensor,
        zero=options.baseline is not None,
        paced=paced,
        rate_hz=options.rate_hz,
        begins=looked_at,
    )
    run(options, source, looked_at=looked_at)


def baseline(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Run `edge-sr baseline`."""
    from edge.api import take_baselines

    replaced = options.out.exists()
    if options.out.is_file() and options.out.stat().st_size:  # replaced twice, not even its backup would be left
        with options.out.open("rb") as file:
            if FILE_FORMAT.encode() not in file.read(1 << 16):
                raise UsageError(f"{options.out} holds something else: give another name, or delete it first")
    if len(options.source) == 1 and options.source[0].startswith("replay:"):
        from edge.pipeline.baseline_capture import recorded_baselines
        from edge.pipeline.source_setup import sensor_settings

        kind, sensor_file = "replay", sensor_settings(options.sensor, options.id_map)
        played = options.source[0].removeprefix("replay:")
        baselines, notes = recorded_baselines(played, sensor_file, options.rate_hz)
        print("\n".join(notes), file=err)
    else:
        with stop_on_signals() as stop, _source(options, give_up_s=0) as source:
            kind, sensor_file = source.kind, source.sensor_file
            baselines = take_baselines(source, stop=stop)
    save_baselines(options.out, baselines.values(), sensor_file.orders)
    for name, stored in sorted(baselines.items()):
        emulated = "" if kind == "device" else f" ({kind.upper()})"
        print(f"sensor {name}: baseline {stored.id} of {stored.scans} scans{emulated} -> {options.out}", file=out)
    if replaced:
        print(f"the former file is now {options.out}{BACKUP_SUFFIX}", file=out)


def _source(options: argparse.Namespace, give_up_s: float) -> Source:
    names = ("sensor", "id_map", "rate_hz")
    return open_source(*options.source, give_up_s=give_up_s, **{name: getattr(options, name) for name in names})


def record(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Run `edge-sr record`: a run with a recording, which is reported at the end, however the run ends."""
    path = Path(options.file)
    if path.is_dir():
        raise SinkError(f"cannot record into {path}: it is a directory; name a file in it")
    if path.suffix.lower() in (".csv", ".npz", ".json", ".jsonl"):
        made = as_typed(path.with_suffix(".mcap"))
        then = "for records in JSON use edge-sr --sink jsonl:FILE"
        if path.suffix.lower() in (".csv", ".npz"):
            then = f"afterwards edge-sr convert {made} {as_typed(path)}"
        raise UsageError(f"{path.suffix} cannot be recorded: edge-sr record {made}; {then}")
    if path.suffix != ".mcap":
        path = path.with_name(path.name + ".mcap")
    check_new(path)
    options.sink = [*options.sink, f"mcap:{path}"]
    check_apart(options.sink)
    statistics = Statistics()
    try:
        follow(options, out, err, statistics)
    finally:
        if path.exists():
            size_mb = path.stat().st_size / 1e6
            emulated = ", EMULATED" if "emulated" in (statistics.source, statistics.origin) else ""
            sure = sys.exception() is None and not statistics.unwritten  # else a sink has reported what it lacks
            held = f"{'' if sure else 'at most '}{statistics.scans} scans, {statistics.duration_s():.1f} s"
            with suppress(OSError):  # the terminal may have gone
                err.write(f"recorded {path}: {held}, {size_mb:.2f} MB{emulated}\n")


def map_object(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Run `edge-sr map`: a run whose results make a map, which is reported at the end, however the run ends."""
    from edge.api import MapSink, ObjectMap

    if options.out.suffix != ".npz":
        raise UsageError(f"{options.out} is no name of a map's file: expected one that ends in .npz")
    whole = ObjectMap(options.size_mm, options.px_per_mm, centre_mm=tuple(options.centre_mm))
    sink = MapSink(whole, npz=options.out)
    try:
        follow(options, out, err, mapping=sink)
    finally:
        if sink.fused or sys.exception() is None:
            with suppress(OSError):  # the terminal may have gone
                err.write(f"{sink.summary()}\n")


def run(
    options: argparse.Namespace,
    source: Source,
    statistics: Statistics | None = None,
    mapping: "MapSink | None" = None,
    looked_at: threading.Event | None = None,
) -> None:
    """Run a source that is not open yet into the sinks asked for, and `mapping`, which is closed here, into a map."""
    statistics = Statistics() if statistics is None else statistics
    baselines = None if options.baseline is None else load_baselines(options.baseline, source.sensor_file.orders)
    loops = options.source == [DEMO_LOOP]
    is_demo = loops or options.source == ["demo"]
    posed = mapping is None and (source.states_poses or bool(options.poses))  # a map fuses taps itself
    name = (POSED_MODEL if posed else DEFAULT_MODEL) if options.model is None else options.model
    played: Demo | None = None
    # Both around everything: a signal to zero must not end a program that is still loading, or already closing.
    with stop_on_signals() as stop, user_commands() as commands, contextlib.closing(source):
        if stop.is_set():
            return
        find_model(name)  # first, or a name with a slip would wait for links that are slow to open
        with ThreadPoolExecutor(1) as executor:
            opening = executor.submit(source.open)  # its links open while the model loads
            model = load_model(name)
        with (
            _open_view(options, model.contract, commands) as view,
            contextlib.nullcontext(opening.result()),  # a port of the page that is taken is reported before a lost link
            _summary(statistics, source),
            contextlib.closing(source),
            contextlib.ExitStack() as closing,
        ):
            hint = partial(silence_hint, options.source, source.counters)
            unchecked = None if model.contract.trust else f"model {model.name} has no checks: act on no pattern of it"
            messages = MessageSink(hint=None if source.kind == "replay" else hint, first=unchecked)
            if view is not None:
                view.begin(source, model.name, messages.say, looked_at)
                print(f"live page: {' or '.join([view.url, *view.other_urls])}", file=sys.stderr, flush=True)
                if looked_at is not None:
                    print("the recording begins when the page is opened", file=sys.stderr)
            asked = runtime_options(options)
            if is_demo:
                from edge.cli import demo

                scores = sys.stderr if "jsonl:-" in options.sink else sys.stdout
                watching = [messages, *(() if view is None else view.sinks)]
                played = demo.Demo(model, scores, view, watching, commands, loops=loops, maps=mapping is None)
                asked = replace(asked, every_scan=True)  # it shows the run time of every scan
            settings = {"baselines": baselines, "counts_per_newton": options.counts_per_newton}
            runtime = open_runtime(model, source, **settings, **asdict(asked))
            # Free memory goes back to the system, by glibc alone: a network takes more while it is loaded.
            if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
                trim(ctypes.c_size_t(0))
            sinks: list[Sink] = []
            if played is not None:
                sinks += [played, *([] if played.map is None else [played.map])]
            fan = Fan(messages.say)
            closing.callback(fan.close)
            sinks.append(messages)
            wanted = _with_status(options.sink)
            if "status" in wanted and sys.stdin is not None and sys.stdin.isatty():
                keys = "keys: r forgets earlier taps, z zeroes the free pad, Z zeroes even in contact"
                print(f"edge-sr: {keys}", file=sys.stderr)
            for text in wanted:
                sink = open_sink(text, model.contract, source, stop=stop, commands=commands, fields=options.fields)
                if text == "status":
                    closing.callback(sink.close)
                    sinks.append(sink)
                else:
                    fan.add(sink)
            if set(options.sink) - {"status"}:
                sinks.append(fan)
            if mapping is not None:
                closing.callback(mapping.close)
                mapping.show, mapping.origin = None if view is None else view.show_map, source.origin
                sinks.append(mapping)
            if view is not None:
                sinks += view.sinks
            for text in options.poses:
                from edge.api import open_poses

                closing.callback(open_poses(text, commands.poses).close)
            statistics.origin = source.origin
            pump(source, runtime, sinks, statistics, stop=stop, duration_s=options.duration_s, commands=commands)
        # To end before the first scan was due, or before anybody looked at the page, is no fault of the sensor.
        unseen = looked_at is not None and not looked_at.is_set()
        if not statistics.scans and not unseen and (statistics.events.keys() - {"note"} or not stop.is_set()):
            raise DeviceError(f"no scan came from {source.name}: {hint()}")
        if played is not None:
            played.finish()


def _open_view(
    options: argparse.Namespace, contract: Contract, commands: Commands
) -> "contextlib.AbstractContextManager[LiveView | None]":
    if options.view is None:
        for name in ("view_host", "view_token"):
            if getattr(options, name) is not None:
                raise UsageError(f"--{name.replace('_', '-')} requires --view")
        return contextlib.nullcontext()
    from edge.view.server import LOOPBACK, LiveView

    return LiveView(options.view_host or LOOPBACK, options.view, options.view_token, contract, commands)


@contextlib.contextmanager
def _summary(statistics: Statistics, source: Source) -> Iterator[None]:
    """Print the summary of a run at its end; a reader that has gone is an ordinary end, like Ctrl-C."""
    try:
        with contextlib.suppress(SinkClosedError):
            yield
    finally:
        if statistics.scans or sys.exception() is None:
            name = source.name if source.kind == "device" else f"{source.kind.upper()} {source.name}"
            name += " (EMULATED)" * (source.origin == "emulated")
            with contextlib.suppress(OSError):  # the terminal may have gone, which must not spoil a clean end
                print(statistics.summary(source=name, wanted_rate_hz=source.rate_hz), file=sys.stderr)
                received = ", ".join(f"{name} {count}" for name, count in source.counters().items() if count)
                print(f"received: {received or 'nothing'}", file=sys.stderr)
                if source.unix_offset_ns and statistics.scans:
                    made = time.localtime(source.unix_time_s())  # a pad wears, and its rest level moves
                    print(time.strftime("recorded on %Y-%m-%d at %H:%M", made), file=sys.stderr)


def _with_status(sinks: Sequence[str]) -> list[str]:
    """The sinks asked for, and on a terminal the live line; not where records may go there."""
    live = sys.stderr is not None and sys.stderr.isatty()
    return [*sinks, "status"] if live and not {"status", "jsonl:-"} & set(sinks) else list(sinks)
