"""Sequences of taps to train and evaluate on, as one npz file with a schema, a seed and a hash.

A sequence is K taps on one surface, newest first; the newest is the target. Every tap is stored as a whole press,
FRAMES frames to its end, so that readings and truth are available at any lower force: frame i lies at (i + 1) / FRAMES
of the press, readings at 0 are zero, and values between frames are interpolated linearly.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_bridge.recording.npz_reader import read_npz
from train.data.array_file import MOST_FACTS_BYTES, Axes, arrays_sha256, check_axes, write_arrays
from train.errors import DatasetError
from train.physics.resample import resample, resample_touching
from train.physics.sensor_noise import Nuisances, Seed, read_windows
from train.physics.simulated_sensor import FINE_SCALE, FRAMES

SCHEMA: Final = "tactile-edge-sr sequences"
VERSION: Final = 1

_RESAMPLED_AT_ONCE: Final = 256
_AXES: Final[Axes] = {
    "surfaces": ("U", "n"),
    "poses": ("float64", "nk3"),
    "counts": ("float32", "nkf3rc"),
    "force_n": ("float32", "nkf"),
    "indentation_mm": ("float32", "nkf"),
    "unit_patterns": ("float16", "nlhw"),
    "touching": ("bool", "nlhw"),
}


@dataclass(frozen=True, slots=True)
class Sequences:
    """Sequences of K clean taps, newest first.

    Attributes:
        surfaces: (n,) names.
        poses: (n, K, 3) float64, true poses of the pad: x, y in [mm], angle in [deg].
        counts: (n, K, FRAMES, 3, rows, cols) float32, zeroed, without nuisances.
        force_n: (n, K, FRAMES) float32, in [N].
        indentation_mm: (n, K, FRAMES) float32, in [mm], even steps.
        unit_patterns: (n, L, H, W) float16 of the newest tap, deformation per indentation; L = 1 where all surfaces
            are flat and one map times the indentation is every frame's pattern; else L = FRAMES.
        touching: (n, L, H, W) bool, pixels that the surface touches.
        scale: pattern pixels per taxel pitch.
        seed: of the poses.
        config: configuration of the generation, as read from JSON.
    """

    surfaces: NDArray[np.str_]
    poses: NDArray[np.float64]
    counts: NDArray[np.float32]
    force_n: NDArray[np.float32]
    indentation_mm: NDArray[np.float32]
    unit_patterns: NDArray[np.float16]
    touching: NDArray[np.bool_]
    scale: int = FINE_SCALE
    seed: int = 0
    config: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.surfaces)

    @property
    def taps(self) -> int:
        """Number of taps in a sequence, K."""
        return self.counts.shape[1]

    def newest(self, taps: int) -> "Sequences":
        """Return the sequences with only their newest `taps` taps.

        Raises:
            DatasetError: the sequences have fewer taps.
        """
        if not 1 <= taps <= self.taps:
            raise DatasetError(f"{taps} taps asked for, but these sequences have {self.taps}: make others with --taps")
        several = ("poses", "counts", "force_n", "indentation_mm")
        return replace(self, **{name: getattr(self, name)[:, :taps] for name in several})

    def pick(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> "Sequences":
        """Return the sequences at the indices."""
        return replace(self, **{name: getattr(self, name)[index] for name in _AXES})

    def at_scale(self, scale: int) -> "Sequences":
        """Return the sequences with the truth resampled to another scale, to be called once after loading."""
        if scale == self.scale:
            return self
        patterns, touching = [], []
        for start in range(0, len(self), _RESAMPLED_AT_ONCE):  # in parts, as resampling works in float32
            fine = self.unit_patterns[start : start + _RESAMPLED_AT_ONCE]
            touched = self.touching[start : start + _RESAMPLED_AT_ONCE]
            maps = resample(fine.reshape(-1, *fine.shape[2:]), self.scale, scale).astype(np.float16)
            masks = resample_touching(touched.reshape(-1, *touched.shape[2:]), self.scale, scale)
            patterns.append(maps.reshape(*fine.shape[:2], *maps.shape[1:]))
            touching.append(masks.reshape(*fine.shape[:2], *masks.shape[1:]))
        return replace(self, unit_patterns=np.concatenate(patterns), touching=np.concatenate(touching), scale=scale)

    def share_at_force(self, index: NDArray[np.integer], force_n: ArrayLike) -> NDArray[np.float64]:
        """Return the shares (B, K) of the presses at which they reach their set forces; 1 if a press ends before.

        Args:
            index: (B,) sequences.
            force_n: broadcast to (B, K), above 0, in [N].
        """
        force = self.force_n[index].astype(np.float64)
        wanted = np.broadcast_to(np.asarray(force_n, dtype=np.float64), force.shape[:2])[..., None]
        force = np.concatenate([np.zeros_like(force[..., :1]), force], axis=-1)
        below = np.minimum((force[..., 1:] < wanted).sum(axis=-1, keepdims=True), FRAMES - 1)
        low, high = (np.take_along_axis(force, below + step, axis=-1) for step in (0, 1))
        return np.minimum((below + (wanted - low) / (high - low))[..., 0] / FRAMES, 1.0)

    def presses(
        self, index: NDArray[np.integer], share: NDArray[np.floating], frames: int = FRAMES
    ) -> NDArray[np.float32]:
        """Return clean readings (B, K, frames, 3, rows, cols) of presses ending at shares (B, K) of the stored ones."""
        counts = self.counts[index]
        moments = share[..., None] * np.arange(1, frames + 1) / frames
        readings = between_frames(counts.reshape(-1, *counts.shape[2:]), moments.reshape(-1, frames))
        return readings.reshape(*moments.shape, *counts.shape[3:])

    def force_at(self, index: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the force of the newest tap, (B, m) in [N], at shares (B, m) of its press."""
        return between_frames(self.force_n[index, 0], share)

    def indentation_at(self, index: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the indentation of the newest tap, (B, m) in [mm], at shares (B, m) of its press."""
        return between_frames(self.indentation_mm[index, 0], share)

    def patterns_at(self, index: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the truth of the newest tap, (B, H, W) in [mm], at shares (B,) of its press."""
        unit, end_mm = self.unit_patterns[index].astype(np.float32), self.indentation_mm[index, 0]
        if unit.shape[1] == 1:
            depth_mm = (end_mm[:, -1] * share).astype(np.float32)
            return unit[:, 0] * depth_mm[:, None, None]
        return between_frames(unit * end_mm[..., None, None], share[:, None])[:, 0]

    def touching_at(self, index: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the pixels touched by the newest tap, (B, H, W), in the frame nearest to shares (B,) of its press."""
        nearest = np.clip(np.rint(share * FRAMES).astype(int) - 1, 0, self.touching.shape[1] - 1)
        return self.touching[index, nearest]

    def sha256(self) -> str:
        """Return the hash over all data and the configuration, independent of the file."""
        return arrays_sha256([self.scale, self.seed, self.config], {name: getattr(self, name) for name in _AXES})

    def save(self, path: Path) -> None:
        """Write the sequences as one npz, atomically.

        Raises:
            DatasetError: the file cannot be written.
        """
        arrays = {name: getattr(self, name) for name in _AXES}
        arrays["touching"] = np.packbits(self.touching, axis=-1)
        facts = {"scale": self.scale, "seed": self.seed, "config": self.config, "sha256": self.sha256()}
        write_arrays(path, SCHEMA, VERSION, facts, arrays)


def load_sequences(path: Path) -> Sequences:
    """Load a file that `Sequences.save` has written.

    Raises:
        DatasetError: absent, of another format, of a newer schema, incomplete, or damaged.
    """
    try:
        about = read_npz(path, ("schema", "version", "facts"), MOST_FACTS_BYTES)
        if str(about.get("schema")) != SCHEMA:
            raise DatasetError(f"{path} is not a file of sequences: make one with 'python -m train.generate'")
        if (version := int(about["version"])) > VERSION:
            raise DatasetError(f"{path} has schema version {version}, newer than {VERSION}: update this program")
        facts: Any = json.loads(str(about["facts"]))
        found = read_npz(path, _AXES, path.stat().st_size)  # nothing in it is compressed
        arrays = {name: found[name] for name in _AXES}
        arrays["touching"] = _unpacked(arrays["touching"], arrays["unit_patterns"])
        stated: dict[str, Any] = {name: facts.get(name) for name in ("scale", "seed", "config")}
        hashed = str(facts.get("sha256"))[:64]
    except DatasetError:
        raise
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file; make one with 'python -m train.generate {path}'") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"{path} is not a file of sequences, or a damaged one ({error}): make it again") from error
    maps = check_axes(path, _AXES, arrays, f=FRAMES)["l"]
    if maps not in (1, FRAMES):
        raise DatasetError(f"{path}: {maps} maps for a press, expected 1 or {FRAMES}")
    loaded = Sequences(**arrays, **stated)
    if (found := loaded.sha256()) != hashed:
        raise DatasetError(f"{path} is damaged: its sha256 is {found}, it states {hashed}: make it again")
    _check_facts(path, stated)
    return loaded


def join(parts: Sequence[Sequences]) -> Sequences:
    """Concatenate sequences, with the first part's scale, seed and configuration.

    If some parts have one map for a press and others one for each frame, the single map is repeated.

    Raises:
        DatasetError: they have different numbers of taps.
    """
    taps = {part.taps for part in parts}
    if len(taps) > 1:
        raise DatasetError(
            f"files of {' and '.join(map(str, sorted(taps)))} taps a sequence: make them with one --taps"
        )
    maps = max(part.unit_patterns.shape[1] for part in parts)
    arrays = {name: [getattr(part, name) for part in parts] for name in _AXES}
    for name in ("unit_patterns", "touching"):
        arrays[name] = [np.repeat(array, maps // array.shape[1], axis=1) for array in arrays[name]]
    return replace(parts[0], **{name: np.concatenate(several) for name, several in arrays.items()})


def windows(
    sequences: Sequences,
    index: NDArray[np.integer],
    depth_share: ArrayLike,
    force_n: ArrayLike,
    nuisances: Nuisances,
    seed: Seed,
    tap_s: ArrayLike | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the readings of B sensors and their truth; the newest tap is in progress, the earlier ones have ended.

    Args:
        sequences: with the truth at the required scale.
        index: (B,) sequences.
        depth_share: completed share of the newest press, above 0 to 1, broadcast to (B,).
        force_n: set force of every tap, broadcast to (B, K), in [N].
        nuisances: of these sensors.
        seed: of the nuisances.
        tap_s: duration of the stored presses, broadcast to (B, K), in [s], or None to draw it.

    Returns:
        Windows (B, K, 3, rows, cols) in whole zeroed counts, and patterns (B, H, W) in [mm].
    """
    share = sequences.share_at_force(index, force_n)
    share[:, 0] *= np.asarray(depth_share, dtype=np.float64)
    angle_deg = sequences.poses[index, :, 2]
    readings = read_windows(sequences.counts[index], share, nuisances, seed, tap_s, angle_deg)
    return readings, sequences.patterns_at(index, share[:, 0])


def quarter_turns(
    windows: NDArray[np.float32], patterns: NDArray[np.float32], quarters: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the same contacts on a pad turned clockwise: maps turn, and the shear (x, y) turns with them."""
    turned, maps = windows, np.rot90(patterns, quarters, axes=(-2, -1))
    for _ in range(quarters % 4):
        x, y, z = np.moveaxis(np.rot90(turned, 1, axes=(-2, -1)), -3, 0)
        turned = np.stack([y, -x, z], axis=-3)
    return turned, maps


def turns_of(windows: NDArray[np.float32], quarters: int) -> int:
    """Return the quarter turns that keep the grid of (..., rows, cols): any of a square, of others the half turns."""
    return quarters if windows.shape[-1] == windows.shape[-2] else 2 * (quarters % 2)


def between_frames(frames: NDArray[np.float32], share: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return values (b, m, ...) at shares (b, m) of presses, between frames (b, FRAMES, ...) and 0 at the start."""
    away = np.abs(share[..., None] * FRAMES - np.arange(1, FRAMES + 1))
    weights = np.maximum(1 - away, 0).astype(np.float32)
    return (weights @ frames.reshape(*frames.shape[:2], -1)).reshape(*share.shape, *frames.shape[2:])


def _unpacked(touching: NDArray[np.uint8], patterns: NDArray[np.float16]) -> NDArray[np.bool_]:
    """Return masks that a file keeps as bits along the last axis."""
    if not patterns.ndim:
        raise ValueError("unit_patterns has no axes")
    if touching.ndim != patterns.ndim or touching.shape[-1] != -(-patterns.shape[-1] // 8):
        raise ValueError(f"touching is {touching.shape}, which is not a mask of {patterns.shape}")
    return np.unpackbits(touching, axis=-1, count=patterns.shape[-1]).astype(bool)


def _check_facts(path: Path, facts: Mapping[str, Any]) -> None:
    kinds = {"scale": int, "seed": int, "config": dict}
    if not all(type(facts.get(name)) is kind for name, kind in kinds.items()) or facts["scale"] < 1:
        raise DatasetError(f"{path}: scale, seed or config is missing or of another type: make it again")
