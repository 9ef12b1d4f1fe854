"""Many sensors among faults for minutes: memory, latency, and accounts that must be consistent.

    python tests/system/hand_soak.py MINUTES [--sensors N] [--seed N] [--out DIR]

Each bus has an injector of its own, whose faults pull cables, lose frames and damage lines. Exit code 1 where a
promise was not kept.
"""

import argparse
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from soak import Soak, Window, evaluated, slope

from edge.bench.errors import BenchError
from edge.bench.live_report import Page, head, line
from edge.bench.program import PROGRAM_SOURCES, Line, Play, Program, edge_sr, emulating
from edge.bench.provenance import provenance
from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.terminal.argument_types import whole
from edge.terminal.progress_bar import tracked

SENSORS: Final = 16
CALM_S: Final = 1.0
WARM_UP_S: Final = 15.0
SHORT_MINUTES: Final = 2.0
"""Length below which all is still used for the first time, and memory grows by that."""
WINDOW_S: Final = 5.0
MOST_MB_PER_MINUTE: Final = 0.3
MOST_MB: Final = 120.0
_TAXELS: Final = 16
_INJECTOR: Final = str(Path(__file__).with_name("fault_emulator.py"))
_TEXT: Final = """\
edge-sr in a process of its own reads the sensors on buses of four, over pseudo-terminals; between each bus and its
terminal sits an injector. A third of the sensors press and rest in turns of 2.5 s. Records go to a pipe that is read at
once."""


class Accounts:
    """Account of all records of a run.

    Attributes:
        records: of scans, by sensor.
        broken: what does not fit, in plain words.
    """

    def __init__(self, sensors: int) -> None:
        """Begin with nothing counted; each sensor may hold one scan open, before its first record as well."""
        self.records: Counter[str] = Counter()
        self.broken: list[str] = []
        self._last: dict[str, int] = {}
        self._unwritten = 0
        self._most_open = _TAXELS * sensors

    def follow(self, lines: Sequence[Line]) -> None:
        """Take records in their order; each counts what was left out before it."""
        for one in lines:
            record: dict[str, Any] = one.record
            sensor, number, counters = record["sensor"], record["scan"], record["counters"]
            gap = number - self._last.get(sensor, -1) - 1
            self._last[sensor] = number
            self._unwritten += gap
            self.records[sensor] += 1
            if gap < 0:
                self.broken.append(f"sensor {sensor}: scan {number} came twice, or out of order")
            if self._unwritten > counters["unwritten"] + counters["overruns"]:
                self.broken.append(f"sensor {sensor}: {gap} scans before {number} left no trace in the counters")
                self._unwritten = counters["unwritten"] + counters["overruns"]
        if lines:
            self._check_sums(lines[-1].record["counters"])

    def _check_sums(self, counters: dict[str, int]) -> None:
        """Check that every frame is accounted for, but for those of scans that are open."""
        if counters["frames"] != counters["readings"] + counters["foreign"]:
            self.broken.append(
                f"{counters['frames']} frames are not {counters['readings']} readings and the foreign ones"
            )
        held = ("duplicates", "abandoned", "unconfirmed", "resynchronised")
        fates = _TAXELS * counters["scans"] - counters["missing_taxels"] + sum(counters[name] for name in held)
        open_readings = counters["readings"] - fates
        if not 0 <= open_readings <= self._most_open:
            self.broken.append(f"{open_readings} readings are of no scan and of no counter")


@contextmanager
def _disturbed(folder: Path, faults: str, seed: int, *arguments: str, buses: int) -> Iterator[list[str]]:
    """Run emulators with faults, at names that stay the same when their cables are pulled."""
    options = ["--faults", faults, "--seed", str(seed), "--link", str(folder / "adapter")]
    with emulating(*options, *arguments, buses=buses, program=[_INJECTOR]) as ports:
        yield ports


def soak(minutes: float, sensors: int, seed: int) -> tuple[Soak, Accounts, dict[str, int]]:
    """Run the program among faults for so long, three windows at least; also returns its last counters.

    Raises:
        BenchError: a process ended.
    """
    play = Play(sensors=sensors, pressed=250, moving=True, touched=-(-sensors // 3))
    window_s = min(WINDOW_S, 20 * minutes)
    count = max(3, round(60 * minutes / WINDOW_S))
    faults = f"mixed@1+{CALM_S + window_s * count:g}"
    accounts = Accounts(sensors)
    with (
        tempfile.TemporaryDirectory() as name,
        edge_sr(Path(name), play, emulate=partial(_disturbed, Path(name), faults, seed)) as program,
    ):
        accounts.follow(program.lines(CALM_S if minutes < SHORT_MINUTES else WARM_UP_S))
        windows, counters = list[Window](), dict[str, int]()
        for _ in tracked(range(count), "soak", "window", count):
            lines = program.lines(window_s)
            accounts.follow(lines)
            counters = lines[-1].record["counters"]
            windows.append(_window(program, lines, window_s * (len(windows) + 1)))
    return evaluated(windows), accounts, counters


def _window(program: Program, lines: Sequence[Line], end_s: float) -> Window:
    latencies_us = sorted(one.record["latency_us"] for one in lines if one.record["latency_us"] is not None)
    quiet_us = latencies_us[len(latencies_us) // 4] if latencies_us else math.nan
    overruns = lines[-1].record["counters"]["overruns"]
    return Window(end_s, program.resident_mb(), quiet_us, *program.threads_and_descriptors(), overruns)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("minutes", type=float, metavar="MINUTES", help="length of the run")
    parser.add_argument("--sensors", type=whole(4), default=SENSORS, metavar="N", help="default 16")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the faults (default 1)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write hand_soak.md there")
    options = parser.parse_args(arguments)
    page = Page(sys.stdout, sys.stderr)
    command = f"python tests/system/hand_soak.py {options.minutes:g} --sensors {options.sensors} --seed {options.seed}"
    about = provenance(command, [__file__, *PROGRAM_SOURCES], [find_model(DEFAULT_MODEL)], options.seed)
    page.say(f"# A hand among faults\n\n{about}\n\n{_TEXT}\n")
    try:
        found, accounts, counters = soak(options.minutes, options.sensors, options.seed)
    except BenchError as error:
        sys.stderr.write(f"hand_soak: {error}\n")
        return 1
    page.say(head(("minute", "MB", "latency, lower quartile, us", "threads", "descriptors", "overrun")))
    every = max(1, len(found.windows) // 12)
    for window in found.windows[::every]:
        figures = (f"{window.end_s / 60:.1f}", f"{window.resident_mb:.1f}", f"{window.quiet_us:.0f}")
        page.say(line((*figures, str(window.threads), str(window.descriptors), str(window.overruns))))
    # Faults of each kind come to each bus by and by, and what they use for the first time stays: the first half grows.
    half = found.windows[len(found.windows) // 2 :] if options.minutes >= SHORT_MINUTES else found.windows
    growth, spread = slope([one.end_s / 60 for one in half], [one.resident_mb for one in half])
    text = f"{growth:+.3f} MB a minute (+- {spread:.3f}, 95 %) from minute {half[0].end_s / 60:.1f} on"
    page.say(f"\nMemory {text}; lower quartile of the latency, last third to first: {found.latency_ratio:.2f}.")
    counted = ", ".join(f"{name} {count}" for name, count in counters.items() if count)
    page.say(f"\n{sum(accounts.records.values())} records of {len(accounts.records)} sensors. Counters: {counted}.")
    broken = list(dict.fromkeys(accounts.broken))
    if options.minutes >= SHORT_MINUTES and growth - spread > MOST_MB_PER_MINUTE:
        broken.append(f"memory grows: {text}")
    if max(window.resident_mb for window in found.windows) > MOST_MB:
        broken.append(f"memory above {MOST_MB:g} MB")
    if len(accounts.records) != options.sensors:
        broken.append(f"{len(accounts.records)} of {options.sensors} sensors have records")
    page.say("\nAccounts: " + ("\n- ".join(["", *broken[:20]]) if broken else "all consistent."))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "hand_soak.md").write_text("\n".join(page.lines) + "\n")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
