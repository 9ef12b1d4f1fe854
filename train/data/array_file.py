"""npz file of data with declared arrays: its writing, its hash, and the check of types and axes."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.in_place import write_in_place
from firmware_bridge.recording.npz_reader import read_npz
from train.errors import DatasetError

Axes = Mapping[str, tuple[str, str]]
"""Type and axes of each array; a letter is the same length everywhere."""
MOST_FACTS_BYTES: Final = 1 << 22
"""Largest configuration read, in bytes; real ones take a few kB."""


def arrays_sha256(configuration: object, arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the hash over a configuration and arrays, independent of the file."""
    digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode())
    for name, values in arrays.items():
        array = np.ascontiguousarray(values)
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.data if array.dtype.kind != "U" else "\0".join(array.tolist()).encode())
    return digest.hexdigest()


def write_arrays(
    path: Path,
    schema: str,
    version: int,
    facts: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    *,
    compressed: bool = False,
) -> None:
    """Write arrays and facts about them as one npz, atomically.

    Raises:
        DatasetError: the file cannot be written.
    """
    save = np.savez_compressed if compressed else np.savez

    def write(draft: Path) -> None:
        with draft.open("wb") as file:
            save(file, allow_pickle=False, schema=schema, version=version, facts=json.dumps(facts), **arrays)

    try:
        # Only the facts are read back: reading all arrays would need as much memory again.
        write_in_place(path, write, lambda draft: read_npz(draft, ["facts"], MOST_FACTS_BYTES), keep_before=False)
    except OSError as error:
        raise DatasetError(f"{path} cannot be written: {error.strerror or error}") from error


def check_axes(path: Path, axes_of: Axes, arrays: Mapping[str, NDArray[Any]], **lengths: int) -> Mapping[str, int]:
    """Check types and axes of arrays, and return the length of each axis; those in `lengths` are fixed.

    Raises:
        DatasetError: an array is of another type or shape.
    """
    lengths = {"3": 3} | lengths
    for name, (kind, axes) in axes_of.items():
        array = arrays[name]
        fits = array.ndim == len(axes) and (array.dtype.kind == kind if kind == "U" else array.dtype == kind)
        if not fits or any(
            lengths.setdefault(axis, size) != size for axis, size in zip(axes, array.shape, strict=True)
        ):
            expected = ", ".join(str(lengths.get(axis, axis)) for axis in axes)
            raise DatasetError(f"{path}: {name} is {array.dtype} {array.shape}, expected {kind} ({expected})")
    return lengths
