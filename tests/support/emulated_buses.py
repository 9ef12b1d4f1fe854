"""Emulated adapters in a process of their own, each with its part of the sensors, until stdin is closed.

    python tests/support/emulated_buses.py FILE FILE --buses 2 --rate-hz 100 --frame-us 130 --stamps stamps.txt

The first lines that it prints are the ports. Recordings are played again and again.
"""

import argparse
import sys
from pathlib import Path

from firmware_bridge.emulation.pty_port import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording


def main() -> None:
    """Play the recordings named on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", nargs="+", type=load_recording, help="recording, dealt out to the buses in turn")
    parser.add_argument("--buses", type=int, required=True, metavar="N")
    parser.add_argument("--rate-hz", type=float, required=True, help="scans a second of each sensor")
    parser.add_argument("--frame-us", type=float, required=True, help="time of a frame on the bus")
    parser.add_argument("--stamps", type=Path, required=True, help="controller and time [ns] of each scan's last frame")
    options = parser.parse_args()
    with options.stamps.open("w", buffering=1) as stamps:

        def emulator(bus: int) -> Emulator:
            prefix = f"bus{bus}/" if options.buses > 1 else ""
            return Emulator(
                options.file[bus :: options.buses],
                rate_hz=options.rate_hz,
                loop=True,
                frame_s=options.frame_us / 1e6,
                on_scan=lambda controller, time_ns: stamps.write(f"{prefix}{controller} {time_ns}\n"),
            )

        emulators = list(map(emulator, range(options.buses)))
        with EmulatorThread(emulators):
            print(*(one.port for one in emulators), sep="\n", flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main()
