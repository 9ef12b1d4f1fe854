"""Cost of the live page to the loop: the whole program without, with one and with three viewers, in turn.

    python tests/system/page_cost.py [--rounds 5] [--seconds 10]

Every scan is in contact and new, so that every scan takes an inference. In each round one program runs without a page,
and one with it, on which viewers come and go; ratios are to the first, of blocks measured next to each other.
"""

import argparse
import asyncio
import contextlib
import json
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from ratios import ratio_of

from edge.bench.program import Line, Play, Program, edge_sr
from edge.terminal.argument_types import positive, whole
from edge.terminal.progress_bar import Progress

WARM_UP_S: Final = 2.0
SETTLE_S: Final = 1.0
VIEWERS: Final = (0, 1, 3)
PLAY: Final = Play(pressed=500, moving=True)
WITHOUT: Final = "no page"
_LOOK: Final = "--look"


@dataclass
class Blocks:
    """Measurements with one number of viewers.

    Attributes:
        p50_us: medians of latencies, from a scan's last byte to its pattern, one a block, in [us].
        p99_us: their 99th percentiles.
        run_time_us: medians of the inference's run time.
        cpu_percent: processor time of the whole program, of one core.
        late: patterns that were ready later than a period after their scan.
        frames_hz: result frames a second that each viewer got.
    """

    p50_us: list[float] = field(default_factory=list)
    p99_us: list[float] = field(default_factory=list)
    run_time_us: list[float] = field(default_factory=list)
    cpu_percent: list[float] = field(default_factory=list)
    late: int = 0
    frames_hz: list[float] = field(default_factory=list)

    def measure(self, program: Program, seconds: float) -> None:
        """Add a block of so long."""
        before_s = sum(program.thread_cpu_s().values())
        lines = program.lines(seconds)
        self.cpu_percent.append((sum(program.thread_cpu_s().values()) - before_s) / seconds * 100)
        latencies = _of(lines, "latency_us")
        self.p50_us.append(float(np.quantile(latencies, 0.5)))
        self.p99_us.append(float(np.quantile(latencies, 0.99)))
        self.run_time_us.append(float(np.median(_of(lines, "run_time_us"))))
        self.late += lines[-1].record["counters"]["late"] - lines[0].record["counters"]["late"]


def measured(rounds: int, seconds: float) -> dict[str, Blocks]:
    """Return the blocks by number of viewers."""
    names = [WITHOUT, *map(_name, VIEWERS)]
    blocks = {name: Blocks() for name in names}
    with Progress("the live page", rounds * len(names), "block") as bar:
        for _ in range(rounds):
            with _running() as program:
                blocks[WITHOUT].measure(program, seconds)
            bar.advance()
            port = free_port()
            with _running("--view", str(port)) as program:
                for viewers in VIEWERS:
                    with _looking(port, viewers, blocks[_name(viewers)], seconds):
                        program.lines(SETTLE_S)
                        blocks[_name(viewers)].measure(program, seconds)
                    bar.advance()
    return blocks


def table(blocks: dict[str, Blocks]) -> str:
    """Return medians of blocks, and ratios to no page with 95 % intervals."""
    lines = [
        "| page | latency p50 us | p99 us | run time p50 us | CPU % | late | frames /s | p50, ratio | p99, ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, block in blocks.items():
        figures = (block.p50_us, block.p99_us, block.run_time_us)
        cells = [f"{np.median(values):.0f}" for values in figures]
        frames = f"{np.mean(block.frames_hz):.1f}" if block.frames_hz else "-"
        below = blocks[WITHOUT]
        ratios = [
            ratio_of(over, under, paired=True)
            for over, under in ((block.p50_us, below.p50_us), (block.p99_us, below.p99_us))
        ]
        cells += [f"{np.median(block.cpu_percent):.1f}", str(block.late), frames, *map(str, ratios)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _name(viewers: int) -> str:
    return f"{viewers} viewers" if viewers != 1 else "1 viewer"


def _of(lines: Sequence[Line], key: str) -> list[float]:
    return [line.record[key] for line in lines if line.record[key] is not None]


@contextlib.contextmanager
def _running(*options: str) -> Iterator[Program]:
    with tempfile.TemporaryDirectory() as folder, edge_sr(Path(folder), PLAY, "--every-scan", *options) as program:
        program.lines(WARM_UP_S)
        yield program


def free_port() -> int:
    """Return a port without a listener."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@contextlib.contextmanager
def _looking(port: int, viewers: int, block: Blocks, seconds: float) -> Iterator[None]:
    """Run viewers in a process of their own for the length of the block."""
    if not viewers:
        yield
        return
    command = [sys.executable, __file__, _LOOK, str(port), str(viewers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            told = process.communicate()[0]
        # They looked a little longer than was measured, while they came.
        frames, looked_s = json.loads(told)
        block.frames_hz.append(frames / viewers / looked_s)


async def _look(port: int, viewers: int) -> None:
    """Read whatever comes, as many times, until SIGTERM; then tell how many result frames came, in how long."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    loop = asyncio.get_running_loop()
    frames, start_s = 0, loop.time()

    async def look() -> None:
        nonlocal frames
        with contextlib.suppress(ConnectionClosed):
            async with connect(f"ws://127.0.0.1:{port}/ws", compression=None) as viewer:
                async for message in viewer:
                    frames += b'"kind":"result"' in message if isinstance(message, bytes) else 0

    looking = asyncio.gather(*(look() for _ in range(viewers)))
    loop.add_signal_handler(signal.SIGTERM, looking.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await looking
    sys.stdout.write(json.dumps([frames, loop.time() - start_s]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; returns an exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == [_LOOK]:
        asyncio.run(_look(int(arguments[1]), int(arguments[2])))
        return 0
    parser = argparse.ArgumentParser(
        prog="python tests/system/page_cost.py", description="What the live page costs the loop."
    )
    parser.add_argument("--rounds", metavar="N", type=whole(1), default=5, help="of all blocks (default 5)")
    parser.add_argument("--seconds", metavar="T", type=positive, default=10.0, help="a block (default 10)")
    options = parser.parse_args(arguments)
    sys.stdout.write(table(measured(options.rounds, options.seconds)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
