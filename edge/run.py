"""The run of `edge-sr`: a source through the runtime into sinks, and its summary.

What a run may do without is imported where it is needed.
"""

import argparse
import contextlib
import os
import shutil
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from edge.bundle import DEFAULT_MODEL, DEMO_MODEL, TAXELS, demo_recording, find_model
from edge.commands import user_commands
from edge.errors import SinkClosedError
from edge.estimate import load_estimator
from edge.pump import pump
from edge.runtime import Runtime
from edge.session import ModelSession
from edge.signals import stop_on_signals
from edge.sinks.base import Sink
from edge.sinks.fan import Fan
from edge.sinks.forms import open_sink
from edge.sinks.messages import MessageSink
from edge.statistics import Statistics
from firmware_bridge.geometry import USPA44
from firmware_bridge.links.base import Link

if TYPE_CHECKING:
    from edge.contract import Contract
    from edge.demo import DemoScore
    from edge.ladder import Ladder


def run(options: argparse.Namespace, link: Link) -> None:
    """Do what `edge-sr` without a command is asked for.

    Args:
        options: of edge.options.run_parser.
        link: not open yet.

    Raises:
        EdgeError: something cannot be used.
        BridgeError: of the source.
    """
    stdout_taken = "jsonl:-" in options.sink
    # Both around everything: a signal to zero must not end a program that is still loading, or already closing.
    with stop_on_signals() as stop, user_commands() as commands:
        demo = options.source == ["demo"]
        default = DEMO_MODEL if demo else DEFAULT_MODEL
        path = find_model(options.model or default)
        ladder = None if options.budget_us is None else _open_ladder(options, path, stop)
        if stop.is_set():
            return
        model = ModelSession(path) if ladder is None else ladder.model
        score = _open_score(model.contract) if demo else None
        statistics = Statistics()
        if score is not None:
            print(f"demo: an emulated sensor taps {score.surface!r} {score.taps} times, zeroed first", file=sys.stderr)
        with link, _summary(statistics, link, options.rate_hz), contextlib.ExitStack() as closing:
            if options.realtime:
                from edge.realtime import realtime

                closing.enter_context(realtime(_tell))
            runtime = Runtime(
                model,
                source=link.kind,  # known once the link is open
                estimator=load_estimator(TAXELS, (USPA44.rows, USPA44.cols)),
                baselines=options.baselines,
                mountings=options.mountings,
                counts_per_newton=options.counts_per_newton,
                on_counts=options.contact_on_counts,
                off_counts=options.contact_off_counts,
                idle_timeout_s=options.idle_reset_s,
                # The demo is there to show what every scan takes, and what every tap gives.
                reuse=not options.every_scan and score is None,
                every_tap=options.every_tap or score is not None,
                most_taps=1 if ladder is None else ladder.most_taps,
            )
            sinks: list[Sink] = [] if score is None else [score]
            if ladder is not None:
                from edge.ladder import ModelSteps

                sinks.append(ModelSteps(ladder, runtime))
            messages = MessageSink()
            fan = Fan(messages.say)
            closing.callback(fan.close)
            sinks.append(messages)
            for text in with_status(options.sink):
                sink = open_sink(text, model.contract, patient=link.kind == "replay")
                if text != "status":
                    fan.add(sink)
                    continue
                closing.callback(sink.close)
                sinks.append(sink)
            if set(options.sink) - {"status"}:
                sinks.append(fan)
            pump(
                link,
                runtime,
                sinks,
                statistics,
                stop=stop,
                duration_s=options.duration_s,
                commands=commands,
                rate_hz=options.rate_hz,
                expected=options.baselines or (),
            )
        if score is not None:
            _print_score(score, sys.stderr if stdout_taken else sys.stdout)


def _open_ladder(options: argparse.Namespace, model: Path, stop: threading.Event) -> "Ladder | None":
    from edge.calibration_cache import cache_path
    from edge.ladder import USUAL_RATE_HZ, open_ladder

    return open_ladder(
        model,
        options.budget_us,
        rate_hz=options.rate_hz or USUAL_RATE_HZ,
        cache=cache_path(),
        recalibrate=options.recalibrate,
        stop=stop,
        tell=lambda line: print(line, file=sys.stderr),
    )


def _open_score(contract: "Contract") -> "DemoScore":
    from edge.demo import DemoScore

    return DemoScore(demo_recording(), contract)


@contextlib.contextmanager
def _summary(statistics: Statistics, link: Link, rate_hz: float | None) -> Iterator[None]:
    """Tells at the end what the run did; a reader that has gone is an ordinary end, like Ctrl-C."""
    try:
        with contextlib.suppress(SinkClosedError):
            yield
    finally:
        if statistics.scans or sys.exception() is None:
            source = link.name if link.kind == "device" else f"{link.kind.upper()} {link.name}"
            with contextlib.suppress(OSError):  # the terminal may have gone, which must not spoil a clean end
                print(statistics.summary(source=source, wanted_rate_hz=rate_hz), file=sys.stderr)
                received = ", ".join(f"{name} {count}" for name, count in link.counters().items() if count)
                print(f"received: {received or 'nothing'}", file=sys.stderr)


def _tell(line: str) -> None:
    print(f"edge-sr: {line}", file=sys.stderr)


def with_status(sinks: Sequence[str]) -> list[str]:
    """The sinks asked for, and the live line, unless records may go to the same terminal."""
    return list(sinks) if {"status", "jsonl:-"} & set(sinks) else [*sinks, "status"]


def _print_score(score: "DemoScore", stream: TextIO) -> None:
    from edge.demo import score_picture, score_table
    from edge.draw import choose_palette

    scores = score.scores()
    print(f"\n{len(scores)} of {score.taps} taps scored at their peak, against the known truth:", file=stream)
    if not scores:
        return
    palette = choose_palette(os.environ, terminal=stream.isatty(), encoding=stream.encoding)
    columns = shutil.get_terminal_size().columns
    print(score_table(scores), file=stream)
    print(f"\ntap {scores[-1].tap + 1}:\n{score_picture(scores[-1], columns, palette)}", file=stream)
