"""`edge-sr`: taxel scans in, super-resolved patterns out."""

import argparse
import contextlib
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final, TextIO

from edge.bundle import DEFAULT_MODEL, DEMO_MODEL, bundled_models, demo_recording, find_model
from edge.errors import EdgeError, ModelError, SinkClosedError, SinkError
from edge.options import EXIT_USAGE, baseline_parser, bench_parser, models_parser, run_parser
from firmware_bridge.errors import BaselineRefusedError, BridgeError, DeviceError
from firmware_bridge.links.base import Link
from firmware_bridge.xela import ID_MAPS

if TYPE_CHECKING:
    from edge.demo import DemoScore
    from edge.statistics import Statistics

STDOUT: Final = 1
EXIT_DEVICE: Final = 3
EXIT_MODEL: Final = 4
EXIT_SINK: Final = 5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    command = COMMANDS.get(arguments[0]) if arguments else None
    try:
        code = _run(arguments) if command is None else command(arguments[1:])
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except BrokenPipeError:
        # Whoever read stdout has had enough; point it elsewhere, or Python complains at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), STDOUT)
        return 0
    except (BridgeError, EdgeError) as error:
        print(f"edge-sr: {' '.join(str(error).split())}", file=sys.stderr)
        return _exit_code(error)


def _exit_code(error: BridgeError | EdgeError) -> int:
    if isinstance(error, (DeviceError, BaselineRefusedError)):
        return EXIT_DEVICE
    if isinstance(error, ModelError):
        return EXIT_MODEL
    if isinstance(error, SinkError):
        return EXIT_SINK
    return EXIT_USAGE


def _run(arguments: Sequence[str]) -> int:
    options = run_parser().parse_args(arguments)
    # Here and not above, so that --help does not wait for onnxruntime.
    from edge.commands import stdin_commands
    from edge.demo import DemoScore
    from edge.pump import pump
    from edge.runtime import Runtime
    from edge.session import ModelSession
    from edge.sinks.base import Sink
    from edge.sinks.forms import open_sink
    from edge.statistics import Statistics
    from firmware_bridge.baseline import load_baselines

    stdout_taken = "jsonl:-" in options.sink
    with _stop_on_signals() as stop:
        link = _open_source(options)
        baselines = load_baselines(options.baseline) if options.baseline else None
        default = DEMO_MODEL if options.source == "demo" else DEFAULT_MODEL
        model = ModelSession(find_model(options.model or default))
        score = DemoScore(demo_recording(), model.contract) if options.source == "demo" else None
        statistics = Statistics()
        if score is not None:
            print(f"demo: an emulated sensor taps {score.surface!r} {score.taps} times, zeroed first", file=sys.stderr)
        with link, _summary(statistics, link, options.rate_hz), contextlib.ExitStack() as closing:
            runtime = Runtime(
                model,
                source=link.kind,  # known once the link is open
                baselines=baselines,
                counts_per_newton=options.counts_per_newton,
                on_counts=options.contact_on_counts,
                off_counts=options.contact_off_counts,
                idle_timeout_s=options.idle_reset_s,
            )
            sinks: list[Sink] = [] if score is None else [score]
            for text in _with_status(options.sink):
                sinks.append(open_sink(text, model.contract))
                closing.callback(sinks[-1].close)
            pump(
                link,
                runtime,
                sinks,
                statistics,
                stop=stop,
                duration_s=options.duration_s,
                commands=stdin_commands(),
            )
        if score is not None:
            _print_score(score, sys.stderr if stdout_taken else sys.stdout)
    return 0


@contextlib.contextmanager
def _summary(statistics: "Statistics", link: Link, rate_hz: float | None) -> Iterator[None]:
    """Tells at the end what the run did; a reader that has gone is an ordinary end, like Ctrl-C."""
    try:
        with contextlib.suppress(SinkClosedError):
            yield
    finally:
        if statistics.scans or sys.exception() is None:
            source = link.name if link.kind == "device" else f"{link.kind.upper()} {link.name}"
            with contextlib.suppress(OSError):  # the terminal may have gone, which must not spoil a clean end
                print(statistics.summary(source=source, wanted_rate_hz=rate_hz), file=sys.stderr)


def _with_status(sinks: Sequence[str]) -> list[str]:
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


def _models(arguments: Sequence[str]) -> int:
    models_parser().parse_args(arguments)
    from edge.session import ModelSession

    models = bundled_models()
    if not models:
        raise ModelError("no models are bundled with this installation")
    widest = max(len(path.stem) for path in models)
    print(f"{'model':{widest}s} taps scale    size arithmetic  error on the frozen test set, all taps given")
    for path in models:
        contract = ModelSession(path).contract
        error = contract.test_error.get(str(contract.taps), {})
        figures = ", ".join(f"{name} {value:.3g}" for name, value in error.items())
        size_mb = path.stat().st_size / 1e6
        print(
            f"{path.stem:{widest}s} {contract.taps:4d} {f'x{contract.scale}':>5s} {size_mb:4.1f} MB "
            f"{contract.arithmetic:10s}  {figures or 'not known'}"
        )
    return 0


def _baseline(arguments: Sequence[str]) -> int:
    options = baseline_parser().parse_args(arguments)
    from edge.zeroing import take_baselines
    from firmware_bridge.baseline import save_baselines

    with _stop_on_signals() as stop, _open_source(options) as link:
        kind = link.kind
        baselines = take_baselines(link, scans=options.scans, skip=options.skip, stop=stop)
    save_baselines(options.out, baselines.values())
    for name, baseline in sorted(baselines.items()):
        emulated = "" if kind == "device" else f" ({kind.upper()})"
        print(f"sensor {name}: baseline {baseline.id} of {baseline.scans} scans{emulated} -> {options.out}")
    return 0


def _bench(arguments: Sequence[str]) -> int:
    options = bench_parser().parse_args(arguments)
    from edge.bench import bench, header, surface_table, table_line

    rows = []
    print(header(options.rate_hz, options.ticks), flush=True)
    for row in bench(bundled_models(), options.rate_hz, options.ticks):
        rows.append(row)
        print(table_line(row), flush=True)
    if options.by_surface:
        print(f"\n{surface_table(rows)}")
    return 0


COMMANDS: Final = {"models": _models, "baseline": _baseline, "bench": _bench}


def _open_source(options: argparse.Namespace) -> Link:
    from firmware_bridge.links.source import open_source

    recording = demo_recording() if options.source == "demo" else None
    return open_source(options.source, options.rate_hz, recording, ID_MAPS[options.id_map])


@contextlib.contextmanager
def _stop_on_signals() -> Iterator[threading.Event]:
    """An event that the first signal sets; a second signal ends the program at once."""
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {getattr(signal, name): signal.signal(getattr(signal, name), handle) for name in names}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
