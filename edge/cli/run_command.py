"""Run of `edge-sr`: a source through the runtime into sinks, and its summary.

Modules that only some runs need are imported where they are used.
"""

import argparse
import contextlib
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO

from edge.api import (
    DEFAULT_MODEL,
    DEMO_LOOP,
    DEMO_MODEL,
    Commands,
    Contract,
    DeviceError,
    Event,
    Fan,
    MapSink,
    Sink,
    SinkClosedError,
    Source,
    Statistics,
    UsageError,
    choose_model,
    demo_recording,
    load_baselines,
    load_model,
    open_poses,
    open_runtime,
    open_sink,
    pump,
)
from edge.cli.run_options import runtime_options
from edge.cli.user_commands import user_commands
from edge.sinks.event_printer import MessageSink
from edge.terminal.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from edge.cli.demo_score import DemoScore
    from edge.view.live_view import LiveView

DEMO_HZ: Final = 100.0
DEMO_REST_SCANS: Final = 100
"""Scans without contact after which a repeating demo is at its first tap: 174 lie before it, 24 between taps."""


def run(
    options: argparse.Namespace,
    source: Source,
    statistics: Statistics | None = None,
    mapping: MapSink | None = None,
) -> None:
    """Run `edge-sr` without a command, or a command that runs the same way.

    Args:
        options: of edge.cli.run_options.run_parser.
        source: not open yet.
        statistics: filled on the way, so that they are available however the run ends.
        mapping: takes the results into a map, which the live page shows; closed here.

    Raises:
        EdgeError: an option, a model or a sink cannot be used.
        BridgeError: the source cannot be used.
    """
    stdout_taken = "jsonl:-" in options.sink
    baselines = None if options.baseline is None else load_baselines(options.baseline, source.sensor_file.orders)
    # Both around everything: a signal to zero must not end a program that is still loading, or already closing.
    with stop_on_signals() as stop, user_commands() as commands:
        loops = options.source == [DEMO_LOOP]
        demo = loops or options.source == ["demo"]
        name = (DEMO_MODEL if demo else DEFAULT_MODEL) if options.model is None else options.model
        if options.budget_us is None:
            model = None if stop.is_set() else load_model(name, stop=stop)
        else:
            model = choose_model(
                name,
                options.budget_us,
                rate_hz=options.rate_hz,
                recalibrate=options.recalibrate,
                stop=stop,
                tell=lambda line: print(line, file=sys.stderr),
            )
        if model is None:
            return
        scores = sys.stderr if stdout_taken else sys.stdout
        score = None
        statistics = Statistics() if statistics is None else statistics
        with (
            _open_view(options, model.contract, commands) as view,
            _summary(statistics, source),
            source,
            contextlib.ExitStack() as closing,
        ):
            hint = _silence_hint(options.source)
            messages = MessageSink(hint=hint)
            opener = partial(open_sink, contract=model.contract, source=source, stop=stop)
            if view is not None:
                view.begin(source.name, source.kind, model.name, opener, messages.say)
                print(f"live page: {view.url}", file=sys.stderr, flush=True)
            if demo:
                score = _open_score(model.contract, partial(_go_on, scores, view) if loops else lambda score: None)
            asked = runtime_options(options)
            if loops:
                rest_s = DEMO_REST_SCANS / (options.rate_hz or DEMO_HZ)
                asked = replace(asked, idle_reset_s=min(rest_s, asked.idle_reset_s))
            if score is not None:  # the demo shows the run time of every scan, and the gain of every tap
                asked = replace(asked, every_scan=True, every_tap=True)
            runtime = open_runtime(
                model,
                source,
                baselines=baselines,
                counts_per_newton=options.counts_per_newton,
                **asdict(asked),
            )
            sinks: list[Sink] = []
            if score is not None:
                watching = [messages, *(() if view is None else view.sinks)]
                sinks += [score, _open_scenes(watching)]
            fan = Fan(messages.say)
            closing.callback(fan.close)
            sinks.append(messages)
            for text in _with_status(options.sink, source):
                sink = opener(text)
                if text != "status":
                    fan.add(sink)
                    continue
                closing.callback(sink.close)
                sinks.append(sink)
            if set(options.sink) - {"status"}:
                sinks.append(fan)
            if mapping is not None:
                closing.callback(mapping.close)
                mapping.show = None if view is None else view.show_map
                sinks.append(mapping)
            if view is not None:
                sinks += view.sinks
            for text in options.poses:
                closing.callback(open_poses(text, commands.poses).close)
            if options.poses and not getattr(model.contract, "takes_poses", False):
                commands.poses.warn("model", f"model {model.name} takes no poses: they are only counted and recorded")
            if options.realtime:  # last, so that it does not affect what the page and the sinks have started
                from edge.cli.realtime import realtime

                closing.enter_context(realtime(_tell, source.thread_ids))
            pump(
                source,
                runtime,
                sinks,
                statistics,
                stop=stop,
                duration_s=options.duration_s,
                commands=commands,
            )
        # A run that its user ends before the first scan was due is no fault of the sensor.
        if not statistics.scans and (statistics.events or not stop.is_set()):
            raise DeviceError(f"no scan came from {source.name}: {hint}")
        if score is not None and not (loops and score.complete):
            _print_score(score, scores)


def _open_view(
    options: argparse.Namespace, contract: Contract, commands: Commands
) -> "contextlib.AbstractContextManager[LiveView | None]":
    if options.view is None:
        for name in ("view_host", "view_token", "view_record_dir"):
            if getattr(options, name) is not None:
                option = f"--{name.replace('_', '-')}"
                raise UsageError(f"{option} requires --view")
        return contextlib.nullcontext()
    from edge.view.live_view import LOOPBACK, LiveView

    directory = options.view_record_dir or Path()
    if options.view_record_dir is not None and not os.access(f"{directory}/", os.W_OK | os.X_OK):
        expected = "expected a folder that may be written into"
        raise UsageError(f"--view-record-dir {directory}: {expected}; make it, or leave it out for the current folder")
    return LiveView(options.view_host or LOOPBACK, options.view, options.view_token, directory, contract, commands)


def _open_score(contract: Contract, on_complete: "Callable[[DemoScore], object]") -> "DemoScore":
    from edge.cli.demo_score import DemoScore

    score = DemoScore(demo_recording(), contract, on_complete)
    print(f"demo: an emulated sensor taps {score.surface!r} {score.taps} times, zeroed first", file=sys.stderr)
    return score


def _open_scenes(watching: Sequence[Sink]) -> Sink:
    """Return the sink that announces the scenes of the demo to the sinks that show events."""
    from edge.cli.demo_scenes import DemoScenes

    def tell(event: Event) -> None:
        for sink in watching:
            sink.tell(event, {})

    return DemoScenes(demo_recording(), tell)


def _silence_hint(sources: Sequence[str]) -> str:
    source = f" --source {shlex.quote(sources[0])}" if len(sources) == 1 else ""
    return f"is the sensor powered and its cable in? edge-sr doctor{source} shows what is wrong"


def _go_on(stream: TextIO, view: "LiveView | None", score: "DemoScore") -> None:
    """Print the score of a complete round while the demo goes on, and where else to look."""
    _print_score(score, stream)
    page = "" if view is None else f"live page: {view.url}; "
    print(f"\n{page}the demo continues until Ctrl-C", file=sys.stderr)


@contextlib.contextmanager
def _summary(statistics: Statistics, source: Source) -> Iterator[None]:
    """Print the summary of a run at its end; a reader that has gone is an ordinary end, like Ctrl-C."""
    try:
        with contextlib.suppress(SinkClosedError):
            yield
    finally:
        if statistics.scans or sys.exception() is None:
            name = source.name if source.kind == "device" else f"{source.kind.upper()} {source.name}"
            with contextlib.suppress(OSError):  # the terminal may have gone, which must not spoil a clean end
                print(statistics.summary(source=name, wanted_rate_hz=source.rate_hz), file=sys.stderr)
                received = ", ".join(f"{name} {count}" for name, count in source.counters().items() if count)
                print(f"received: {received or 'nothing'}", file=sys.stderr)


def _tell(line: str) -> None:
    print(f"edge-sr: {line}", file=sys.stderr)


def _with_status(sinks: Sequence[str], source: Source) -> list[str]:
    """The sinks asked for, and on a terminal the live line; not where records may go there, or it is over at once."""
    apart = source.patient or sys.stderr is None or not sys.stderr.isatty()
    return list(sinks) if apart or {"status", "jsonl:-"} & set(sinks) else [*sinks, "status"]


def _print_score(score: "DemoScore", stream: TextIO) -> None:
    from edge.cli.demo_score import score_picture, score_table
    from edge.terminal.heatmap import choose_palette

    scores = score.scores()
    if not scores:
        print(f"\nnone of {score.taps} taps scored: the run ended before a tap had a pattern", file=stream)
        return
    print(f"\n{len(scores)} of {score.taps} taps scored at their peak, against the simulated truth:", file=stream)
    palette = choose_palette(os.environ, terminal=stream.isatty(), encoding=stream.encoding)
    columns = shutil.get_terminal_size().columns
    print(score_table(scores), file=stream)
    print(f"\ntap {scores[-1].tap + 1}:\n{score_picture(scores[-1], columns, palette)}", file=stream)
