"""Lines of an adapter that loses frames or bytes, or whose clock is bad, and what became of their scans. Pure.

    python tests/support/wire_faults.py [--scans 20000] [--seed 1] [--out FILE] [WORD ...]

plays every case, or those whose names hold all the words, and prints a line for each: scans, whole and torn ones, whole
ones of two cycles, and whole cycles without a whole scan where nothing was lost. The exit code is 1 if a scan is mixed.
With --out it writes them as a report.
"""

import argparse
import random
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

from edge.bench.provenance import provenance
from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import FRAME_S
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans

START_S: Final = 100.0
WRAP_MS: Final = 60_000
LOST_AT_ONCE: Final = (16, 32, 48)

STAMPS: Final[dict[str, Callable[[float, random.Random], float]]] = {
    "good": lambda ms, _: ms,
    "jitter of 4 ms": lambda ms, draw: ms + draw.uniform(0, 4),
    "jitter of 10 ms": lambda ms, draw: ms + draw.uniform(0, 10),
    "jitter of 40 ms": lambda ms, draw: ms + draw.uniform(0, 40),
    "standing still": lambda _, __: 4711,
    "1 % slow": lambda ms, _: ms * 0.99,
    "1 % fast": lambda ms, _: ms * 1.01,
    "0.1 % slow": lambda ms, _: ms * 0.999,
    "in us": lambda ms, _: ms * 1000,
    "in 0.1 ms": lambda ms, _: ms * 10,
    "in 10 ms": lambda ms, _: ms / 10,
    "in steps of 16 ms": lambda ms, _: ms // 16 * 16,
    "random": lambda _, draw: draw.randrange(WRAP_MS),
}
READERS: Final = ("each ms", "whole scans", "each 16 ms")
FAULTS: Final = ("nothing", "frames", "bytes")
_ABOUT: Final = """\
Every reading is the number of its cycle, so a scan of two is seen at once. `frames`: 16, 32 or 48 in a row are lost, or
a multiple of that; `bytes`: up to 60 ms of them, within lines too, as of a full terminal. `missed`: whole cycles that
gave no whole scan; `late`: records that call a new reading old; `lag`: the longest time from bus to `device_time_ns`.

| time stamps | lost | read | sensors | cycles | whole scans | of them mixed | torn | missed | late | lag ms |
|---|---|---|---|---|---|---|---|---|---|---|"""


class Case(NamedTuple):
    """A stream: its sensors and their rate, the clock of the stamps or None, how it is read, and what is lost."""

    stamps: str | None = None
    lost: str = "frames"
    reader: str = "each ms"
    sensors: int = 1
    rate_hz: float = 100.0

    def __str__(self) -> str:
        stamps = f"stamps {self.stamps}" if self.stamps else "no stamps"
        return f"{stamps}, {self.lost} lost, read {self.reader}, {self.sensors} at {self.rate_hz:g} Hz"


@dataclass
class Found:
    """Outcome of a case.

    Attributes:
        cycles: number sent.
        scans: number returned; torn: those without all sixteen; whole: the others.
        mixed: whole ones with readings of two cycles. A line of the head of one and the tail of another is a reading of
            neither, as the wire has no checksum.
        missed: cycles of which every byte was handed on, and no whole scan was returned.
        late: scans whose reading is called old, though it was on the bus less than 50 ms before.
        lag_ms: longest time from bus to `device_ns`, beyond which none of them may be.
    """

    cycles: int = 0
    scans: int = 0
    whole: int = 0
    torn: int = 0
    mixed: int = 0
    missed: int = 0
    late: int = 0
    lag_ms: float = 0.0


def play(case: Case, cycles: int, seed: int = 1) -> Found:
    """Play a case from the beginning, `cycles` of each sensor; its first fifty lose nothing."""
    draw = random.Random(f"{seed} {case}")
    scans, found, broken = SlcanScans(), Found(), set[tuple[int, int]]()
    whole: set[tuple[int, int]] = set()
    for data, now_s in _read(scans, case, _faulty(case, cycles, draw, broken), draw):
        for scan in scans.feed(data, round(now_s * 1e9)):
            found.scans += 1
            sensor = int(scan.sensor)
            owners = {
                x
                for taxel, (x, y, z) in enumerate(scan.counts.reshape(3, 16).T.tolist())
                if scan.fresh.flat[taxel] and y == z ^ 0x5A5A == _check(x, sensor, taxel)  # else never sent
            }
            if not scan.complete:
                found.torn += 1
                continue
            found.whole += 1
            found.mixed += len(owners) > 1
            whole |= {(sensor, cycle) for cycle in owners}
            if scan.device_ns is not None:
                bus_s = START_S + max(owners) / case.rate_hz + 16 * case.sensors * FRAME_S
                found.late += scan.time_ns - scan.device_ns > 50_000_000 and now_s - bus_s < 0.05
                found.lag_ms = max(found.lag_ms, (bus_s - scan.device_ns / 1e9) * 1e3)
    sent = {(4 + 2 * sensor, cycle) for sensor in range(case.sensors) for cycle in range(cycles)}
    found.cycles, found.missed = len(sent), len(sent - broken - whole)
    return found


def _check(cycle: int, sensor: int, taxel: int) -> int:
    mixed = cycle * 40_503 + taxel * 9_973 + sensor * 61
    return (mixed ^ mixed >> 7) & 0xFFFF


def _sent(case: Case, cycles: int, draw: random.Random) -> Iterator[tuple[float, tuple[int, int], bytes]]:
    clock = STAMPS[case.stamps] if case.stamps else None
    orders = {4 + 2 * n: USPA44_MAP.wire_order(str(4 + 2 * n)) for n in range(case.sensors)}
    for cycle in range(cycles):
        begin_s = cycle / case.rate_hz + draw.uniform(0, 0.05) / case.rate_hz
        for place in range(16):
            for lane, (sensor, order) in enumerate(orders.items()):
                time_s = START_S + begin_s + (place * case.sensors + lane + 1) * FRAME_S
                can_id, taxel = order[place]
                check = _check(cycle, sensor, taxel)
                words = (cycle, check, check ^ 0x5A5A)
                data = b"\x93" + b"".join(word.to_bytes(2, "big") for word in words) + b"\x0f"
                stamp = None if clock is None else int(clock(time_s * 1e3, draw)) % WRAP_MS
                yield time_s, (sensor, cycle), encode_frame(CanFrame(can_id, data, timestamp_ms=stamp))


def _faulty(
    case: Case, cycles: int, draw: random.Random, broken: set[tuple[int, int]]
) -> Iterator[tuple[float, bytes]]:
    left, until_s, cut = 0, 0.0, False
    for time_s, owner, line in _sent(case, cycles, draw):
        text = line
        if owner[1] >= 50 and case.lost != "nothing" and not left and time_s > until_s and draw.random() < 1 / 800:
            if case.lost == "frames":
                left = draw.choice(LOST_AT_ONCE) * (draw.choice((1, case.sensors)))
            else:
                until_s, cut = time_s + draw.uniform(0, 0.06), True
                text = line[: draw.randrange(len(line) + 1)]
        elif time_s > until_s and cut:
            cut, text = False, line[draw.randrange(len(line) + 1) :]
        elif time_s <= until_s:
            text = b""
        if left:
            left, text = left - 1, b""
        if text != line:
            broken.add(owner)
        if text:
            yield time_s, text


def _read(
    scans: SlcanScans, case: Case, lines: Iterator[tuple[float, bytes]], draw: random.Random
) -> Iterator[tuple[bytes, float]]:
    step_s = 0.016 if case.reader == "each 16 ms" else 0.001
    due_s, since_s, waiting = START_S, 0.0, b""
    for time_s, line in lines:
        if case.reader == "whole scans":  # as a reader does that sleeps until the last byte of a scan
            if waiting and time_s - since_s > 0.02:
                yield waiting, since_s + 0.02
                waiting = b""
            since_s = since_s if waiting else time_s
            waiting += line
            if len(waiting) >= scans.bytes_until_scan():
                yield waiting, time_s + draw.uniform(0.0001, 0.0008)
                waiting = b""
            continue
        if time_s > due_s:
            if waiting:
                yield waiting, due_s
            due_s, waiting = due_s + step_s * (1 + int((time_s - due_s) / step_s)), b""
        waiting += line
    if waiting:
        yield waiting, due_s + step_s


def cases() -> list[Case]:
    """Return all cases."""
    made = [Case(stamps, lost, reader) for stamps, lost, reader in product((None, *STAMPS), FAULTS, READERS)]
    made += [Case(stamps, lost, "each ms", n) for stamps in (None, "good") for lost in FAULTS for n in (2, 4)]
    made += [Case(stamps, lost, "each ms", 1, hz) for stamps in (None, "good") for lost in FAULTS for hz in (10, 400)]
    return made


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scans", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="report to write")
    parser.add_argument("words", nargs="*", metavar="WORD")
    asked = parser.parse_args()
    chosen = [case for case in cases() if all(word in str(case) for word in asked.words)]
    rows, mixed = list[str](), 0
    with ProcessPoolExecutor() as pool:
        played = [pool.submit(play, case, asked.scans // case.sensors, asked.seed) for case in chosen]
        for case, found in zip(chosen, (one.result() for one in played), strict=True):
            mixed += found.mixed
            print(f"{case}: {found}", flush=True)
            of = f"{case.sensors} at {case.rate_hz:g} Hz"
            counts = (found.cycles, found.whole, found.mixed, found.torn, found.missed, found.late)
            cells = (case.stamps or "none", case.lost, case.reader, of, *counts, f"{found.lag_ms:.0f}")
            rows.append(f"| {' | '.join(map(str, cells))} |")
    if asked.out is not None:
        command = " ".join(["python tests/support/wire_faults.py", *sys.argv[1:]])
        head = str(provenance(command, [__file__, "firmware_bridge/scans"], seed=asked.seed))
        asked.out.write_text("\n".join(["# Scans of a faulty wire", "", head, "", _ABOUT, *rows]) + "\n")
    return int(mixed > 0)


if __name__ == "__main__":
    sys.exit(main())
