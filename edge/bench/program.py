"""The whole program in a process of its own, an emulated sensor in another, watched from outside; on Linux."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.bench.errors import BenchError
from edge.pipeline.pump import uncollected
from firmware_bridge.recording.formats import NPZ_FORMAT, NPZ_VERSION
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

SEED: Final = 0
CONTROLLERS: Final = ("4", "6")
"""Names of the sensors."""
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
_SCANS: Final = 500
_ROOT: Final = Path(__file__).parents[2]
_MAPS: Final = b',"pattern":'
_PLAIN_LOOP: Final = """
import sys, time, serial
port = serial.Serial(sys.argv[1], 3_000_000, rtscts=True, timeout=0.1)
for command in (b"C\\r", b"S8\\r", b"O\\r"):
    port.write(command)
    time.sleep(0.05)
while True:
    port.read(port.in_waiting or 1)
"""


@dataclass(frozen=True, slots=True)
class Play:
    """Scans that emulated sensors on one bus play.

    Attributes:
        rate_hz: scans a second of each, in [Hz].
        sensors: 1 or 2.
        pressed: of 500 scans, the number in contact; the others come first.
        moving: the contact moves, so that each scan differs from the one before.
    """

    rate_hz: float = 100.0
    sensors: int = 1
    pressed: int = 0
    moving: bool = False

    @property
    def frame_us(self) -> float:
        """Time of a frame, in [us]: as on a bus of 1 Mbit/s, or as little as the rate leaves."""
        return min(130.0, 0.5e6 / (16 * self.sensors * self.rate_hz))


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
        if self._process.stdout is None:
            raise ValueError("the program's stdout is not a pipe")
        got: list[tuple[int, bytes]] = []
        end_ns = time.monotonic_ns() + int(seconds * 1e9)
        now_ns = 0
        while now_ns < end_ns and (most is None or len(got) < most):
            line = self._process.stdout.readline()
            now_ns = time.monotonic_ns()
            if not line:
                raise BenchError(f"edge-sr ended with {self._process.wait()} while it was measured")
            # Parsing waits until the end: it would take the program's processor time away. An event has no maps.
            head, maps, _ = line.partition(_MAPS)
            if maps:
                got.append((now_ns, head + b"}"))
        return [Line(time_ns, json.loads(head)) for time_ns, head in got]

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
        times: dict[str, list[int]] = {name: [] for name in CONTROLLERS}
        for line in self._stamps.read_text().splitlines():
            controller, time_ns = line.split()
            times[controller].append(int(time_ns))
        return times


@contextmanager
def plain_loop(folder: Path, play: Play) -> Iterator[Program]:
    """Run a program that reads the same bytes with pyserial and does nothing with them."""
    with _emulator(folder, play) as (port, stamps), _process(["-c", _PLAIN_LOOP, port], stamps) as program:
        yield program


@contextmanager
def edge_sr(folder: Path, play: Play, *options: str, sink: str = "jsonl:-") -> Iterator[Program]:
    """Run `edge-sr` with stored baselines; its files lie in `folder` meanwhile."""
    with _emulator(folder, play) as (port, stamps):
        command = ["-m", "edge.cli.main", "--source", f"slcan:{port}", "--baseline", str(folder / "zero.json")]
        with _process([*command, "--sink", sink, *options], stamps) as program:
            yield program


@contextmanager
def _emulator(folder: Path, play: Play) -> Iterator[tuple[str, Path]]:
    stamps = folder / "stamps.txt"
    files = [_recording(folder, play, sensor) for sensor in range(play.sensors)]
    rest = _rest_counts().astype(np.float32)
    save_baselines(folder / "zero.json", [Baseline.of(name, rest, time.time(), 100, "file") for name in CONTROLLERS])
    options = ["--loop", "--rate-hz", str(play.rate_hz), "--frame-us", str(play.frame_us), "--stamps", str(stamps)]
    with emulating(*options, *map(str, files)) as port:
        yield port, stamps


@contextmanager
def emulating(*arguments: str, program: Sequence[str] = EMULATOR) -> Iterator[str]:
    """Run an emulator with these arguments in a process of its own, and yield its port.

    Raises:
        BenchError: the emulator did not start.
    """
    command = [sys.executable, *program, "--until-stdin-closes", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment(), start_new_session=True
    ) as emulator:
        try:
            port = emulator.stdout.readline().decode().strip() if emulator.stdout else ""
            if not port:
                raise BenchError("the emulator did not start")
            yield port
        finally:
            if emulator.stdin:
                emulator.stdin.close()


@contextmanager
def _process(arguments: Sequence[str], stamps: Path) -> Iterator[Program]:
    with uncollected():  # or a pause of our own collector would count as the program's
        spawned_ns = time.monotonic_ns()
        with subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),
            start_new_session=True,
        ) as process:
            try:
                yield Program(process, spawned_ns, stamps)
            finally:
                process.kill()  # its last records are of no interest


def environment() -> dict[str, str]:
    """Return the environment for processes of the program's own parts."""
    # The child imports the same packages as this process, however they were located.
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])}


def _rest_counts() -> NDArray[np.int64]:
    return np.asarray(REST_COUNTS)[:, None, None] + 37 * np.arange(16).reshape(4, 4)


def _recording(folder: Path, play: Play, sensor: int) -> Path:
    rng = np.random.default_rng([SEED, sensor])
    counts = _rest_counts() + rng.integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (_SCANS, 3, 4, 4))
    turn = 2 * np.pi * np.arange(_SCANS) / 100 * play.moving
    row, col = (1.5 + np.array([np.sin(turn), np.cos(turn)]))[:, :, None, None]
    rows, cols = np.indices((4, 4))
    press = np.rint(PRESS_COUNTS * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 2)).astype(int)
    press[: _SCANS - play.pressed] = 0
    counts[:, 2] += press
    path = folder / f"played{sensor}.npz"
    np.savez(
        path,
        format=np.array(NPZ_FORMAT),
        version=np.array(NPZ_VERSION),
        sensor=np.array([CONTROLLERS[sensor]] * _SCANS),
        scan=np.arange(_SCANS),
        time_ns=np.arange(_SCANS) * 10_000_000,
        counts=counts.astype(np.int32),
    )
    return path
