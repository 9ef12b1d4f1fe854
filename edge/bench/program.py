"""The whole program in a process of its own, an emulated sensor in another, watched from outside; on Linux."""

import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.bench.errors import BenchError
from edge.pipeline.pump import uncollected
from firmware_bridge.recording.npz_recording import NPZ_FORMAT, NPZ_VERSION
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

SEED: Final = 0
CONTROLLERS: Final = ("4", "6", "8", "10")
"""Names of the sensors on a bus."""
FINGERS: Final = CONTROLLERS[:2]
"""Names of two of them."""
SENSORS_PER_BUS: Final = 4
"""Most sensors on one bus: at 1 Mbit/s it carries 480 scans a second."""
FRAME_US: Final = 130.0
"""Time of a frame on a bus of 1 Mbit/s, in [us]."""
FULL_BUS: Final = 0.9
"""Share of the time that frames may take on a bus."""
REST_COUNTS: Final = (16_000, 16_400, 38_600)
PRESS_COUNTS: Final = 3000
NOISE_COUNTS: Final = 3
EMULATOR: Final = ("-m", "firmware_bridge.emulation.slcan_main")
"""Arguments of Python that run the emulator."""
PROGRAM_SOURCES: Final = (
    "edge/__main__.py",
    "edge/cli/run_command.py",
    "edge/perception/runtime.py",
    "edge/pipeline/link_reader.py",
    "edge/pipeline/result_stream.py",
    "firmware_bridge/links/reconnecting.py",
    "firmware_bridge/scans/scan_assembler.py",
)
"""Sources of a report on the whole program: they import most of what a run executes."""
Emulate = Callable[..., AbstractContextManager[list[str]]]
"""Function from the arguments of emulators and the number of buses to their ports, within a with statement."""
_SCANS: Final = 500
_ROOT: Final = Path(__file__).parents[2]
_MAPS: Final = b',"pattern":'
_PLAIN_LOOP: Final = """
import os, select, sys, time, serial
poll, ports = select.poll(), [serial.Serial(name, 3_000_000, rtscts=True, timeout=0.1) for name in sys.argv[1:]]
for port in ports:
    for command in (b"C\\r", b"S8\\r", b"Z1\\r", b"O\\r"):
        port.write(command)
        time.sleep(0.05)
    poll.register(port.fileno(), select.POLLIN)
while True:
    for descriptor, _ in poll.poll():
        os.read(descriptor, 4096)
"""


@dataclass(frozen=True, slots=True)
class Play:
    """Scans that emulated sensors play, up to four on each bus.

    Attributes:
        rate_hz: scans a second of each, in [Hz].
        sensors: number of sensors.
        pressed: of 500 scans, the number in contact; the others come first.
        moving: the contact moves, so that each scan differs from the one before.
        touched: number of sensors that are ever in contact, spread over the buses; None for all.
        waits: the adapter waits for a reader that is late, rather than lose frames.
    """

    rate_hz: float = 100.0
    sensors: int = 1
    pressed: int = 0
    moving: bool = False
    touched: int | None = None
    waits: bool = False

    @property
    def buses(self) -> int:
        """Number of buses, each with an adapter of its own."""
        return -(-self.sensors // SENSORS_PER_BUS)

    def names(self, bus: int) -> tuple[str, ...]:
        """Return the names of the sensors on a bus, as records have them."""
        return tuple(self.prefix(bus) + name for name in CONTROLLERS[: len(range(bus, self.sensors, self.buses))])

    def prefix(self, bus: int) -> str:
        """Return the beginning of the names of the sensors on a bus."""
        return "" if self.buses == 1 else f"bus{bus}/"

    @property
    def touching(self) -> range:
        """Numbers of the sensors that are ever in contact."""
        return range(self.sensors)[: self.touched]

    @property
    def frame_us(self) -> float:
        """Time between frames of a sensor, in [us]: as on a shared bus of 1 Mbit/s, or as little as the rate leaves."""
        frame_us, period_us = FRAME_US * len(self.names(0)), 1e6 / self.rate_hz
        return frame_us if 16 * frame_us < FULL_BUS * period_us else period_us / 32


@dataclass(frozen=True, slots=True)
class Line:
    """Record with the time of its arrival, in [ns], and its values before the maps."""

    time_ns: int
    record: dict[str, Any]


class Program:
    """Process that reads emulated sensors, and its records where it writes any."""

    def __init__(self, process: subprocess.Popen[bytes], spawned_ns: int, stamps: Path) -> None:
        self.spawned_ns = spawned_ns
        self._process = process
        self._stamps = stamps
        self._folder = Path(f"/proc/{process.pid}")

    def lines(self, seconds: float, most: int | None = None) -> list[Line]:
        """Return the records of so long, or at most so many.

        Raises:
            BenchError: the program ended.
        """
        return parsed(self.heads(seconds, most))

    def heads(self, seconds: float, most: int | None = None) -> list[tuple[int, bytes]]:
        """Return the same with their times in [ns] and not parsed, which would take the program's processor away.

        Raises:
            BenchError: the program ended.
        """
        got: list[tuple[int, bytes]] = []
        for time_ns, line in self._read(seconds):
            head, maps, _ = line.partition(_MAPS)  # an event has no maps
            if maps:
                got.append((time_ns, head + b"}"))
                if len(got) == most:
                    break
        return got

    def skip(self, seconds: float) -> None:
        """Read the records of so long and forget them: a pause to parse them would fill the pipe.

        Raises:
            BenchError: the program ended.
        """
        for _ in self._read(seconds):
            pass

    def _read(self, seconds: float) -> Iterator[tuple[int, bytes]]:
        """Yield what the program writes for so long, line by line, with the time of arrival in [ns]."""
        if self._process.stdout is None:
            raise ValueError("the program's stdout is not a pipe")
        end_ns = time.monotonic_ns() + int(seconds * 1e9)
        now_ns = 0
        while now_ns < end_ns:
            line = self._process.stdout.readline()
            now_ns = time.monotonic_ns()
            if not line:
                raise BenchError(f"edge-sr ended with {self._process.wait()} while it was measured")
            yield now_ns, line

    def first_pattern_s(self) -> float:
        """Return the time from its spawn to the record of its first pattern, in [s]."""
        while True:
            line = self.lines(60.0, most=1)[0]
            if line.record["state"] == "contact":
                return (line.time_ns - self.spawned_ns) / 1e9

    def thread_cpu_s(self) -> dict[str, float]:
        """Return the processor time of each of its threads, as the scheduler counts it, in [s]."""
        tasks = (self._folder / "task").iterdir()
        return {task.name: int((task / "schedstat").read_text().split()[0]) / 1e9 for task in tasks}

    def preemptions(self) -> int:
        """Count the times that one of its threads lost its processor against its will."""
        texts = [(task / "status").read_text() for task in (self._folder / "task").iterdir()]
        return sum(int(text.rpartition("nonvoluntary_ctxt_switches:")[2]) for text in texts)

    def resident_mb(self) -> float:
        """Return its resident memory, in [MB]."""
        return int((self._folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def threads_and_descriptors(self) -> tuple[int, int]:
        """Return the numbers of its threads and of its open descriptors."""
        return len(list((self._folder / "task").iterdir())), len(list((self._folder / "fd").iterdir()))

    def stamps_ns(self) -> dict[str, list[int]]:
        """Return the time of the last byte of each scan, by sensor, once the emulator has ended, in [ns]."""
        times: dict[str, list[int]] = defaultdict(list)
        for line in self._stamps.read_text().splitlines():
            sensor, time_ns = line.split()
            times[sensor].append(int(time_ns))
        return times


def parsed(heads: Iterable[tuple[int, bytes]]) -> list[Line]:
    """Return records of `Program.heads`, each with the counters up to it, which only some have."""
    lines = [Line(time_ns, json.loads(head)) for time_ns, head in heads]
    counters = next((line.record["counters"] for line in lines if "counters" in line.record), {})
    for line in lines:
        counters = line.record.setdefault("counters", counters)
    return lines


@contextmanager
def emulating(*arguments: str, buses: int = 1, program: Sequence[str] = EMULATOR) -> Iterator[list[str]]:
    """Run emulators with these arguments in a process of their own, and yield the port of each bus.

    Raises:
        BenchError: the emulators did not start.
    """
    command = [sys.executable, *program, "--until-stdin-closes", "--buses", str(buses), *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment(), start_new_session=True
    ) as emulator:
        try:
            ports = [emulator.stdout.readline().decode().strip() if emulator.stdout else "" for _ in range(buses)]
            if not all(ports):
                raise BenchError("the emulator did not start")
            yield ports
        finally:
            if emulator.stdin:
                emulator.stdin.close()


@contextmanager
def plain_loop(folder: Path, play: Play) -> Iterator[Program]:
    """Run a program that reads the same bytes by poll and os.read, on pyserial's port, and decodes nothing."""
    with (
        _emulators(folder, play, emulating) as (ports, stamps),
        _process(["-c", _PLAIN_LOOP, *ports], stamps) as program,
    ):
        yield program


@contextmanager
def edge_sr(
    folder: Path,
    play: Play,
    *options: str,
    sink: str = "jsonl:-",
    cores: Collection[int] = (),
    emulate: Emulate = emulating,
) -> Iterator[Program]:
    """Run `edge-sr` with stored baselines; its files lie in `folder`.

    Args:
        folder: for all files.
        play: what it reads.
        options: further ones of edge-sr.
        sink: of the records.
        cores: the only ones that it may use; any without.
        emulate: runs the emulators.
    """
    with _emulators(folder, play, emulate) as (ports, stamps):
        command = ["-m", "edge.cli.main", "--baseline", str(folder / "zero.json"), "--sink", sink]
        for bus, port in enumerate(ports):
            command += ["--source", f"slcan:{port}" if play.buses == 1 else f"bus{bus}=slcan:{port}"]
        with _process([*command, *options], stamps, cores) as program:
            yield program


@contextmanager
def _emulators(folder: Path, play: Play, emulate: Emulate) -> Iterator[tuple[list[str], Path]]:
    """Run the emulators of all buses; yields the ports, and the file with the times of all scans."""
    names = [name for bus in range(play.buses) for name in play.names(bus)]
    rest = _rest_counts().astype(np.float32)
    save_baselines(folder / "zero.json", [Baseline.of(name, rest, time.time(), 100, "file") for name in names])
    stamps = folder / "stamps.txt"
    played = [_recording(folder, play, number, CONTROLLERS[number // play.buses]) for number in range(play.sensors)]
    options = ["--loop", "--rate-hz", str(play.rate_hz), "--frame-us", str(play.frame_us), "--stamps", str(stamps)]
    options += ["--waits"] if play.waits else []
    with emulate(*options, *map(str, played), buses=play.buses) as ports:
        yield ports, stamps


@contextmanager
def _process(arguments: Sequence[str], stamps: Path, cores: Collection[int] = ()) -> Iterator[Program]:
    with uncollected(), _held_to(cores) as held:  # or a pause of our own collector would count as the program's
        spawned_ns = time.monotonic_ns()
        with subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),
            start_new_session=True,
        ) as process:
            held.close()
            try:
                yield Program(process, spawned_ns, stamps)
            finally:
                process.kill()  # its last records are of no interest


@contextmanager
def _held_to(cores: Collection[int]) -> Iterator[ExitStack]:
    """Hold processes that are started from here on to some cores, until the stack is closed; to any without cores."""
    with ExitStack() as held:
        if cores:
            held.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
            os.sched_setaffinity(0, cores)
        yield held


def environment() -> dict[str, str]:
    """Return the environment for processes of the program's own parts."""
    # The child imports the same packages as this process, however they were located; their bytecode is kept, as that
    # of an installed program is, or each start would compile them.
    paths = os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": ""}


def _rest_counts() -> NDArray[np.int64]:
    return np.asarray(REST_COUNTS)[:, None, None] + 37 * np.arange(16).reshape(4, 4)


def _recording(folder: Path, play: Play, number: int, name: str) -> Path:
    rng = np.random.default_rng([SEED, number])
    counts = _rest_counts() + rng.integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (_SCANS, 3, 4, 4))
    turn = 2 * np.pi * np.arange(_SCANS) / 100 * play.moving
    row, col = (1.5 + np.array([np.sin(turn), np.cos(turn)]))[:, :, None, None]
    rows, cols = np.indices((4, 4))
    press = np.rint(PRESS_COUNTS * np.exp(-2 * ((rows - row) ** 2 + (cols - col) ** 2))).astype(int)  # local: no drift
    press[: _SCANS - (play.pressed if number in play.touching else 0)] = 0
    counts[:, 2] += press
    path = folder / f"played{number}.npz"
    np.savez(
        path,
        format=np.array(NPZ_FORMAT),
        version=np.array(NPZ_VERSION),
        sensor=np.array([name] * _SCANS),
        scan=np.arange(_SCANS),
        time_ns=np.arange(_SCANS) * 10_000_000,
        counts=counts.astype(np.int32),
    )
    return path
