"""Close a gripper, and stop it as soon as the touched area is large enough.

    python stop_on_area.py --area-mm2 60 --source slcan:serial=D30BL366
    python stop_on_area.py --area-mm2 60 --source demo --pretend        # without a sensor

Replace `PrintedGripper` by your own. It is also stopped for everything that may be wrong: too much force, a dead
taxel, a baseline in doubt, a pattern that is not to be believed, readings that are old or missing, a lost link, an
error, Ctrl-C. A model without checks is refused. Of several sensors every one must be well and free before it begins,
and any one stops it; --name restricts this to one. It never moves by an emulated sensor or a recording, unless
--pretend is set. Exit code 0 only if the area was reached, by a pattern that is to be believed.

No program can monitor itself: let the gripper's own controller stop when it receives no further commands.
"""

import argparse
import math
import os
import signal
import sys
import time

from edge.api import BridgeError, EdgeError, Event, Model, Result, Source, Stream, load_model, open_runtime, open_source

SETTLING_NS = 500_000_000
"""Time after the first reading by which every present sensor must have sent one, in [ns]."""
TICK_S = 0.005
"""Pause between two looks at the newest readings, half a period of a sensor, in [s]."""


class PrintedGripper:
    """Gripper that prints its movements, with the two methods that yours must have."""

    def __init__(self) -> None:
        self._moves = False

    def close(self) -> None:
        """Begin to close slowly, and return at once."""
        self._moves = True
        print("gripper: closing", flush=True)

    def stop(self) -> None:
        """Stop where it is, at once; may be called at any time, and again."""
        moved, self._moves = self._moves, False
        if moved:
            print("gripper: stopped", flush=True)


class Grip:
    """One closing of a gripper, from the time when every pad is ready and free until it ends.

    Then `why` is the reason for its end, and `reached` is true if the area was large enough.
    """

    def __init__(
        self, gripper: PrintedGripper, area_mm2: float, *, most_counts: float, oldest_ms: float, name: str | None = None
    ) -> None:
        """Prepare to grip, with the limits of the command line; `name` is of the one sensor to use, None for all."""
        self.why = "it never began: no scan arrived"
        self.reached = False
        self._gripper = gripper
        self._area_mm2 = area_mm2
        self._most_counts = most_counts
        self._oldest_ms = oldest_ms
        self._name = name
        self._missing = frozenset[str]() if name is None else frozenset({name})
        self._first_ns: int | None = None
        self._received_ns: dict[str, int] = {}
        self._free: set[str] = set()
        self._closing = False
        self._ended = False

    def run(self, source: Source, model: Model, duration_s: float) -> None:
        """Grip; the gripper is stopped whenever this returns or raises."""
        runtime = open_runtime(model, source)
        if self._name is None:
            self._missing = runtime.expected
        stream = Stream(source, runtime, on_event=self._on_event, duration_s=duration_s)
        try:
            while not (self._ended or stream.ended):
                time.sleep(TICK_S)
                for latest in stream.latest_of_all().values():
                    if latest.new and latest.result is not None and not self._ended:
                        self.follow(latest.result)
                if (silent := self._silent()) is not None:
                    self._end(silent)
            self._end("no more readings: the time is over, or the source")
        finally:
            self._gripper.stop()

    def follow(self, result: Result) -> None:
        """Evaluate one reading: begin, continue, or end."""
        scan = result.scan
        if self._name not in (None, scan.sensor):
            return
        self._first_ns = scan.time_ns if self._first_ns is None else self._first_ns
        self._received_ns[scan.sensor] = scan.time_ns if scan.device_ns is None else scan.device_ns
        self._free.discard(scan.sensor)
        wrong = self._what_is_wrong(result)
        if wrong is not None:
            self._end(wrong)
        elif result.area_mm2 is not None and result.area_mm2 >= self._area_mm2:
            self.reached = self._closing and result.trusted is True
            checked = "" if result.trusted is True else ", in a pattern that was not checked"
            self._end(f"{result.area_mm2:.0f} mm2 touch, as felt {self._age_ms(scan.sensor):.1f} ms ago{checked}")
        elif result.state == "idle":  # zeroed, every taxel has sent readings, no contact
            self._free.add(scan.sensor)
            settled = scan.time_ns - self._first_ns >= SETTLING_NS and self._received_ns.keys() >= self._missing
            if settled and self._free == self._received_ns.keys() and not self._closing:
                self._closing = True
                self._gripper.close()

    def _on_event(self, event: Event) -> None:
        """End on any event (lost, silent, in trouble) unless it is of a sensor that is not used."""
        if self._name is None or event.sensor in (None, self._name):
            self._end(event.text)

    def _what_is_wrong(self, result: Result) -> str | None:
        age_ms = self._age_ms(result.scan.sensor)
        if age_ms > self._oldest_ms:  # this loop, or the adapter, is too slow
            return f"the reading is {age_ms:.0f} ms old"
        if (silent := self._silent()) is not None:
            return silent
        if result.dead:
            return f"taxels {sorted(result.dead)} are dead"
        if result.state not in ("idle", "contact", "dropped") or result.force_counts is None:
            return f"the sensor is not ready: {result.note or result.state}"
        if result.trusted is False:  # its area is no ground to go on, nor to have reached anything
            return f"the pattern is not to be believed: {result.untrusted_text}"
        if result.force_counts > self._most_counts:
            return f"the force is {result.force_counts:.0f} counts"
        return None

    def _silent(self) -> str | None:
        """Return a message about the first sensor that is silent for too long, or None."""
        for sensor in self._received_ns:
            if self._age_ms(sensor) > self._oldest_ms:
                return f"no reading of sensor {sensor} for {self._age_ms(sensor):.0f} ms"
        return None

    def _age_ms(self, sensor: str) -> float:
        return (time.monotonic_ns() - self._received_ns[sensor]) / 1e6

    def _end(self, why: str) -> None:
        if not self._closing:  # not closing yet; it waits until all sensors are ready
            self.why = f"it never began: {why}"
        elif not self._ended:
            self._gripper.stop()
            self.why = why
            self._ended = True


def end(number: int, frame: object) -> None:
    """Raise an exception on SIGTERM, so that `finally` stops the gripper."""
    sys.exit(128 + number)


def positive(text: str) -> float:
    """Parse a limit; NaN or infinity would disable it."""
    number = float(text)
    if not 0 < number < math.inf:
        raise ValueError
    return number


def main() -> None:
    """Open a source, grip, and print the reason for the stop."""
    parser = argparse.ArgumentParser(description="Close a gripper until the touched area is large enough.")
    source_help = "source, as for edge-sr; repeated for two fingers, with names (default: the adapter plugged in)"
    parser.add_argument("--source", action="append", default=[], help=source_help)
    parser.add_argument("--name", help="name of the only sensor to use, such as 4 or left/4 (default: all)")
    parser.add_argument("--sensor", help="sensor file of edge-sr doctor")
    parser.add_argument("--model", default="stsr-int8", help="model file, or bundled model")
    parser.add_argument("--area-mm2", type=positive, required=True, help="touched area at which to stop")
    parser.add_argument("--most-counts", type=positive, default=20_000, help="summed z at which to stop in any case")
    parser.add_argument("--oldest-ms", type=positive, default=100, help="age of a reading at which to stop in any case")
    parser.add_argument("--duration-s", type=positive, default=60, help="stop after this time in any case")
    parser.add_argument("--pretend", action="store_true", help="accept an emulated sensor or a recording")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, end)
    limits = {"most_counts": options.most_counts, "oldest_ms": options.oldest_ms}
    grip = Grip(PrintedGripper(), options.area_mm2, **limits, name=options.name)
    try:
        with open_source(*options.source, sensor=options.sensor) as source:
            if source.kind != "device" and not options.pretend:
                sys.exit(f"stop_on_area: {source.name} is {source.kind}, not a sensor: pass --pretend to accept it")
            model = load_model(options.model)
            if not model.contract.trust:
                sys.exit(f"stop_on_area: model {model.name} has no checks: no pattern of it is to be acted on")
            grip.run(source, model, options.duration_s)
        print(f"why: {grip.why}", flush=True)
    except BrokenPipeError:  # the reader has closed; point stdout elsewhere, or Python reports an error at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (BridgeError, EdgeError) as error:
        sys.exit(f"stop_on_area: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0 if grip.reached else 1)


if __name__ == "__main__":
    main()
