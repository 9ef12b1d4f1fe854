"""Compare the processor time of a scan's way, from bytes to its record, with that of an earlier commit.

    python tests/system/hot_path.py [COMMIT]

Both trees run in turn, block by block, each in a process of its own that reads the same bytes: without contact, and in
a contact in which every scan gets a pattern. Blocks are measured by the time that the processor spent on the process,
so that waiting for other work of the machine does not count. Both processes share one core, since a neighbour on the
other one would slow the one that runs there, and the least block of a process counts, since a neighbour only adds to
it. A process also has a speed of its own, by where its memory lies, so several pairs of them are measured.

The exit code is 1 if the way takes over a tenth longer than at COMMIT, by default the commit before; a commit that
cannot be run, since the interface has changed or the clone is shallow, is reported and ends with 0.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from program_cost import CostError, Ratio, ratio_of, tree_of

ROOT: Final = Path(__file__).parents[2]
PAIRS: Final = 6
BLOCKS: Final = 10
SCANS: Final = {"at rest": 200, "in contact": 40}
"""Scans of a block: some 20 ms in both parts."""
WARM_BLOCKS: Final = 2


class ChildError(Exception):
    """A tree whose way of a scan cannot be run as this one's."""


class Child:
    """Process that runs the way of a scan as it is in one tree."""

    def __init__(self, tree: Path, core: int) -> None:
        """Start it on a core; the caller calls `close`."""
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--child", str(core)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tree,
            env=os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
        )

    def block_us(self, part: str) -> float:
        """Return the processor time of a block, for each of its scans, in [us]; raises ChildError if it ended."""
        process = self._process
        if process.stdin is None or process.stdout is None or process.stderr is None:
            raise ValueError("the child has no pipes")
        try:
            process.stdin.write(f"{part}\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # its own error says why
        answer = process.stdout.readline()
        if not answer:
            raise ChildError((process.stderr.read().strip().splitlines() or ["it ended at once"])[-1])
        return float(answer) / 1e3 / SCANS[part]

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def compare(tree: Path, before: Path, pairs: int = PAIRS) -> dict[str, tuple[Ratio, float]]:
    """Return the ratio of `tree` over `before` and the processor time of a scan of `tree` in [us], by part.

    Raises ChildError if one of them cannot be run.
    """
    cores = sorted(os.sched_getaffinity(0))
    least_us: dict[str, list[list[float]]] = {part: [] for part in SCANS}
    for pair in range(pairs):
        with ExitStack() as closing:
            children = [Child(folder, cores[pair % len(cores)]) for folder in (before, tree)]
            for child in children:
                closing.callback(child.close)
            for part in SCANS:
                took_us = [[child.block_us(part) for child in children] for _ in range(WARM_BLOCKS + BLOCKS)]
                least_us[part].append([min(blocks) for blocks in zip(*took_us[WARM_BLOCKS:], strict=True)])
    found: dict[str, tuple[Ratio, float]] = {}
    for part in SCANS:
        under, over = zip(*least_us[part], strict=True)
        found[part] = ratio_of(over, under), sorted(over)[pairs // 2]
    return found


def slower(ratio: Ratio) -> bool:
    """Return True for a loss of more than a tenth that is no noise."""
    return ratio.ratio > 1.1 and ratio.low > 1


def run_child(core: int) -> None:
    """Measure a block for each line of stdin, with the packages of the current folder, on one core."""
    os.sched_setaffinity(0, {core})  # before a library counts cores
    import gc

    import numpy as np

    from edge.api import load_model
    from edge.perception.runtime import Runtime
    from edge.pipeline.run_statistics import Statistics
    from edge.sinks.json_records import record_line
    from firmware_bridge.can.slcan import CanFrame, encode_frame
    from firmware_bridge.scans.can_id_maps import USPA44_MAP
    from firmware_bridge.scans.slcan_scans import SlcanScans
    from firmware_bridge.zeroing.baseline import Baseline

    rng = np.random.default_rng(0)
    rest = np.array([16_000, 16_400, 38_600])[:, None] + 37 * np.arange(16)
    baseline = Baseline.of("4", rest.reshape(3, 4, 4).astype(np.float32), time.time(), 100, "file")
    model = load_model("stsr-int8")
    runtime = Runtime(model, source="emulated", baselines={"4": baseline})
    scans, statistics = SlcanScans(), Statistics()
    order = USPA44_MAP.wire_order("4")
    counts = [rest + rng.integers(-3, 4, (3, 16)) for _ in range(SCANS["at rest"])]
    time_ns = 0

    def lines(part: str) -> list[bytes]:
        """Return the text of each scan of a block; in contact a press moves."""
        texts: list[bytes] = []
        for index in range(SCANS[part]):
            values = counts[index].copy()
            if part == "in contact":
                values[2, 4:12] += 3000 + 200 * (index % 8)
            stamp_ms = (time_ns // 1_000_000 + 10 * (index + 1)) % 60_000
            data = [(can_id, b"\0" + values[:, taxel].astype(">u2").tobytes() + b"\0") for can_id, taxel in order]
            texts.append(b"".join(encode_frame(CanFrame(*one, timestamp_ms=stamp_ms)) for one in data))
        return texts

    gc.collect()
    gc.freeze()
    gc.disable()
    for line in sys.stdin:
        block = lines(line.strip())
        records = 0
        begun_ns = time.process_time_ns()
        for text in block:
            time_ns += 10_000_000
            for result in map(runtime.push, scans.feed(text, time_ns)):
                statistics.add(result)
                records += bool(record_line(result, scans.counters()))
        took_ns = time.process_time_ns() - begun_ns
        patterns = statistics.patterns
        if records < len(block) - 2 or (line.strip() == "in contact" and not patterns):
            raise RuntimeError(f"{records} records of {len(block)} scans, {patterns} patterns")
        sys.stdout.write(f"{took_ns}\n")
        sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("commit", nargs="?", default="HEAD~1", metavar="COMMIT", help="default: the commit before")
    commit: str = parser.parse_args(arguments).commit
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = compare(ROOT, tree_of(commit, Path(folder)))
        except (ChildError, CostError) as error:
            print(f"hot path: {commit} cannot be compared with: {error}")
            return 0
    return report(found, commit)


def report(found: Mapping[str, tuple[Ratio, float]], commit: str) -> int:
    """Print what `compare` found, and return the exit code."""
    for part, (ratio, took_us) in found.items():
        verdict = ": more than a tenth slower" if slower(ratio) else ""
        print(f"hot path, {part}: {took_us:.0f} us of processor time a scan, {ratio} times {commit}{verdict}")
    return int(any(slower(ratio) for ratio, _ in found.values()))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        sys.path.remove(str(Path(__file__).parent))
        run_child(int(sys.argv[2]))
    else:
        sys.exit(main())
