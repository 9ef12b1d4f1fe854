"""Write a report: what scans are worth whose readings name their cycle, by reader and by what goes wrong.

python tests/system/cycles.py --out reports/cycles.md
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

from cycle_samples import READERS, Reader, Worth, bus, doubling, losing, pausing, read, swapping

from edge.bench.provenance import provenance

CYCLES = 1000


def cases(reader: Reader) -> Iterator[tuple[str, list[Worth]]]:
    """Yield everything that goes wrong, by name, and what one reader made of it."""
    yield "joining at each of 16 frames", [read(bus(30, first_frame=frame), reader) for frame in range(16)]
    yield "each single frame lost", [_without(16 * 10 + frame, reader) for frame in range(16)]
    for share in (0.0001, 0.0005, 0.005, 0.05):
        yield f"frames lost at random, {share:g}", [read(losing(share, seed=1)(bus(CYCLES)), reader)]
    yield "frames twice in a row, .02", [read(doubling(0.02)(bus(CYCLES)), reader)]
    yield "frames swapped, .02", [read(swapping(0.02)(bus(CYCLES)), reader)]
    for stall_ms in (5, 20, 70, 200, 500):
        stalls = [(0.9 * n + 0.0131 * (n % 7), stall_ms / 1000) for n in range(1, 30)]
        yield f"reader stands still, {stall_ms} ms", [read(bus(CYCLES), reader, stalls=stalls)]
    for pause_ms in (2, 5, 10, 16, 30, 60, 200):
        fault = pausing(pause_ms / 1000, 0.13 if pause_ms < 100 else 0.5, seed=2)
        yield f"bus pauses, {pause_ms} ms", [read(fault(bus(CYCLES)), reader)]
    for rate_hz, frame_us in ((50, 130), (100, 500), (200, 130), (470, 130), (1000, 20)):
        frames = bus(CYCLES, (rate_hz,), frame_s=frame_us / 1e6, jitter_s=min(0.001, 0.1 / rate_hz))
        both = [read(fault(frames), reader) for fault in (losing(0.005), pausing(0.003, 0.07))]
        yield f"{rate_hz} Hz, frames of {frame_us} us: .005 lost, and pauses of 3 ms", both
    yield "two sensors, 100 and 103 Hz, .002 lost", [read(losing(0.002)(bus(CYCLES, (100, 103))), reader)]


def _without(place: int, reader: Reader) -> Worth:
    frames = bus(30)
    del frames[place]
    return read(frames, reader)


def main() -> None:
    """Write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    out: Path = parser.parse_args().out
    by_reader = [dict(cases(reader)) for reader in READERS]
    lines = [
        "# Scans of one cycle",
        "",
        str(provenance("python tests/system/cycles.py --out reports/cycles.md", [__file__], seed=0)),
        "",
        "Every reading is the number of its cycle, so a scan of two is seen at once. In each cell: whole scans with",
        "readings of two cycles, of all whole scans; and torn ones.",
        "",
        "| | " + " | ".join(reader.name for reader in READERS) + " |",
        "|---" * (1 + len(READERS)) + "|",
    ]
    for name in by_reader[0]:
        cells = [
            f"{sum(one.mixed for one in worths)} of {sum(one.whole for one in worths)}; "
            f"{sum(one.counters['torn_wire'] for one in worths)}"
            for worths in (cells[name] for cells in by_reader)
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    longest_ms = max(
        wait for cells in by_reader for worths in cells.values() for one in worths for wait in one.waits_ms
    )
    lines += ["", f"From the read of a cycle's last frame to its scan at most {longest_ms:.1f} ms."]
    out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
