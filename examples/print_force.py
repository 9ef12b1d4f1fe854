"""Print the force on each pad at the sensor's own rate, 100 times a second.

    python print_force.py --source slcan:serial=D30BL366
    python print_force.py --source demo                     # without a sensor

Zeroing takes the first second; nothing may touch the pad meanwhile. Ctrl-C ends it.
"""

import argparse
import os
import sys

from edge.api import BridgeError, EdgeError, Event, Result, Stream, open_runtime, open_source


def line(result: Result) -> str:
    """Format one result as a line."""
    # Results that do not come from hardware are marked, here as in every other output.
    words = [] if result.source == "device" else [result.source.upper()]
    words += [f"{result.scan.time_ns / 1e9:.3f} s", f"sensor {result.scan.sensor}", result.state]
    if result.force_counts is not None:  # None while zeroing, or while a taxel is silent
        words.append(f"{result.force_counts:.0f} counts")
    if result.force_n is not None:  # None without counts per newton, from a sensor file or counts_per_newton=...
        words.append(f"{result.force_n:.2f} N")
    if result.dead:
        words.append(f"without taxels {sorted(result.dead)}")
    if result.note is not None:
        words.append(f"({result.note})")
    return "  ".join(words)


def tell(event: Event) -> None:
    """Print events that come between scans: a lost cable, its return, ..."""
    print(event.text, file=sys.stderr)


def main() -> None:
    """Open a source, iterate over its results, and print them."""
    parser = argparse.ArgumentParser(description="Print the force on each pad.")
    parser.add_argument(
        "--source", action="append", default=[], help="source, as for edge-sr; repeated for two fingers, with names"
    )
    parser.add_argument("--sensor", help="sensor file of edge-sr doctor")
    parser.add_argument("--duration-s", type=float, help="stop after this time")
    options = parser.parse_args()
    try:
        with open_source(*options.source, sensor=options.sensor) as source:
            runtime = open_runtime("stsr-int8", source)
            stream = Stream(source, runtime, on_event=tell, duration_s=options.duration_s)
            for result in stream:
                print(line(result), flush=True)
            for name, rate_hz in stream.statistics.rate_hz().items():
                print(f"sensor {name}: {rate_hz:.1f} scans a second", file=sys.stderr)
    except BrokenPipeError:  # the reader has closed; point stdout elsewhere, or Python reports an error at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        pass  # the with statement has closed everything
    except (BridgeError, EdgeError) as error:
        sys.exit(f"print_force: {error}")


if __name__ == "__main__":
    main()
