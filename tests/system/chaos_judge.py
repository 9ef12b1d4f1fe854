"""Judge of the records of a run among faults, by what was sent: each reading tells its taxel and cycle."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np
from chaos_wire import FaultyBus, Sent
from numpy.typing import NDArray
from program_cost import REST_COUNTS, away_from_press

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
