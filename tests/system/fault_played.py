"""Scans that two fingers send in a run among faults: each reading encodes when it was taken."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.bench.program import FINGERS, PRESS_COUNTS, REST_COUNTS, emulating
from firmware_bridge.recording.npz_recording import NPZ_FORMAT, NPZ_VERSION

TELLING: Final = 70
"""Steps of x, and of y: a reading encodes its cycle modulo TELLING**2, 49 s at 100 Hz."""


def telling_counts(sensor: int) -> NDArray[np.int32]:
    """Return scans (n, 3, 4, 4) of a pad pressed every other 2.5 s; x and y of each reading encode its cycle."""
    cycles = np.arange(TELLING**2)
    taxels = np.arange(16).reshape(4, 4)
    counts = np.asarray(REST_COUNTS)[None, :, None, None] + np.zeros((len(cycles), 3, 4, 4), dtype=int)
    shift = cycles[:, None, None] + 7 * taxels + 16 * sensor
    counts[:, 0] += shift % TELLING - TELLING // 2
    counts[:, 1] += shift // TELLING % TELLING - TELLING // 2
    turn = 2 * np.pi * cycles / 100
    row, col = (1.5 + np.array([np.sin(turn), np.cos(turn)]))[:, :, None, None]
    rows, cols = np.indices((4, 4))
    press = np.rint(PRESS_COUNTS * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 2)).astype(int)
    counts[:, 2] += np.where((cycles % 500 >= 250)[:, None, None], press, 0) + 37 * taxels
    return counts.astype(np.int32)


@contextmanager
def playing_emulator(folder: Path, faults: str, seed: int) -> Iterator[str]:
    """Yield the port of an emulator that plays them over and over, and logs the truth in folder/truth."""
    files: list[str] = []
    for sensor, name in enumerate(FINGERS):
        counts = telling_counts(sensor)
        path = folder / f"played{name}.npz"
        np.savez(
            path,
            format=np.array(NPZ_FORMAT),
            version=np.array(NPZ_VERSION),
            sensor=np.array([name] * len(counts)),
            scan=np.arange(len(counts)),
            time_ns=np.arange(len(counts)) * 10_000_000,
            counts=counts,
        )
        files.append(str(path))
    link, truth = folder / "usb-adapter", folder / "truth"
    options = ["--loop", "--rate-hz", "100", "--link", str(link), "--truth", str(truth), "--seed", str(seed)]
    options += ["--faults", faults] if faults else []
    emulator = str(Path(__file__).with_name("fault_emulator.py"))
    with emulating(*options, *files, program=[emulator]) as (port,):
        yield port
