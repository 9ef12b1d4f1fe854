"""`edge-sr`: taxel scans in, super-resolved patterns out."""

import argparse
import math
import os
import shlex
import sys
from collections.abc import Sequence
from typing import Final

from edge.arguments import EXIT_USAGE
from edge.bundle import bundled_models, demo_recording
from edge.commissioned import use_sensor_file
from edge.errors import EdgeError, ModelError, SinkError, UsageError
from edge.options import baseline_parser, devices_parser, models_parser, run_parser
from firmware_bridge.errors import BaselineRefusedError, BridgeError, DeviceError
from firmware_bridge.links.base import Link

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
    use_sensor_file(options)
    if options.recalibrate and options.budget_us is None:
        raise UsageError("--recalibrate measures for --budget-us, which is not there: add it, or leave both")
    # Here and not above, so that --help does not wait for onnxruntime.
    from edge.run import run

    run(options, _open_sources(options, math.inf if options.give_up_s is None else options.give_up_s))
    return 0


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
    use_sensor_file(options)
    from edge.signals import stop_on_signals
    from edge.zeroing import take_baselines
    from firmware_bridge.baseline import save_baselines

    with stop_on_signals() as stop, _open_sources(options, give_up_s=None) as link:
        kind = link.kind
        baselines = take_baselines(link, scans=options.scans, skip=options.skip, stop=stop)
    save_baselines(options.out, baselines.values(), options.orders)
    for name, baseline in sorted(baselines.items()):
        emulated = "" if kind == "device" else f" ({kind.upper()})"
        print(f"sensor {name}: baseline {baseline.id} of {baseline.scans} scans{emulated} -> {options.out}")
    return 0


def _bench(arguments: Sequence[str]) -> int:
    from edge.bench.options import bench_parser

    options = bench_parser().parse_args(arguments)
    if options.soak is not None and not options.system:
        raise UsageError("--soak is a part of --system: add it")
    from edge.bench.command import Settings, run

    settings = Settings(
        out=options.out,
        rate_hz=options.rate_hz,
        ticks=options.ticks,
        threads=tuple(sorted(set(options.threads))),
        load=options.load,
        models=options.models,
        peers=tuple(options.against),
        earlier=options.compare,
        by_surface=options.by_surface,
        only=options.only,
        system=options.system,
        soak_minutes=options.soak,
        command=shlex.join(["edge-sr", "bench", *arguments]),
    )
    return run(settings, sys.stdout, sys.stderr)


def _devices(arguments: Sequence[str]) -> int:
    options = devices_parser().parse_args(arguments)
    from edge.devices import run

    return run(as_json=options.json, stdout=sys.stdout)


def _doctor(arguments: Sequence[str]) -> int:
    from edge.doctor.options import doctor_parser

    options = doctor_parser().parse_args(arguments)
    if len(options.source) > 1:
        raise UsageError(f"{len(options.source)} sources, expected one: examine them one after the other")
    use_sensor_file(options)
    from edge.doctor.command import run

    return run(options, lambda asked: _open_sources(asked, give_up_s=None), sys.stdout, sys.stderr)


COMMANDS: Final = {"models": _models, "baseline": _baseline, "bench": _bench, "devices": _devices, "doctor": _doctor}


def _open_sources(options: argparse.Namespace, give_up_s: float | None) -> Link:
    from firmware_bridge.links.source import open_sources

    demo = any(text.rpartition("=")[2] == "demo" for text in options.source)
    recording = demo_recording() if demo else None
    return open_sources(
        options.source, options.rate_hz, recording, options.model_map, give_up_s, mountings=options.mountings
    )


if __name__ == "__main__":
    sys.exit(main())
