"""`edge-sr` among faults: two fingers on one bus, sinks and consumers that fail, everything kept for evaluation."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from fault_log import EVENTS, read_truth
from fault_played import playing_emulator
from fault_records import Ran, Seen, Size, in_thread, keep_lines, read_records
from fault_sinks import failing_sinks, fill_up, look_into_files, read_and_go, read_slowly
from fault_stretches import parse_stretches

from edge.bench.errors import BenchError
from edge.bench.program import FINGERS, REST_COUNTS, environment
from edge.pipeline.pump import uncollected
from edge.terminal.progress_bar import SECONDS, Progress
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

CALM_S: Final = 4.0
"""Time before the first fault, which shows a run without faults."""
WATCH_S: Final = 1.0
QUIET_S: Final = 0.4
"""Time without a record after which everything has been read."""
END_TIMEOUT_S: Final = 20.0
CLOCK_STEP_S: Final = 3600.0
_CLOCK: Final = f"""
import time
_true, _start = time.time, time.monotonic()
def _stepping():
    since = time.monotonic() - _start
    return _true() + (0.0 if since < 3 else {CLOCK_STEP_S} if since < 6 else -{CLOCK_STEP_S})
time.time = _stepping
"""
"""The wall clock of a machine cannot be set here: that of the program's own Python is stepped on and back instead."""


def run_among_faults(faults: str, seed: int, folder: Path, *, options: Sequence[str] = ()) -> Ran:
    """Run the program and keep all that its evaluation needs.

    Args:
        faults: faults as the emulator takes them; the program is ended when the last one has begun and silenced all.
        seed: seed of the faults.
        folder: folder for everything that is written.
        options: further options of edge-sr.

    Raises:
        BenchError: the emulator or edge-sr did not start.
    """
    ran = Ran()
    errors: list[bytes] = []
    sinks = failing_sinks(folder)
    # They wait for the program, which would not wait for them.
    slow, gone = in_thread(read_slowly, folder / "slow.fifo", ran), in_thread(read_and_go, folder / "gone.fifo")
    with (
        uncollected(),  # a full collection lets no thread read for a tenth of a second, and the pipe runs over
        playing_emulator(folder, faults, seed) as port,
        _program(folder, port, sinks, options) as process,
    ):
        reader = in_thread(read_records, process.stdout, ran.seen)
        talker = in_thread(keep_lines, process.stderr, errors)
        last = parse_stretches(faults, seed)[-1]
        with Progress("faults", last.start_s, SECONDS) as bar:
            _watch(process, f'"stretch": "{last}"', folder / "truth" / EVENTS, ran, bar)
        process.send_signal(signal.SIGINT)
        try:
            ran.exit_code = process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
        for thread in (reader, talker):
            thread.join(END_TIMEOUT_S)
        ran.said = b"".join(errors).decode(errors="replace")
        if not ran.seen:
            raise BenchError(f"edge-sr gave no record, exit code {ran.exit_code}: {ran.said}")
        for thread in (slow, gone):
            thread.join(END_TIMEOUT_S)
    ran.told = read_truth(folder / "truth")
    ran.clock_steps_s = _clock_steps_s(ran.seen)
    look_into_files(folder, ran)
    return ran


def _clock_steps_s(seen: Sequence[Seen]) -> list[float]:
    taken_s = [  # by the wall clock: the age in the record, less the time by the clock that is not stepped
        one.head["baseline_age_s"] - one.head["time_ns"] / 1e9
        for one in seen
        if one.head.get("baseline_age_s") is not None
    ]
    return [round(later - taken) for taken, later in pairwise(taken_s) if abs(later - taken) > CLOCK_STEP_S / 2]


@contextmanager
def _program(
    folder: Path, port: str, sinks: Sequence[str], options: Sequence[str]
) -> Iterator[subprocess.Popen[bytes]]:
    rest = np.asarray(REST_COUNTS)[:, None, None] + np.zeros((3, 4, 4))
    rest[2] += 37 * np.arange(16).reshape(4, 4)
    baselines = [Baseline.of(name, rest.astype(np.float32), time.time(), 100, "file") for name in FINGERS]
    save_baselines(folder / "zero.json", baselines)
    (folder / "clock").mkdir()
    (folder / "clock" / "sitecustomize.py").write_text(_CLOCK)
    clocked = environment()
    clocked["PYTHONPATH"] = os.pathsep.join([str(folder / "clock"), clocked["PYTHONPATH"]])
    command = [
        sys.executable,
        "-m",
        "edge.cli.main",
        "--source",
        f"slcan:{port}",
        "--baseline",
        str(folder / "zero.json"),
    ]
    for sink in ("jsonl:-", *sinks):
        command += ["--sink", sink]
    with subprocess.Popen(
        [*command, *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=clocked,
        start_new_session=True,
        preexec_fn=fill_up,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _watch(process: subprocess.Popen[bytes], last_fault: str, events: Path, ran: Ran, bar: Progress) -> None:
    """Let it run until the last fault has begun and no record comes any more, or until it ends."""
    start_s = time.monotonic()
    while process.poll() is None and not ran.seen:
        if time.monotonic() - start_s > END_TIMEOUT_S:
            return
        time.sleep(0.01)
    proc = Path(f"/proc/{process.pid}")
    start_s = looked_s = time.monotonic()
    over = False
    while process.poll() is None and not (over and time.monotonic() > ran.seen[-1].read_ns / 1e9 + QUIET_S):
        time.sleep(0.05)
        over = over or last_fault in events.read_text()
        if over or time.monotonic() < looked_s + WATCH_S:
            continue
        looked_s = time.monotonic()
        bar.reach(looked_s - start_s)
        try:
            resident_mb = int((proc / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            threads, descriptors = (len(list((proc / name).iterdir())) for name in ("task", "fd"))
        except OSError:
            break
        ran.sizes.append(Size(looked_s - start_s, resident_mb, threads, descriptors))
