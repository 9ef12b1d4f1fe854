"""Command line of the emulated xela_server, for manual tests.

    python -m firmware_bridge.emulation.xela_server_main FILE [FILE]
    python -m firmware_bridge.emulation.xela_server_main --sim

The first line it prints is the URL, of this machine alone.
"""

import argparse
import math
import os
import select
import sys
import time
from collections.abc import Sequence
from typing import Final

from firmware_bridge.emulation.xela_server_emulator import DEFAULT_MESSAGE_HZ, ServerEmulator
from firmware_bridge.emulation.xela_server_model import VERSIONS, VendorServer, sim_recording
from firmware_bridge.errors import BridgeError
from firmware_bridge.recording.formats import load_recording

INTERRUPTED: Final = 130
LONGEST_S: Final = 1e6
_STOP_POLL_S: Final = 0.05


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the recordings named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m firmware_bridge.emulation.xela_server_main", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("file", nargs="*", help="recording, .csv or .npz")
    add("--sim", action="store_true", help="send waves, like the vendor's simulation mode")
    add("--speaks", choices=VERSIONS, default=VERSIONS[-1], help=f"version (default: {VERSIONS[-1]})")
    add("--port", type=_port, default=0, help="port (default: any free one; the vendor's is 5000)")
    add("--message-hz", type=float, default=DEFAULT_MESSAGE_HZ, help="messages a second (default: 100)")
    add("--rate-hz", type=float, help="cycles a second of each sensor (default: as recorded)")
    add("--spread", type=float, default=0.0, help="share of a cycle over which its taxels arrive (default: 0)")
    add("--queue-ms", type=float, default=0.0, help="age of the readings in a message (default: 0)")
    add("--loop", action="store_true", help="begin again after the last cycle")
    add(
        "--other", action="append", type=_other, default=[], metavar="MODEL:TAXELS", help="add a sensor that is not 4x4"
    )
    add("--garbage-every", type=_count, default=0, metavar="N", help="send one invalid message after every N")
    add("--kill-after-s", type=_seconds, metavar="T", help="break all connections every T s")
    add("--down-s", type=_seconds, default=1.0, metavar="T", help="time until a broken server returns (default: 1)")
    add("--freeze-after-s", type=_seconds, metavar="T", help="stop sending after T s, with connections open")
    add("--until-stdin-closes", action="store_true", help="end when stdin is closed")
    options = parser.parse_args(arguments)
    try:
        recordings = [load_recording(path) for path in options.file] or ([sim_recording()] if options.sim else [])
        if not recordings and not options.other:
            parser.error("nothing to serve: name a recording, or --sim")
        server = VendorServer(
            recordings,
            version=options.speaks,
            rate_hz=options.rate_hz,
            spread=options.spread,
            queue_s=options.queue_ms / 1000,
            loop=options.loop or (options.sim and not options.file),
            others=options.other,
        )
        emulator = ServerEmulator(
            server,
            message_hz=options.message_hz,
            port=options.port,
            garbage_every=options.garbage_every,
        )
        with emulator:
            sys.stdout.write(f"{emulator.url}\n")
            sys.stdout.flush()
            _play(emulator, options)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (BridgeError, ValueError, OSError) as error:
        parser.error(str(error))
    return 0


def _other(text: str) -> tuple[str, int]:
    model, _, taxels = text.rpartition(":")
    if not (model and taxels.isascii() and taxels.isdigit() and int(taxels) < 100):
        raise argparse.ArgumentTypeError(f"{text!r} is not MODEL:TAXELS, such as uSPa46:24")
    return model, int(taxels)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 5 and int(text) <= 65_535):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, expected 0..65535, 0 for any free one")
    return int(text)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of messages, expected 0 or more")
    return int(text)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time, expected 0..{LONGEST_S:g} s")
    return seconds


def _play(emulator: ServerEmulator, options: argparse.Namespace) -> None:
    start_s = time.monotonic()
    run_s: float = math.inf if options.kill_after_s is None else options.kill_after_s
    kill_s = start_s + run_s
    freeze_s = math.inf if options.freeze_after_s is None else start_s + options.freeze_after_s
    while not emulator.wait(_STOP_POLL_S):
        if options.until_stdin_closes and select.select([0], [], [], 0)[0] and not os.read(0, 4096):
            break
        if time.monotonic() >= freeze_s:
            freeze_s = math.inf
            emulator.freeze()
        if time.monotonic() >= kill_s:
            emulator.kill()
            time.sleep(options.down_s)
            emulator.start_again()
            kill_s = time.monotonic() + run_s


if __name__ == "__main__":
    sys.exit(main())
