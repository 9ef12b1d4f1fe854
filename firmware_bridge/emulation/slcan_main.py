"""Command line of the emulated controller and its slcan adapter, for manual tests.

    python -m firmware_bridge.emulation.slcan_main FILE [FILE]

The first line it prints is the port; with --buses the first lines are, one for each bus.
"""

import argparse
import os
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, TextIO

from firmware_bridge.emulation.emulator_thread import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.emulation.xela_controller import FRAME_S
from firmware_bridge.errors import BridgeError
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording

INTERRUPTED: Final = 130
_STOP_POLL_S: Final = 0.05
MakeEmulator = Callable[[Sequence[Recording], Mapping[str, Any], argparse.Namespace, ExitStack], Emulator]
"""Constructor from a bus's recordings, the emulator's options and all options; the stack closes what it opens."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the recordings named on the command line."""
    parser = argument_parser("python -m firmware_bridge.emulation.slcan_main", __doc__)
    return play(parser, arguments, lambda recordings, usual, options, closing: Emulator(recordings, **usual))


def argument_parser(program: str, description: str | None) -> argparse.ArgumentParser:
    """Return a parser of the options of `Emulator`."""
    parser = argparse.ArgumentParser(prog=program, description=description)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", nargs="+", help="recording, .csv or .npz")
    parser.add_argument(
        "--buses", type=int, default=1, metavar="N", help="deal the recordings out to so many adapters (default: 1)"
    )
    parser.add_argument(
        "--controller", type=_controllers, default=[], metavar="N,N", help="controller ids (default: 4,6,8,...)"
    )
    parser.add_argument("--rate-hz", type=float, help="scans a second of each sensor (default: as recorded)")
    parser.add_argument("--loop", action="store_true", help="begin again after the last scan")
    parser.add_argument("--no-acks", action="store_true", help="do not answer commands, like some firmwares")
    parser.add_argument("--left-open", action="store_true", help="begin with an open channel")
    parser.add_argument("--old-canable", action="store_true", help="send no answers, time stamps or flags")
    parser.add_argument("--ignore-line-speed", action="store_true", help="accept any line speed, like USB-CDC adapters")
    parser.add_argument("--jitter-ms", type=float, default=1.0, help="largest jitter of a scan (default: 1)")
    parser.add_argument("--latency-ms", type=float, default=1.0, help="latency of the adapter (default: 1)")
    parser.add_argument("--frame-us", type=float, default=1e6 * FRAME_S, help="time on the bus, a frame (default: 130)")
    parser.add_argument("--first-frame", type=int, default=0, metavar="N", help="frame of the cycle sent first")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of jitter and unused bytes of the first bus (default: 0)"
    )
    parser.add_argument("--stamps", metavar="FILE", help="write controller and time [ns] of each scan's last frame")
    parser.add_argument(
        "--link",
        type=Path,
        metavar="PATH",
        help="symbolic link to the emulated port; with --buses PATH0, PATH1, ...",
    )
    parser.add_argument("--waits", action="store_true", help="wait for a late client, and lose no frames")
    parser.add_argument("--until-stdin-closes", action="store_true", help="end when stdin is closed")
    return parser


def play(parser: argparse.ArgumentParser, arguments: Sequence[str] | None, make_emulator: MakeEmulator) -> int:
    """Play the recordings named in the arguments, and return the exit code."""
    options = parser.parse_args(arguments)
    try:
        _serve(options, make_emulator)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (BridgeError, ValueError) as error:
        parser.error(str(error))
    except OSError as error:
        parser.error(f"{error.filename or 'output'}: cannot be written: {error.strerror}")
    return 0


def _serve(options: argparse.Namespace, make_emulator: MakeEmulator) -> None:
    if not 1 <= options.buses <= len(options.file):
        raise ValueError(f"--buses is {options.buses}, expected 1 to the number of recordings, {len(options.file)}")
    with ExitStack() as closing:
        # First of all: what cannot be played shall cost no file of an earlier run.
        recordings = [load_recording(path) for path in options.file]
        stamps = closing.enter_context(Path(options.stamps).open("w")) if options.stamps else None
        emulators = [
            make_emulator(recordings[bus :: options.buses], _usual(options, bus, stamps), options, closing)
            for bus in range(options.buses)
        ]
        _play(emulators, until_stdin_closes=options.until_stdin_closes)


def _usual(options: argparse.Namespace, bus: int, stamps: TextIO | None) -> dict[str, Any]:
    """Return the options of the emulator of a bus."""
    alone, link = options.buses == 1, options.link
    name = "" if alone else f"bus{bus}/"
    return {
        "controllers": options.controller,
        "rate_hz": options.rate_hz,
        "loop": options.loop,
        "acknowledges": not options.no_acks,
        "left_open": options.left_open,
        "old_canable": options.old_canable,
        "jitter_s": options.jitter_ms / 1000,
        "latency_s": options.latency_ms / 1000,
        "frame_s": options.frame_us / 1e6,
        "first_frame": options.first_frame,
        "ignores_line_speed": options.ignore_line_speed,
        "seed": options.seed + bus,
        "on_scan": lambda controller, time_ns: stamps.write(f"{name}{controller} {time_ns}\n") if stamps else None,
        "link": link if alone or link is None else link.with_name(f"{link.name}{bus}"),
        "waits": options.waits,
    }


def _controllers(text: str) -> list[int]:
    ids = [one.strip() for one in text.split(",") if one.strip()]
    if not all(one.isascii() and one.isdigit() and len(one) <= 2 for one in ids):
        raise argparse.ArgumentTypeError(f"{text!r} are not controller ids, such as 4,6")
    return list(map(int, ids))


def _play(emulators: Sequence[Emulator], *, until_stdin_closes: bool) -> None:
    with EmulatorThread(emulators):
        sys.stdout.write("".join(f"{emulator.port}\n" for emulator in emulators))
        sys.stdout.flush()
        while not all(emulator.wait(_STOP_POLL_S) for emulator in emulators):
            if not until_stdin_closes or not select.select([0], [], [], 0)[0]:
                continue
            if not (text := os.read(0, 4096)):
                break
            for emulator in emulators:
                emulator.take_input(text)


if __name__ == "__main__":
    sys.exit(main())
