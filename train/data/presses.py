"""Presses to train and evaluate on, with the constants of each pad, as one npz file with a hash.

A set is made again with the same bytes from its seed, on one thread.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from edge.evaluation.test_set import check_axes
from firmware_bridge.in_place import write_in_place
from firmware_bridge.recording.npz_recording import read_npz
from train.errors import DatasetError
from train.physics.tpsf import resample, resample_touching

SEED: Final = 20240228  # of all frozen sets; it must never change, or figures cannot be compared
SCHEMA: Final = "tactile-edge-sr presses"
VERSION: Final = 3  # of the presses; 3 added poses
_MOST_FACTS_BYTES: Final = 1 << 22  # largest configuration read, in bytes; real ones take a few kB
_AXES: Final = {  # type and axes of each array; a letter is the same length everywhere
    "family": ("U", "n"),
    "pad": ("int64", "n"),
    "constants": ("float32", "np"),
    "counts": ("float32", "nk3rc"),
    "angle_deg": ("float32", "nk"),
    "poses": ("float32", "nk3"),
    "patterns": ("float16", "nhw"),
    "touching": ("bool", "nhw"),
    "traction_kpa": ("float16", "n3ab"),
    "force_n": ("float32", "n3"),
    "twist_nmm": ("float32", "n"),
    "indentation_mm": ("float32", "n"),
}


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and BLAS to one thread each: a sum split over threads differs in its last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)


@dataclass(frozen=True, slots=True)
class PressSet:
    """n sequences of K presses, newest first, each at one moment, with the newest one's truth."""

    family: NDArray[np.str_]  # (n,) names, see train.families.catalogue
    pad: NDArray[np.int64]  # (n,), number of the pad within the set
    constants: NDArray[np.float32]  # (n, p) of the pads, over their spread, see train.physics.pad_draws
    counts: NDArray[np.float32]  # (n, K, 3, rows, cols), zeroed, without nuisances
    angle_deg: NDArray[np.float32]  # (n, K), turn of the pad seen from above, for the earth's field
    poses: NDArray[np.float32]  # (n, K, 3) of the pad in the newest tap's axes: x, y in [mm], turn in [deg]
    patterns: NDArray[np.float16]  # (n, H, W) in [mm]
    touching: NDArray[np.bool_]  # (n, H, W)
    traction_kpa: NDArray[np.float16]  # (n, 3, h, w)
    force_n: NDArray[np.float32]  # (n, 3)
    twist_nmm: NDArray[np.float32]  # (n,)
    indentation_mm: NDArray[np.float32]  # (n,)
    config: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.family)

    @property
    def taps(self) -> int:
        """Number of presses in a sequence, K."""
        return self.counts.shape[1]

    @property
    def scale(self) -> int:
        """Pattern pixels per taxel pitch."""
        return self.patterns.shape[-1] // self.counts.shape[-1]

    def pick(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> "PressSet":
        """Return the sequences at the indices."""
        return replace(self, **{name: getattr(self, name)[index] for name in _AXES})

    def with_taps(self, taps: int) -> "PressSet":
        """Return the sequences with their newest `taps` taps; absent taps are all zeros."""
        more = max(taps - self.taps, 0)

        def padded(array: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.pad(array[:, :taps], [(0, 0), (0, more)] + [(0, 0)] * (array.ndim - 2))

        return replace(self, counts=padded(self.counts), angle_deg=padded(self.angle_deg), poses=padded(self.poses))

    def at_scale(self, scale: int) -> "PressSet":
        """Return the sequences with the truth at another scale, in pattern pixels per taxel pitch."""
        if scale == self.scale:
            return self
        return replace(
            self,
            patterns=resample(self.patterns, self.scale, scale).astype(np.float16),
            touching=resample_touching(self.touching, self.scale, scale),
        )

    def only_turned(self) -> "PressSet":
        """Return the sequences whose taps are all at one place, as the paper's schedule turns the pad."""
        return self.pick(np.flatnonzero(~self.poses[..., :2].any(axis=(1, 2))))

    def sha256(self) -> str:
        """Return the hash over all data and the configuration, independent of the file."""
        # Taps that were only turned have the hash of version 2, by which reports and contracts name their sets.
        left_out = () if self.poses[..., :2].any() else ("poses",)
        digest = hashlib.sha256(json.dumps(self.config, sort_keys=True).encode())
        for name in _AXES:
            if name not in left_out:
                array = np.ascontiguousarray(getattr(self, name))
                digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
                digest.update(array.data if array.dtype.kind != "U" else "\0".join(array.tolist()).encode())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write the presses as one npz, atomically."""
        arrays = {name: getattr(self, name) for name in _AXES}
        arrays["touching"] = np.packbits(self.touching, axis=-1)
        facts = json.dumps({"config": self.config, "sha256": self.sha256()})

        def write(draft: Path) -> None:
            with draft.open("wb") as file:
                np.savez(file, allow_pickle=False, schema=SCHEMA, version=VERSION, facts=facts, **arrays)

        path.parent.mkdir(parents=True, exist_ok=True)
        # Only the facts are read back: reading all arrays would need as much memory again.
        write_in_place(path, write, lambda draft: read_npz(draft, ["facts"], _MOST_FACTS_BYTES), keep_before=False)


def load_presses(path: Path) -> PressSet:
    """Load a file of `PressSet.save`; DatasetError if it is absent, of another or newer format, or damaged."""
    try:
        about = read_npz(path, ("schema", "version", "facts"), _MOST_FACTS_BYTES)
        if str(about["schema"]) != SCHEMA or int(about["version"]) > VERSION:
            raise DatasetError(
                f"{path} is {str(about['schema'])[:60]!r} of version {about['version']}, expected {SCHEMA!r} of "
                f"at most {VERSION}: make it with 'python -m train.data.make_presses'"
            )
        facts: Any = json.loads(str(about["facts"]))
        # Version 2 has no poses: its taps were turned at one place.
        names = [name for name in _AXES if name != "poses" or int(about["version"]) > 2]
        arrays = dict(read_npz(path, names, 1 << 33))
        if "poses" not in arrays:
            turns_deg = arrays["angle_deg"][:, :1] - arrays["angle_deg"]
            arrays["poses"] = np.stack([*np.zeros((2, *turns_deg.shape), np.float32), turns_deg], axis=2)
        width = arrays["patterns"].shape[-1]
        arrays["touching"] = np.unpackbits(arrays["touching"], axis=-1, count=width).astype(bool)
        check_axes(_AXES, arrays)
        loaded = PressSet(**arrays, config=facts["config"])
        hashed = str(facts["sha256"])
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file; make one with 'python -m train.data.make_presses {path}'") from None
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path} is not a file of presses, or a damaged one ({error}): make it again") from error
    if (actual := loaded.sha256()) != hashed:
        raise DatasetError(f"{path} is damaged: its sha256 is {actual}, it states {hashed[:64]}: make it again")
    return loaded


def join_presses(parts: Sequence[PressSet]) -> PressSet:
    """Concatenate sequences, padded to the taps of the longest; pads are renumbered, so that they stay distinct.

    DatasetError if there are none, or of several scales or pads.
    """
    if not parts:
        raise DatasetError("no presses to join: name at least one file")
    kinds = dict.fromkeys((part.scale, *part.counts.shape[3:]) for part in parts)
    if len(kinds) > 1:
        listed = " and ".join(f"x{scale} of {rows} x {cols} taxels" for scale, rows, cols in kinds)
        raise DatasetError(f"the presses are at {listed}, expected one scale and one pad: name files that are alike")
    taps = max(part.taps for part in parts)
    first, pads = 0, []
    for part in parts:
        pads.append(part.pad + first)
        first = int(pads[-1].max(initial=first - 1)) + 1
    padded = [part.with_taps(taps) for part in parts]
    arrays = {name: np.concatenate([getattr(part, name) for part in padded]) for name in _AXES}
    arrays["pad"] = np.concatenate(pads)
    return PressSet(**arrays, config={"parts": [part.config for part in parts]} if len(parts) > 1 else parts[0].config)
