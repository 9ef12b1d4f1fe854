"""Inputs and checks that the targets of the fuzzer share."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from firmware_bridge.recording.tracks import HIGHEST_COUNT
from firmware_bridge.scans.scan import ABSENT

LONGEST_MESSAGE = 1000
"""Characters of an error that a user can still read, paths among them."""
_KEPT = tempfile.TemporaryDirectory(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_KEPT.name)
FRESH = np.ones((4, 4), dtype=bool)
REST = np.array([16_000, 16_400, 38_600])[:, None, None] + np.arange(16).reshape(4, 4) * 90


def refused(read: Callable[[], object], *errors: type[Exception]) -> object | None:
    """Return what was read; None where it was refused in one line."""
    try:
        return read()
    except errors as error:
        text = str(error)
        assert "\n" not in text and len(text) <= LONGEST_MESSAGE, text
        return None


def as_file(name: str, data: bytes) -> Path:
    path = FOLDER / name
    path.write_bytes(data)
    return path


def check_counts(counts: np.ndarray) -> None:
    assert counts.shape[-3:] == (3, 4, 4) and counts.dtype == np.int32
    assert counts.min() >= ABSENT and counts.max() <= HIGHEST_COUNT
