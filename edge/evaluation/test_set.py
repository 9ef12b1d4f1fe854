"""Frozen test set, on which every model and every classical method is evaluated, here and in training."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from edge.evaluation.metrics import (
    boundary_distance_mm,
    contact_iou,
    interval_coverage,
    psnr_db,
    rmse_percent,
    ssim,
    ssim_global,
)
from edge.inference.contract import Contract, Model
from firmware_bridge.in_place import write_in_place
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.npz_recording import read_npz

# Type and axes of each array; a letter stands for one length everywhere.
_AXES: Final[Mapping[str, tuple[str, str]]] = {
    "newest": ("int16", "n3rc"),
    "earlier": ("int16", "tk3rc"),
    "tap": ("i", "n"),
    "indentation_mm": ("f", "n"),
    "force_n": ("f", "n"),
    "unit_patterns": ("float16", "thw"),
    "touched": ("bool", "thw"),
    "surface": ("U", "t"),
    "angle_deg": ("f", "t"),
    "full_scale_mm": ("f", ""),
}


class FrozenSetError(EdgeError, ValueError):
    """Error of a file that is not a frozen test set."""


@dataclass(frozen=True, slots=True)
class FrozenSet:
    """Frames of taps with their truth.

    A frame's window is its own reading and the ends of the earlier taps, newest first. Contacts are flat, so a tap's
    truth is one map multiplied by the frame's indentation.
    """

    newest: NDArray[np.int16]  # (n, 3, rows, cols) int16, zeroed counts of the frame
    earlier: NDArray[np.int16]  # (taps, K-1, 3, rows, cols) int16, zeroed counts at the end of the earlier taps
    tap: NDArray[np.int16]  # (n,) index of the frame's tap; frames of a tap are not independent
    indentation_mm: NDArray[np.float32]  # (n,) float32, in [mm]
    force_n: NDArray[np.float32]  # (n,) float32, in [N]
    unit_patterns: NDArray[np.float16]  # (taps, H, W) float16, deformation per indentation
    touched: NDArray[np.bool_]  # (taps, H, W) bool, pixels of which the surface touches at least half
    surface: NDArray[np.str_]  # (taps,) name of the surface
    angle_deg: NDArray[np.float32]  # (taps,) rotation of the pad, in [deg]
    full_scale_mm: float  # the patterns' declared full scale, in [mm]

    def __len__(self) -> int:
        return len(self.newest)

    @property
    def scale(self) -> int:
        """Pattern pixels per taxel pitch."""
        return self.unit_patterns.shape[-1] // self.newest.shape[-1]

    def windows(self, taps: int, given: int | None = None) -> NDArray[np.float32]:
        """Return windows (n, taps, 3, rows, cols) in zeroed counts, the newest `given` taps as read, the rest zero."""
        if not 1 <= taps <= 1 + self.earlier.shape[1]:
            raise FrozenSetError(
                f"windows of {taps} taps asked for, the frozen test set has {1 + self.earlier.shape[1]}: make it again "
                "with 'python -m train.freeze' from sequences of more"
            )
        windows = np.concatenate([self.newest[:, None], self.earlier[self.tap]], axis=1)[:, :taps].astype(np.float32)
        windows[:, given if given is not None else taps :] = 0
        return windows

    def patterns(self) -> NDArray[np.float32]:
        """Return the truth, (n, H, W) in [mm]."""
        return self.unit_patterns[self.tap].astype(np.float32) * self.indentation_mm[:, None, None]

    def touching(self) -> NDArray[np.bool_]:
        """Return the pixels that the surface touches, (n, H, W)."""
        return self.touched[self.tap]

    def thinned(self, one_in: int) -> Self:
        """Return the set with one frame in `one_in`, evenly over every tap: large networks take long to evaluate."""
        frames = ("newest", "tap", "indentation_mm", "force_n")
        return replace(self, **{name: getattr(self, name)[one_in // 2 - 1 :: one_in] for name in frames})

    def sha256(self) -> str:
        """Return a hash over all arrays, independent of the file that holds them."""
        digest = hashlib.sha256()
        for name in _AXES:
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write the set as a compressed npz, in place."""
        arrays = {name: getattr(self, name) for name in _AXES}
        write_in_place(path, lambda draft: np.savez_compressed(draft, **arrays), load_frozen_set)


def load_frozen_set(path: Path) -> FrozenSet:
    """Load a frozen test set; raises FrozenSetError, which names what is missing, or of another type or shape."""
    try:
        arrays = read_npz(path, _AXES, 1 << 31)
        lengths = check_axes(_AXES, arrays)
        taps = arrays["tap"]
        if not taps.size or taps.min() < 0 or taps.max() >= lengths["t"] or not 0 < arrays["full_scale_mm"] < np.inf:
            raise ValueError("array 'tap' names taps that are not there, or 'full_scale_mm' is not a length")
    except (OSError, ValueError) as error:
        raise FrozenSetError(
            f"{path} is not a frozen test set ({error}): make it with 'python -m train.freeze'"
        ) from error
    values: dict[str, Any] = arrays | {"full_scale_mm": float(arrays["full_scale_mm"])}
    return FrozenSet(**values)


def check_axes(axes_of: Mapping[str, tuple[str, str]], arrays: Mapping[str, NDArray[Any]]) -> Mapping[str, int]:
    """Return the length of each axis of arrays whose type and axes are stated; raises ValueError if one differs."""
    lengths = {"3": 3}
    for name, (kind, axes) in axes_of.items():
        if name not in arrays:
            raise ValueError(f"array '{name}' is missing")
        array = arrays[name]
        fits = array.ndim == len(axes) and (array.dtype.kind == kind if len(kind) == 1 else array.dtype == kind)
        if not fits or any(
            lengths.setdefault(axis, size) != size for axis, size in zip(axes, array.shape, strict=True)
        ):
            expected = ", ".join(str(lengths.get(axis, axis)) for axis in axes)
            raise ValueError(f"array '{name}' is {array.dtype} {array.shape}, expected {kind} ({expected})")
    return lengths


def judge(
    patterns: NDArray[np.floating],
    frozen: FrozenSet,
    contact_level: float,
    half_width_mm: NDArray[np.floating] | None = None,
    pitch_mm: float = USPA44.pitch_mm,
) -> dict[str, NDArray[np.float64]]:
    """Return every metric of every frame, (n,) each, of patterns and half widths of 90 % intervals (n, H, W)."""
    truth, full_scale = frozen.patterns(), frozen.full_scale_mm
    errors = {
        "psnr_db": psnr_db(patterns, truth, full_scale),
        "ssim": ssim(patterns, truth, full_scale),
        "ssim_global": ssim_global(patterns, truth, full_scale),
        "rmse_percent": rmse_percent(patterns, truth, full_scale),
        "contact_iou": contact_iou(patterns, frozen.touching(), contact_level),
        "boundary_mm": boundary_distance_mm(patterns, frozen.touching(), contact_level, pitch_mm / frozen.scale),
    }
    if half_width_mm is not None:
        errors["coverage_90"] = interval_coverage(patterns, truth, half_width_mm)
    return errors


def judge_model(model: Model, frozen: FrozenSet, given: int | None = None) -> dict[str, NDArray[np.float64]]:
    """Return every metric of every frame of a model with the newest `given` taps, or all that it takes."""
    patterns, half_width_mm = infer_with_intervals(model, frozen, given)
    return judge(patterns, frozen, model.contract.contact_level, half_width_mm, model.contract.pitch_mm)


def infer_with_intervals(
    model: Model, frozen: FrozenSet, given: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the patterns (n, H, W) of every frame, and the half widths of their 90 % intervals, None without."""
    contract = model.contract
    patterns: list[NDArray[np.float32]] = []
    half_widths_mm: list[NDArray[np.float32]] = []
    for window in windows_of(frozen, contract, given):
        patterns.append(model.run(contract.scale_window(window)).copy())
        if model.deviation is not None and contract.interval_factor is not None:
            half_widths_mm.append(contract.interval_factor * model.deviation)
    return np.stack(patterns), np.stack(half_widths_mm) if half_widths_mm else None


def windows_of(frozen: FrozenSet, contract: Contract, given: int | None = None) -> NDArray[np.float32]:
    """Return windows (n, taps, 3, rows, cols) in zeroed counts for a model, with the newest `given` taps or all.

    One that takes poses takes windows of just these; for all others older taps are zero.
    """
    return frozen.windows(given if contract.takes_poses and given is not None else contract.taps, given)


def mean_error(errors: dict[str, NDArray[np.float64]]) -> dict[str, float]:
    """Return the mean of each metric over all frames, rounded to the resolution of the test set."""
    return {name: round(float(values.mean()), 4) for name, values in errors.items()}
