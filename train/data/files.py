"""Files of taps of either kind: presses of the simulated world, or whole taps of the paper's protocol."""

from collections.abc import Sequence
from pathlib import Path

from firmware_bridge.recording.npz_reader import read_npz
from train.data.dataset import Sequences, join, load_sequences
from train.data.presses import SCHEMA, PressSet, join_presses, load_presses
from train.errors import DatasetError

_MOST_SCHEMA_BYTES = 4096


def load_taps(paths: Sequence[Path]) -> PressSet | Sequences:
    """Load files of one kind, and concatenate them.

    Raises:
        DatasetError: a file cannot be used, or the files are of two kinds.
    """
    presses = [_holds_presses(path) for path in paths]
    if any(presses) and not all(presses):
        names = " and ".join(str(path) for path, yes in zip(paths, presses, strict=True) if not yes)
        raise DatasetError(f"{names}: made by train.generate, the others are presses: train on files of one kind")
    if all(presses):
        return join_presses([load_presses(path) for path in paths])
    return join([load_sequences(path) for path in paths])


def _holds_presses(path: Path) -> bool:
    try:
        return str(read_npz(path, ("schema",), _MOST_SCHEMA_BYTES)["schema"]) == SCHEMA
    except (OSError, ValueError, KeyError):
        return False  # its reader reports the error
