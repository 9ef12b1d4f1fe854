"""Recording of two fingers that grip things, as real sensors would send it: noise, drift, gains and uneven pads."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.npz_recording import NPZ_FORMAT, NPZ_VERSION
from train.data.presses import SEED
from train.physics.contact import BARE
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import draw_pad
from train.physics.sensor_noise import Nuisances, apply_nuisances

RATE_HZ: Final = 100.0
FINGERS: Final = ("4", "6")
_FREE, _CLOSE, _HOLD, _OPEN = 130, 25, 150, 25  # scans before and after each grip, and of its parts
_STEP: Final = 5  # scans from one solved press to the next; those between are interpolated
_FORCE_N: Final = 8.0
_DRIFT_COUNTS_PER_S: Final = 2.0  # of z, as a pad warms in a grip

Shape = Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.floating]]
"""Height in [mm] at places of x and y in [mm], as one finger sees it."""


def _pen(x_mm: NDArray[np.floating], y_mm: NDArray[np.floating]) -> NDArray[np.floating]:
    return -((x_mm * np.cos(0.4) + y_mm * np.sin(0.4)) ** 2) / (2 * 6.0)


def _nut(x_mm: NDArray[np.floating], y_mm: NDArray[np.floating]) -> NDArray[np.floating]:
    away = np.hypot(x_mm - 1.0, y_mm)
    return np.where((away > 3.0) & (away < 7.0), 0.0, -2.0)


def grip_recording() -> dict[str, NDArray]:
    """Return the arrays of a recording in which a pen and then a nut are gripped, lifted and let go."""
    fingers = [_finger(number) for number in range(len(FINGERS))]
    scans = len(fingers[0])
    time_ns = np.arange(scans) * 1e9 / RATE_HZ
    return {
        "format": np.array(NPZ_FORMAT),
        "version": np.array(NPZ_VERSION),
        "rate_hz": np.array(RATE_HZ),
        "origin": np.full(scans * len(FINGERS), "emulated"),
        "sensor": np.tile(FINGERS, scans),
        "scan": np.repeat(np.arange(scans), len(FINGERS)),
        "time_ns": np.repeat(time_ns.astype(np.int64), len(FINGERS)),
        "counts": np.stack(fingers, axis=1).reshape(-1, *USPA44.scan_shape).astype(np.int32),
    }


def _finger(number: int) -> NDArray[np.float64]:
    """Return the raw counts (n, 3, rows, cols) of one finger; the second sees everything mirrored."""
    rng = np.random.default_rng([SEED, 4, number])
    pad = GrippedPad(draw_pad(rng))
    free = np.zeros((_FREE, *USPA44.scan_shape))
    clean = np.concatenate([free, *(part for shape in (_pen, _nut) for part in (_grip(pad, shape, number == 1), free))])
    sensor = Nuisances().without("thermal_drift_counts", "earth_field_counts")  # zeroed a second ago, in this place
    duration_s = len(clean) / RATE_HZ
    read = apply_nuisances(clean[None, None].astype(np.float32), sensor, int(rng.integers(2**31)), tap_s=duration_s)
    warming = np.array([0.0, 0.0, 1.0])[:, None, None] * _DRIFT_COUNTS_PER_S * rng.uniform(0.5, 1)
    drift = np.linspace(0, duration_s, len(clean))[:, None, None, None] * warming
    rest = np.array([32700.0, 32800.0, 37400.0])[:, None, None] + 300.0 * rng.standard_normal(USPA44.scan_shape)
    return np.rint(rest + read[0, 0] + drift)


def _grip(pad: GrippedPad, shape: Shape, mirrored: bool) -> NDArray[np.float32]:
    """Return clean counts of one grip: it closes to its force, is lifted, which drags the pad down, and opens."""
    x_mm, y_mm = np.broadcast_arrays(*pad.places_mm)
    heights_mm = shape(-x_mm if mirrored else x_mm, y_mm).astype(np.float32)
    share = np.concatenate([np.linspace(0, 1, _CLOSE), np.ones(_HOLD), np.linspace(1, 0, _OPEN)])
    drag_mm = 0.15 * np.clip((np.arange(len(share)) - _CLOSE - _HOLD / 4) / (_HOLD / 4), 0, 1)
    solved = np.unique(np.append(np.arange(1, len(share) - 1, _STEP), len(share) - 2))
    depth_mm = 0.3
    for _ in range(3):  # both fingers carry the same force, to a few percent
        force_n = _pressed(pad, heights_mm, np.array([depth_mm]), np.zeros(1)).force_n[0, 2]
        depth_mm = float(np.clip(depth_mm * (_FORCE_N / force_n) ** 0.7, 0.05, 0.5))
    counts = _pressed(pad, heights_mm, np.maximum(depth_mm * share[solved], 1e-3), drag_mm[solved]).counts
    at = np.arange(len(share))
    flat = [np.interp(at, [0, *solved, at[-1]], [0, *column, 0]) for column in counts.reshape(len(solved), -1).T]
    return np.stack(flat, axis=1).reshape(-1, *USPA44.scan_shape).astype(np.float32)


def _pressed(pad: GrippedPad, heights_mm: NDArray[np.float32], depth_mm: NDArray, drag_mm: NDArray):
    count = len(depth_mm)
    slide = np.stack([np.zeros(count), drag_mm], axis=1)
    heights = np.broadcast_to(heights_mm, (count, *heights_mm.shape))
    return pad.press(heights, depth_mm, slide, np.zeros(count), np.full(count, 0.8), [BARE] * count)
