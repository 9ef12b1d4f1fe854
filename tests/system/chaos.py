"""`edge-sr` among faults of the wire, judged from outside: by what its records say, and by what was sent.

    python tests/system/chaos.py MINUTES [--calm]

plays sixteen sensors on buses of four, a third of them pressed every other 2.5 s. Each reading tells its taxel and
cycle. So none is made up or old, no whole scan and no pattern mixes cycles without saying so, and every loss is
counted. In runs of minutes memory and latency must stay flat as well. Exit code 1 where a promise was not kept.
"""

import argparse
import math
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import chain, count
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, Final

import numpy as np
import orjson
from chaos_wire import FaultyBus, Sent, stretches
from numpy.typing import NDArray
from program_cost import CONTROLLERS, REST_COUNTS, ROOT, away_from_press, prefixes_of, resident_mb, started, typed

from edge.pipeline.result_stream import uncollected
from edge.terminal.progress_bar import tracked
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.pty_port import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import FRAME_S
from firmware_bridge.scans.can_id_maps import USPA44_MAP

RATE_HZ: Final = 100.0
TELLING: Final = 70
"""Steps of x, and of y: a reading tells its cycle modulo TELLING**2, 49 s."""
PRESS_COUNTS: Final = 3000
STALE_CYCLES: Final = 10
HELD_CYCLES: Final = 15
READY_NS: Final = 150_000_000
"""Longest time until a pattern whose note states no age: 70 ms unread, 50 ms in the program, and the kernel."""
SAYS_ITS_AGE: Final = re.compile(r"\d s (old when it|after its newest reading) arrived")
_RECEIVED: Final = re.compile(r"^received: (.*)$", re.MULTILINE)
FIELDS: Final = "counts,fresh,dead,state,note,device_time_ns,latency_us"
QUIET_S: Final = 0.5
END_TIMEOUT_S: Final = 30.0
WINDOW_S: Final = 5.0
WARM_UP_S: Final = 15.0
LONG_MINUTES: Final = 2.0
"""Length from which memory is judged: in less time all is used for the first time."""
MOST_MB_PER_MINUTE: Final = 0.3
MOST_LATENCY_RATIO: Final = 5.0


def telling(number: int, *, touched: bool) -> NDArray[np.int64]:
    """Return scans (TELLING**2, 16, 3) of a sensor whose x and y tell cycle, taxel and sensor."""
    cycles = np.arange(TELLING**2)[:, None]
    taxels = np.arange(16)
    shift = cycles + 7 * taxels + 16 * number
    pressed = np.rint(PRESS_COUNTS * np.exp(-away_from_press(cycles) / 2)) * (touched & (cycles % 500 >= 250))
    told = (shift % TELLING - TELLING // 2, shift // TELLING % TELLING - TELLING // 2, pressed)
    return REST_COUNTS + np.stack(told, axis=-1).astype(np.int64)


class Judge:
    """Judge of records, in their order."""

    def __init__(self) -> None:
        self.broken: list[str] = []  # promises that were not kept, in plain words
        self.records, self.events = Counter[str](), Counter[str]()  # by sensor, by kind
        self.patterns = self.whole = self.missing = 0  # patterns, whole scans, taxels that records say are missing
        self.counters: dict[str, int] = {}  # the last that a record had, with what the summary at the end has
        self.latencies_us: list[float] = []  # of the patterns since they were last taken
        # Times in [ns] at which the adapter of each bus, by its prefix, could be used again, and was not yet.
        self.back_ns: dict[str, list[int]] = {}
        self._sent: dict[tuple[str, int], dict[tuple[int, int], tuple[int, int, int]]] = {}
        self._shown: dict[tuple[str, int], tuple[int, int]] = {}
        self._numbers: dict[str, int] = {}
        self._left_out = 0

    def sent(self, prefix: str, sent: Sent, now_ns: int) -> None:
        """Note a frame of a bus that goes out whole."""
        if sent.cycle >= 0:
            sensor, taxel = USPA44_MAP.taxels[sent.frame.can_id]
            x, y, z = (int.from_bytes(sent.frame.data[at : at + 2], "big") for at in (1, 3, 5))
            self._sent.setdefault((prefix + sensor, taxel), {})[x, y] = (sent.cycle, z, now_ns)

    def take(self, record: dict[str, Any]) -> None:
        """Judge a record."""
        self.counters |= record.get("counters", {})
        if record["state"] == "event":
            self.events[record["event"]] += 1
            return
        sensor, number = record["sensor"], record["scan"]
        name = f"sensor {sensor}, scan {number}"
        self._follow_numbers(sensor, number, name)
        cycles: dict[int, tuple[int, int]] = {}
        for taxel, (x, y, z) in enumerate(zip(*(chain(*axis) for axis in record["counts"]), strict=True)):
            if not record["fresh"] >> taxel & 1:
                self.missing += 1
                continue
            cycle, z_sent, at_ns = self._sent.get((sensor, taxel), {}).get((x, y), (-1, -1, 0))
            if z != z_sent:
                self.broken.append(f"{name}: taxel {taxel} reads {x}, {y}, {z}, which was never sent")
            elif cycle <= self._shown.get((sensor, taxel), (-1, 0))[0]:
                self.broken.append(f"{name}: taxel {taxel} has cycle {cycle} a second time")
            cycles[taxel] = self._shown[sensor, taxel] = (cycle, at_ns)
        back_ns = self.back_ns.get("".join(sensor.rpartition("/")[:2]), [])
        while back_ns and back_ns[0] < max((at_ns for _, at_ns in cycles.values()), default=0):
            back_ns.pop(0)
        if len(cycles) == 16:
            self.whole += 1
            if record["device_time_ns"] is not None and len({cycle for cycle, _ in cycles.values()}) > 1:
                self.broken.append(f"{name}: a whole scan of cycles {sorted({cycle for cycle, _ in cycles.values()})}")
        if record["state"] == "contact":
            self.patterns += 1
            self.broken += [f"{name}: {why}" for why in self._pattern(record, cycles)]

    def _follow_numbers(self, sensor: str, number: int, name: str) -> None:
        gap = number - self._numbers.get(sensor, -1) - 1
        self._numbers[sensor] = number
        self.records[sensor] += 1
        if gap < 0:
            self.broken.append(f"{name}: a number a second time")
        if gap > 0:  # a taxel may have been shown in a record that is missing
            self._left_out += gap
            self._shown = {key: shown for key, shown in self._shown.items() if key[0] != sensor}
            if self._left_out > self.counters["unwritten"] + self.counters["overruns"]:
                self.broken.append(f"{name}: {gap} scans before it left no trace in the counters")

    def _pattern(self, record: dict[str, Any], cycles: dict[int, tuple[int, int]]) -> Iterator[str]:
        """Yield what is wrong with a pattern."""
        if not cycles:
            yield "a pattern without a fresh reading"
            return
        oldest, newest = min(cycles.values()), max(cycles.values())
        if min(newest[0] - oldest[0], RATE_HZ * (newest[1] - oldest[1]) / 1e9) > STALE_CYCLES:
            yield f"a pattern of cycles {oldest[0]} to {newest[0]}"
        for taxel in set(range(16)) - set(cycles) - {int(taxel) for taxel in record["dead"]}:
            held = self._shown.get((record["sensor"], taxel), newest)
            if min(newest[0] - held[0], RATE_HZ * (newest[1] - held[1]) / 1e9) > HELD_CYCLES:
                yield f"taxel {taxel} is held from cycle {held[0]} to {newest[0]}"
        self.latencies_us.append(record["latency_us"])
        ready_ns = record["time_ns"] + 1e3 * record["latency_us"] - newest[1]
        if ready_ns > READY_NS and not SAYS_ITS_AGE.search(record["note"] or ""):
            yield f"ready {ready_ns / 1e6:.0f} ms after its newest reading, and no note states that"

    def close(self, buses: Sequence[FaultyBus], said: str, sensors: Sequence[str]) -> None:
        """Compare both sides' accounts, with the summary of the program."""
        lines = _RECEIVED.findall(said)
        pairs = (text.rpartition(" ") for text in lines[-1].split(", ")) if lines else ()
        self.counters |= {name: int(number) for name, _, number in pairs if number.isdigit()}
        counted = Counter(self.counters)
        if not all(bus.over for bus in buses):
            self.broken.append("the emulator failed")
        if any(self.back_ns.values()):
            self.broken.append("an adapter that was back was never used")
        unread = sum(bus.unread_bytes for bus in buses) + counted["dropped_bytes"]
        openings = sum(bus.openings for bus in buses)
        for name in ("handed", "foreign"):  # of a line that is not fetched, less than 22 bytes may be
            theirs, ours = sum(getattr(bus, name) for bus in buses), counted[{"handed": "frames"}.get(name, name)]
            if not 0 <= theirs - ours <= unread // 22 + openings:
                self.broken.append(f"{ours} of {theirs} {name} frames are counted, and {unread} bytes were left")
        if counted["frames"] != counted["readings"] + counted["foreign"]:
            self.broken.append(
                f"{counted['frames']} frames are not {counted['readings']} readings and the foreign ones"
            )
        held = sum(counted[name] for name in ("duplicates", "abandoned", "unconfirmed", "resynchronised"))
        open_readings = counted["readings"] - 16 * counted["scans"] + counted["missing_taxels"] - held
        if not 0 <= open_readings <= 16 * len(sensors):
            self.broken.append(f"{open_readings} readings are of no scan and of no counter")
        if not self._left_out and not counted["unwritten"] + counted["overruns"]:
            ours = {"scans": counted["scans"], "missing_taxels": counted["missing_taxels"]}
            if ours != {"scans": self.records.total(), "missing_taxels": self.missing}:
                self.broken.append(f"counters say {ours}, records {self.records.total()} and {self.missing}")


def timeline(scans: dict[str, NDArray[np.int64]], end_s: Callable[[], float]) -> Iterator[Sent]:
    """Yield the frames of the sensors on a bus, mixed as on a full one, until a time since the first."""
    lanes = [(USPA44_MAP.wire_order(name), counts) for name, counts in scans.items()]
    for cycle in count():
        for place in range(16):
            for lane, (order, counts) in enumerate(lanes):
                time_s = cycle / RATE_HZ + (place * len(lanes) + lane) * FRAME_S
                if time_s > end_s():
                    return
                can_id, taxel = order[place]
                words = b"".join(int(value).to_bytes(2, "big") for value in counts[cycle % len(counts), taxel])
                yield Sent(time_s, CanFrame(can_id, b"\x93" + words + b"\x0f"), cycle)


class Chaos:
    """A run of edge-sr among faults, and its outcome."""

    def __init__(self, sensors: int, seed: int, faults: str) -> None:
        """Prepare buses of four sensors with faults as `chaos_wire.stretches` takes them; nothing is started yet."""
        self.judge = Judge()
        self.faults = Counter[str]()  # stretches that were begun, by fault
        # Minute, memory in [MB], threads and descriptors, and the lower quartile of the latency in [us].
        self.windows: list[tuple[float, float, int, float]] = []
        prefixes = prefixes_of(sensors)
        self._scans: dict[str, dict[str, NDArray[np.int64]]] = {prefix: {} for prefix in prefixes}
        for number in range(sensors):
            name = CONTROLLERS[number // len(prefixes)]
            self._scans[prefixes[number % len(prefixes)]][name] = telling(number, touched=number < -(-sensors // 3))
        self.names = [prefix + name for prefix, scans in self._scans.items() for name in scans]
        self._seed, self._faults, self._end_s = seed, faults, math.inf

    def play(self, seconds: float) -> list[str]:
        """Run for so long; return the promises that were not kept, of a run of minutes its growth as well."""
        null = subprocess.DEVNULL
        with (
            tempfile.TemporaryDirectory() as name,
            uncollected(),  # or no thread would read for a tenth of a second
            EmulatorThread(buses := self._buses(Path(name))),
            (Path(name) / "said").open("wb") as errors,
            started(self._typed(Path(name), buses), ROOT, stdin=null, stdout=subprocess.PIPE, stderr=errors) as process,
            ExitStack() as ending,
        ):
            ending.callback(process.kill)
            lines = SimpleQueue[bytes]()
            reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
            reader.start()
            self._follow(lines, process, seconds)
            end_s = time.monotonic() + END_TIMEOUT_S
            while any(self.judge.back_ns.values()) and process.poll() is None and time.monotonic() < end_s:
                self._judge(lines, QUIET_S)  # each adapter that is back is to be used, however slow this machine is
            self._end_s = 0.0  # the sensors are switched off, so that the accounts close
            records = -1
            while records != (records := self.judge.records.total()):  # a busy program is behind
                self._judge(lines, QUIET_S)
            process.send_signal(signal.SIGTERM)  # beside other commands of a script SIGINT is ignored
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_TIMEOUT_S)
            code = process.poll()
            process.kill()
            reader.join()
            self._judge(lines, 0.0)
            said = (Path(name) / "said").read_text(errors="replace")
        for bus in buses:
            self.faults += bus.begun
        self.judge.close(buses, said, self.names)
        broken = list(dict.fromkeys(self.judge.broken))
        if code != 0 or "Traceback" in said:
            broken.append(f"exit code {code}: {said[-2000:]}")
        if len(self.judge.records) != len(self.names):
            broken.append(f"{len(self.judge.records)} of {len(self.names)} sensors have records")
        if seconds >= 60 * LONG_MINUTES:
            slope, half = self.growth()
            if slope - half > MOST_MB_PER_MINUTE:
                broken.append(f"memory grows by {slope:.3f} MB a minute (+- {half:.3f})")
            if self.latency_ratio() > MOST_LATENCY_RATIO:
                broken.append(f"the latency of the last third is {self.latency_ratio():.2f} times that of the first")
        return broken

    def growth(self) -> tuple[float, float]:
        """Return the slope of the memory in [MB a minute], of the second half, and half of its 95 % interval."""
        minutes, mb, *_ = np.array(self.windows[-max(4, len(self.windows) // 2) :]).T
        (slope, _), covariance = np.polyfit(minutes, mb, 1, cov=True)
        return float(slope), float(1.96 * np.sqrt(covariance[0, 0]))

    def latency_ratio(self) -> float:
        """Return the latency of the last third of the windows to that of the first."""
        latencies_us, third = [window[3] for window in self.windows], max(1, len(self.windows) // 3)
        return statistics.median(latencies_us[-third:]) / statistics.median(latencies_us[:third])

    def _buses(self, folder: Path) -> list[FaultyBus]:
        buses: list[FaultyBus] = []
        for number, (prefix, scans) in enumerate(self._scans.items()):
            seed = self._seed + number
            on_sent = partial(self.judge.sent, prefix)
            sent = timeline(scans, lambda: self._end_s)
            buses.append(FaultyBus(sent, stretches(self._faults, seed), seed, folder / f"adapter{number}", on_sent))
            self.judge.back_ns[prefix] = buses[-1].back_ns
        return buses

    def _typed(self, folder: Path, buses: Sequence[FaultyBus]) -> list[str]:
        words = typed(folder, self.names, self._scans, [bus.line.path for bus in buses])
        return [*words, "--sink", "jsonl:-", "--fields", FIELDS]

    def _follow(self, lines: SimpleQueue[bytes], process: subprocess.Popen[bytes], seconds: float) -> None:
        """Judge records for so long from the first on, and measure memory and latency window by window."""
        start_s = time.monotonic()
        while process.poll() is None and not self.judge.records and time.monotonic() < start_s + END_TIMEOUT_S:
            self._judge(lines, 0.1)
        warm_up_s = min(WARM_UP_S, seconds / 4)
        self._judge(lines, warm_up_s)
        windows = max(4, round((seconds - warm_up_s) / WINDOW_S))
        for number in tracked(range(windows), "chaos", "window"):
            if process.poll() is not None:
                break
            self.judge.latencies_us.clear()
            self._judge(lines, (seconds - warm_up_s) / windows)
            latencies_us = sorted(self.judge.latencies_us)
            folder = Path(f"/proc/{process.pid}")
            held = sum(len(list((folder / name).iterdir())) for name in ("task", "fd"))
            quiet_us = latencies_us[len(latencies_us) // 4] if latencies_us else math.nan
            minute = (number + 1) * (seconds - warm_up_s) / windows / 60
            self.windows.append((minute, resident_mb(folder), held, quiet_us))

    def _judge(self, lines: SimpleQueue[bytes], seconds: float) -> None:
        """Judge the records that come within this time, and all that wait."""
        end_s = time.monotonic() + seconds
        with suppress(Empty):
            while True:
                self.judge.take(orjson.loads(lines.get(timeout=max(0.0, end_s - time.monotonic()))))


def _read(stream: IO[bytes], lines: SimpleQueue[bytes]) -> None:
    """Fetch records at once, since what finds no room is left out for a reader that is slow."""
    for line in stream:
        if line.endswith(b"\n"):  # else the program was killed in the middle of it
            lines.put(line)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("minutes", type=float, metavar="MINUTES")
    parser.add_argument("--calm", action="store_true", help="no faults")
    options = parser.parse_args(arguments)
    seconds = 60 * options.minutes
    run = Chaos(16, 1, "" if options.calm else f"mixed@1+{seconds - 1:g}")
    broken = run.play(seconds)
    slope, half = run.growth()
    print(
        f"{run.judge.records.total()} records, {run.judge.whole} whole, {run.judge.patterns} patterns; "
        f"{run.faults.total()} faults of {len(run.faults)} kinds; memory {slope:+.3f} MB a minute (+- {half:.3f}), "
        f"{run.windows[-1][1]:.1f} MB; latency {run.latency_ratio():.2f} of the first third's"
    )
    print(", ".join(f"{name} {number}" for name, number in run.judge.counters.items() if number))
    print("\n".join(["broken:", *broken[:20]]) if broken else "every promise was kept")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
