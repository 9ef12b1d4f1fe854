"""`edge-sr` reads a server that is killed, frozen and sends garbage; every record is compared with what it played."""

import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from fault_played import TELLING, telling_counts
from fault_records import Seen, in_thread, keep_lines, read_records
from fault_run import END_TIMEOUT_S

from edge.bench.program import REST_COUNTS, environment
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

SENSOR: Final = "1"
RATE_HZ: Final = 100.0
GARBAGE_EVERY: Final = 50
MOST_CYCLES: Final = 10
"""Cycles by which the taxels of a pattern may be apart: 100 ms, as on the wire."""


@dataclass
class ServerRan:
    """Outcome of a run against a failing server.

    Attributes:
        exit_code: exit code of edge-sr.
        said: text on stderr.
        seen: its records.
        down: when the server was away or hung, from and until, in [ns], and which of both.
        told_ns: when each cycle, by its number modulo TELLING**2, was first sent, in [ns].
    """

    exit_code: int = -1
    said: str = ""
    seen: list[Seen] = field(default_factory=list)
    down: list[tuple[str, int, int]] = field(default_factory=list)
    told_ns: dict[int, int] = field(default_factory=dict)


@dataclass
class ServerFound:
    """Evaluated records of such a run.

    Attributes:
        records: records of scans.
        patterns: records with a pattern.
        made_up: readings that the server never sent.
        apart: patterns whose taxels lie more than MOST_CYCLES apart although the record does not state it.
        back_s: time from the server's return to the first record, in [s].
    """

    records: int = 0
    patterns: int = 0
    made_up: int = 0
    apart: int = 0
    back_s: list[float] = field(default_factory=list)


def run_against_server(seconds: float, seed: int, folder: Path) -> ServerRan:
    """Run the program for so long against a server that fails every two to four seconds."""
    from xela_server_emulator import ServerEmulator
    from xela_server_model import VendorServer

    class Telling(VendorServer):
        """Server that keeps when it first sent each cycle."""

        def message(self, sequence: int, elapsed_s: float, unix_s: float) -> str:
            """Note the cycles of a message, and pass it on."""
            ran.told_ns.setdefault(self.cycle(0, elapsed_s) % TELLING**2, time.monotonic_ns())
            return super().message(sequence, elapsed_s, unix_s)

    ran, draw = ServerRan(), random.Random(f"server {seed}")
    counts = telling_counts(0)
    recording = Recording(Path("telling"), (Track(SENSOR, counts, None),), RATE_HZ)
    rest = np.asarray(REST_COUNTS, dtype=np.float32)[:, None, None] + np.zeros((3, 4, 4), dtype=np.float32)
    rest[2] += 37 * np.arange(16).reshape(4, 4)
    save_baselines(folder / "zero1.json", [Baseline.of(SENSOR, rest, time.time(), 100, "file")])
    with ServerEmulator(Telling([recording], loop=True), garbage_every=GARBAGE_EVERY) as server:
        command = [sys.executable, "-m", "edge.cli.main", "--source", f"xela-server:{server.url}", "--sink", "jsonl:-"]
        with subprocess.Popen(
            [*command, "--baseline", str(folder / "zero1.json")],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment(),
            start_new_session=True,
        ) as process:
            errors: list[bytes] = []
            threads = [in_thread(read_records, process.stdout, ran.seen), in_thread(keep_lines, process.stderr, errors)]
            end_s = time.monotonic() + seconds
            time.sleep(2.0)
            while process.poll() is None and time.monotonic() < end_s - 4.0:
                name = draw.choice(("killed", "frozen"))
                away, back = (server.kill, server.start_again) if name == "killed" else (server.freeze, server.thaw)
                away()
                begin_ns = time.monotonic_ns()
                time.sleep(draw.uniform(0.3, 1.5))
                back()
                ran.down.append((name, begin_ns, time.monotonic_ns()))
                time.sleep(draw.uniform(2.0, 4.0))
            process.send_signal(signal.SIGINT)
            try:
                ran.exit_code = process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
            for thread in threads:
                thread.join(END_TIMEOUT_S)
        ran.said = b"".join(errors).decode(errors="replace")
    return ran


def judge_server(ran: ServerRan) -> ServerFound:
    """Evaluate the records."""
    found = ServerFound()
    places = _places()
    for one in ran.seen:
        if one.counts is None:
            continue
        found.records += 1
        found.patterns += one.drawn
        cycles: list[int] = []
        for taxel, reading in enumerate(one.counts.tolist()):
            if one.head["fresh"] >> taxel & 1:
                cycle = places[taxel].get(tuple(reading))
                told_ns = None if cycle is None else ran.told_ns.get(cycle)
                if cycle is None or told_ns is None or told_ns > one.head["time_ns"]:
                    found.made_up += 1
                else:
                    cycles.append(cycle)
        apart = max(cycles, default=0) - min(cycles, default=0)
        found.apart += one.drawn and min(apart, TELLING**2 - apart) > MOST_CYCLES
    times_ns = [one.head["time_ns"] for one in ran.seen if one.counts is not None]
    for _, _, end_ns in ran.down:
        used_ns = next((time_ns for time_ns in times_ns if time_ns > end_ns), None)
        if used_ns is not None:
            found.back_s.append((used_ns - end_ns) / 1e9)
    return found


@cache
def _places() -> list[dict[tuple[int, int, int], int]]:
    """Return, for each taxel, the cycle of each reading that is played."""
    played = telling_counts(0).reshape(-1, 3, 16).transpose(0, 2, 1)
    return [{(x, y, z): cycle for cycle, (x, y, z) in enumerate(played[:, taxel].tolist())} for taxel in range(16)]
