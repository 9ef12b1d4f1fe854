"""Many emulated sensors over zenoh into one process: latency, loss, and what it costs.

    python tests/system/zenoh_load.py [--sensors 32] [--out DIR]

Exit code 1 where it cannot be measured, 130 where Ctrl-C ended it: then nothing is written.
"""

import argparse
import json
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.bench.contenders import FROZEN_FILE
from edge.bench.errors import BenchError
from edge.bench.live_report import Page, head, line
from edge.bench.provenance import provenance
from edge.errors import EdgeError
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.change_gate import NOISE_COUNTS
from edge.perception.contact_options import RuntimeOptions
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.pipeline.scan_reader import Source
from edge.sinks.binary_message import unpack
from edge.sinks.zenoh import ZenohSink
from edge.terminal.argument_types import positive, whole
from firmware_bridge.extras import how_to_install
from firmware_bridge.links.base import Link
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import Scan, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline

PERIOD_NS: Final = 10_000_000
HELD_SCANS: Final = 100
REST: Final = np.full(USPA44.scan_shape, 20_000, dtype=np.int32)
SEED: Final = 1
APART_SCANS: Final = 97
"""Scans by which each sensor is ahead of the one before it in the same stream."""
SETTLE_S: Final = 1.0
PATIENCE_S: Final = 60.0
KEY: Final = "bench"
INTERRUPTED: Final = 130
_SETUPS: Final = {"whole": "runtime and zenoh", "alone": "zenoh alone"}
_COLUMNS: Final = (
    *("what runs", "scans a second", "patterns a second", "MB/s", "scan p50 ms", "p99", "max"),
    *(
        "pattern p50 ms",
        "p99",
        "max",
        "dropped %",
        "scans lost %",
        "patterns lost %",
        "CPU % writers",
        "CPU % consumer",
    ),
)
_TEXT: Final = """\
{sensors} emulated sensors at 100 Hz in {processes} processes of `--sink zenoh:` each with its own session over loopback
TCP, and one process that subscribes to all and reads each message's header. Taps of the frozen test set are pressed,
held and let go; a pattern is made of every scan in contact, as with `--every-scan`. Latency is from a scan's `time_ns`
to the message in the consumer's hands; with the runtime it holds the inference. "dropped" are scans that got no pattern
since a newer one was there: our doing, not zenoh's. Lost is what was written and did not come. Beside "zenoh alone" the
results were made before, and only their records now. Median of {runs} runs of {seconds:g} s, least to most in
brackets; CPU in % of one core."""


class PacedLink(Link):
    """Link with a scan of each of its sensors every 10 ms, taken from a stream in a circle."""

    def __init__(self, scans: Sequence[Scan], sensors: Sequence[str], ticks: int) -> None:
        """Set up the link; it begins at its first read, and each sensor is elsewhere in the stream."""
        self.name, self.kind, self.ended = "bench", "emulated", False
        self._scans, self._sensors, self._ticks = scans, sensors, ticks
        self._tick = 0
        self._start_ns: int | None = None

    def __enter__(self) -> "PacedLink":
        return self

    def __exit__(self, *exc_info: object) -> None:
        pass

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans of the next tick."""
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        due_ns = self._start_ns + self._tick * PERIOD_NS
        time.sleep(max(due_ns - time.monotonic_ns(), 0) / 1e9)
        shown = [
            self._scans[(self._tick + APART_SCANS * index) % len(self._scans)] for index in range(len(self._sensors))
        ]
        given = [
            replace(scan, sensor=sensor, number=self._tick, time_ns=time.monotonic_ns())
            for scan, sensor in zip(shown, self._sensors, strict=True)
        ]
        self._tick += 1
        self.ended = self._tick == self._ticks
        return given

    def counters(self) -> dict[str, int]:
        """Return the number of scans."""
        return {"scans": self._tick * len(self._sensors)}


def taps(frozen: FrozenSet) -> list[Scan]:
    """Return scans of every fourth tap of the test set, its end held for a second, with a second of rest after it."""
    series, rng, scans = ScanSeries("4", USPA44), np.random.default_rng(SEED), []
    for tap in range(0, len(frozen.touched), 4):
        frames = frozen.newest[frozen.tap == tap]
        held, rest = np.repeat(frames[-1:], HELD_SCANS, axis=0), np.zeros((HELD_SCANS, *REST.shape))
        for zeroed in (*frames, *held, *rest):
            counts = np.rint(zeroed + NOISE_COUNTS * rng.standard_normal(REST.shape)).astype(np.int32)
            scans.append(series.close(REST + counts, len(scans) * PERIOD_NS))
    return scans


def write(pipe: Connection, setup: str, endpoint: str, sensors: list[str], ticks: int) -> None:
    """Write in a process of its own: report when it is ready, wait for a word, and report what was written."""
    model = ModelSession(find_model(DEFAULT_MODEL))
    scans = taps(load_frozen_set(FROZEN_FILE))
    rest, now_s = REST.astype(np.float32), time.time()
    baselines = {name: Baseline.of(name, rest, created_unix_s=now_s, scans=100, origin="file") for name in sensors}
    runtime = Runtime(model, source="emulated", baselines=baselines, options=RuntimeOptions(every_scan=True))
    sink = ZenohSink(f"{KEY}?connect={endpoint}")
    made = [] if setup == "whole" else _made(runtime, scans[: ticks + APART_SCANS * len(sensors)], sensors)
    pipe.send("ready")
    pipe.recv()
    cpu_s, written, patterns, dropped = time.process_time(), 0, 0, 0
    if setup == "whole":
        with Source(PacedLink(scans, sensors, ticks)) as source:
            results = Stream(source, runtime)
            for result in results:
                sink.write(result, results.counters)
                written, patterns = written + 1, patterns + (result.pattern is not None)
            dropped = results.statistics.dropped
    else:
        for result in _paced(made, sensors, ticks):
            sink.write(result, {})
            written, patterns = written + 1, patterns + (result.pattern is not None)
    sink.close()
    cpu_s = time.process_time() - cpu_s
    pipe.send({"written": written, "patterns": patterns, "dropped": dropped, "cpu_s": cpu_s})


def _made(runtime: Runtime, scans: Sequence[Scan], sensors: Sequence[str]) -> list[Result]:
    return [runtime.push(replace(scan, sensor=sensors[0])) for scan in scans]


def _paced(made: Sequence[Result], sensors: Sequence[str], ticks: int) -> Iterator[Result]:
    start_ns = time.monotonic_ns()
    for tick in range(ticks):
        time.sleep(max(start_ns + tick * PERIOD_NS - time.monotonic_ns(), 0) / 1e9)
        for index, sensor in enumerate(sensors):
            result = made[(tick + APART_SCANS * index) % len(made)]
            scan = replace(result.scan, sensor=sensor, number=tick, time_ns=time.monotonic_ns())
            yield replace(result, scan=scan)


def consume(pipe: Connection, endpoint: str) -> None:
    """Read everything in a process of its own, and report what came on demand."""
    import zenoh

    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    latencies_us: dict[str, list[float]] = {"scan": [], "pattern": []}
    received = [0]

    def take(sample: zenoh.Sample) -> None:
        message, now_ns = sample.payload.to_bytes(), time.monotonic_ns()
        what = str(sample.key_expr).rpartition("/")[2]
        header = unpack(message)[0] if what == "pattern" else json.loads(message)
        latencies_us[what].append((now_ns - header["time_ns"]) / 1e3)
        received[0] += len(message)

    with zenoh.open(config) as session:
        session.declare_subscriber(f"{KEY}/**", take)
        pipe.send("ready")
        pipe.recv()
        cpu_s = time.process_time()
        pipe.recv()
        cpu_s = time.process_time() - cpu_s
    pipe.send({"latencies_us": latencies_us, "bytes": received[0], "cpu_s": cpu_s})


def run(setup: str, sensors: int, processes: int, seconds: float) -> tuple[float, ...]:
    """Measure once, and return the figures in the order of the table.

    Raises:
        BenchError: a process ended before its time.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    context, ticks = multiprocessing.get_context("spawn"), round(seconds * 1e9 / PERIOD_NS)
    names = [f"hand{index // 8}/{index % 8}" for index in range(sensors)]
    shares = [names[index::processes] for index in range(processes)]
    jobs = [(consume, (endpoint,)), *((write, (setup, endpoint, share, ticks)) for share in shares)]
    pipes: list[Connection] = []
    children: list[Any] = []
    try:
        for target, arguments in jobs:  # the consumer first: nothing is to be lost for want of one
            here, there = context.Pipe()
            child = context.Process(target=target, args=(there, *arguments), daemon=True)
            with _interrupts_held_back():
                child.start()
            there.close()
            pipes.append(here)
            children.append(child)
            _told(here, PATIENCE_S)
        time.sleep(SETTLE_S)
        for pipe in pipes:
            pipe.send("go")
        wrote = [_told(pipe, 4 * seconds + PATIENCE_S) for pipe in pipes[1:]]
        time.sleep(SETTLE_S)
        pipes[0].send("end")
        got = _told(pipes[0], PATIENCE_S)
        for child in children:
            child.join(5)
    finally:
        for child in children:
            child.kill()
    return _figures(wrote, got, seconds)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Hold Ctrl-C back from processes that begin now; they end on a command, or when they are killed."""
    resource_tracker.ensure_running()  # where the first process starts it, it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _told(pipe: Connection, within_s: float) -> Any:
    try:
        if pipe.poll(within_s):
            return pipe.recv()
    except EOFError as error:
        raise BenchError("a process ended before it told anything") from error
    raise BenchError(f"a process told nothing for {within_s:.0f} s")


def _figures(wrote: Sequence[dict[str, Any]], got: dict[str, Any], seconds: float) -> tuple[float, ...]:
    written, patterns, dropped = (sum(one[name] for one in wrote) for name in ("written", "patterns", "dropped"))
    scan_ms, pattern_ms = (np.asarray(got["latencies_us"][what]) / 1e3 for what in ("scan", "pattern"))
    if not len(scan_ms) or not len(pattern_ms):
        raise BenchError("nothing came")
    return (
        *(written / seconds, patterns / seconds, got["bytes"] / 1e6 / seconds),
        *np.percentile(scan_ms, [50, 99, 100]).tolist(),
        *np.percentile(pattern_ms, [50, 99, 100]).tolist(),
        *(100 * dropped / written, 100 * (1 - len(scan_ms) / written), 100 * (1 - len(pattern_ms) / patterns)),
        *(100 * sum(one["cpu_s"] for one in wrote) / seconds, 100 * got["cpu_s"] / seconds),
    )


def _cell(values: Sequence[float]) -> str:
    digits = 0 if max(values) >= 100 else 2
    low, middle, high = min(values), float(np.median(values)), max(values)
    return f"{middle:.{digits}f}" if low == high else f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 0 when done, 1 on a clear error, 130 when interrupted."""
    parser = argparse.ArgumentParser(
        prog="python tests/system/zenoh_load.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--sensors", type=whole(1), default=32, metavar="N", help="in all (default 32)")
    parser.add_argument("--processes", type=whole(1), default=4, metavar="N", help="that write (default 4)")
    parser.add_argument("--seconds", type=positive, default=20.0, metavar="T", help="of a run (default 20)")
    parser.add_argument("--runs", type=whole(1), default=3, metavar="N", help="of each row (default 3)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write zenoh.md there")
    options = parser.parse_args(arguments)
    if options.processes > options.sensors:
        parser.error(f"{options.processes} processes for {options.sensors} sensors: expected no more")
    os.environ["OMP_NUM_THREADS"] = "1"
    page = Page(sys.stdout, sys.stderr)
    asked = vars(options)
    command = " ".join(f"--{name} {asked[name]:g}" for name in ("sensors", "processes", "seconds", "runs"))
    try:
        zenoh_version = version("eclipse-zenoh")
        if options.out is not None:  # detected before minutes are spent
            options.out.mkdir(parents=True, exist_ok=True)
        command = f"python tests/system/zenoh_load.py {command}"
        made = provenance(command, [__file__], [find_model(DEFAULT_MODEL), FROZEN_FILE])
        page.say(f"# zenoh\n\n{made}\n\nWith zenoh {zenoh_version}.\n")
        page.say(f"{_TEXT.format(**asked)}\n\n{head(_COLUMNS)}")
        runs: dict[str, list[tuple[float, ...]]] = {setup: [] for setup in _SETUPS}
        for setup in page.tracked([one for one in _SETUPS for _ in range(options.runs)], "zenoh", "run"):
            page.progress(_SETUPS[setup])
            runs[setup].append(run(setup, options.sensors, options.processes, options.seconds))
            if len(runs[setup]) == options.runs:
                page.say(line([_SETUPS[setup], *(_cell(column) for column in zip(*runs[setup], strict=True))]))
    except PackageNotFoundError:
        sys.stderr.write(f"zenoh: needs eclipse-zenoh: {how_to_install('zenoh')}\n")
        return 1
    except (EdgeError, OSError) as error:
        sys.stderr.write(f"zenoh: {error}\n")
        return 1
    except KeyboardInterrupt:
        page.warn("zenoh stopped before its end")
        return INTERRUPTED
    if options.out is not None:
        (options.out / "zenoh.md").write_text("\n".join(page.lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
