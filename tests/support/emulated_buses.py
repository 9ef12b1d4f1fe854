"""Emulated adapters in a process of their own, each with its part of the sensors, until stdin is closed.

    python tests/support/emulated_buses.py FILE FILE --buses 2 --rate-hz 100

The first lines that it prints are the ports. Recordings are played again and again.
"""

import argparse
import select
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from firmware_bridge.emulation.pty_port import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import FRAME_S, Emulator
from firmware_bridge.recording.formats import load_recording

_POLL_S = 0.05


def main() -> None:
    """Play the recordings named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="+", type=load_recording, help="recording, dealt out to the buses in turn")
    parser.add_argument("--buses", type=int, default=1, metavar="N")
    parser.add_argument("--rate-hz", type=float, help="scans a second of each sensor (default: as recorded)")
    parser.add_argument("--frame-us", type=float, default=1e6 * FRAME_S, help="time of a frame on the bus")
    parser.add_argument("--stamps", type=Path, help="file for controller and time [ns] of each scan's last frame")
    options = parser.parse_args()
    with ExitStack() as closing:
        stamps = None if options.stamps is None else closing.enter_context(options.stamps.open("w", buffering=1))
        prefixes = [f"bus{bus}/" if options.buses > 1 else "" for bus in range(options.buses)]

        def on_scan(prefix: str) -> Callable[[int, int], object]:
            return lambda controller, time_ns: stamps and stamps.write(f"{prefix}{controller} {time_ns}\n")

        emulators = [
            Emulator(
                options.file[bus :: options.buses],
                rate_hz=options.rate_hz,
                loop=True,
                frame_s=options.frame_us / 1e6,
                on_scan=on_scan(prefix),
            )
            for bus, prefix in enumerate(prefixes)
        ]
        closing.enter_context(EmulatorThread(emulators))
        sys.stdout.write("".join(f"{emulator.port}\n" for emulator in emulators))
        sys.stdout.flush()
        while not select.select([0], [], [], _POLL_S)[0]:
            pass


if __name__ == "__main__":
    main()
