"""Recording of the demo: four taps of one surface, then a tap of another one among them, and a magnet coming near."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import NPZ_FORMAT, NPZ_VERSION
from train.data.dataset import between_frames
from train.data.generation_config import SEED
from train.physics.magnets import Magnet, dipole_mt
from train.physics.resample import resample
from train.physics.sensor_noise import Nuisances, apply_nuisances, draw_rest
from train.physics.simulated_sensor import FINE_SCALE, SimulatedSensor, Taps
from train.surfaces.depth_image import Pose
from train.surfaces.poses import ANGLE_STEP_DEG, TEST_POSITION, position_mm

SURFACE: Final = "S"
FOREIGN: Final = "small circle"
ANGLE_DEG: Final = 30.0
"""Angle of the last scored tap; each tap before is a step back, each later one a step on."""
TAPS: Final = 4
FORCE_N: Final = 5.0
SCALE: Final = 10
RATE_HZ: Final = 100.0
REST_FRAMES, PRESS_FRAMES, HOLD_FRAMES, LIFT_FRAMES, GAP_FRAMES = 150, 20, 24, 12, 24
TAP_FRAMES: Final = PRESS_FRAMES + HOLD_FRAMES + LIFT_FRAMES + GAP_FRAMES
MAGNET_FRAMES: Final = 80
"""Frames in which the magnet comes near, and in which it leaves."""
MAGNET_ALONE_FRAMES: Final = 30
"""Frames for which it stays before the pad is tapped."""
MAGNET_MM: Final = (150.0, 45.0)
"""Distance at which it begins and ends, and at which it stays, in [mm]."""
MAGNET_COUNTS: Final = 900.0
"""Its largest count there, of any taxel and axis: half of that of the tap."""
_TOWARDS: Final = (0.5, -0.3, 0.8)
_MOMENT: Final = (-0.3, -0.8, 0.5)


def demo_recording() -> dict[str, NDArray]:
    """Return four taps of one surface as a controller would send them, with the truth of every frame, and two scenes.

    The pad rests, then presses, holds and lifts four times, turned a step each time, at the held-out position. In the
    scenes, which have no truth, another surface is tapped before the next tap of the first one; then a magnet comes
    near the free pad, which is tapped meanwhile, and leaves.
    """
    sensor = SimulatedSensor()
    angles_deg = [ANGLE_DEG + step * ANGLE_STEP_DEG for step in range(1 - TAPS, 1)]
    taps = _tap(sensor, [SURFACE] * TAPS, angles_deg)
    pressed = _read(taps, angles_deg)
    later_deg = [ANGLE_DEG + step * ANGLE_STEP_DEG for step in range(1, TAPS + 1)]
    later = _read(_tap(sensor, [FOREIGN, SURFACE, SURFACE, SURFACE], later_deg), later_deg)
    magnet = _magnet()
    magnet[MAGNET_FRAMES + MAGNET_ALONE_FRAMES :][:TAP_FRAMES] += later[2]
    rng = np.random.default_rng([SEED, 2])
    still = np.rint(rng.normal(0, Nuisances().noise_counts, (REST_FRAMES, *USPA44.scan_shape)))
    rest = draw_rest(rng, USPA44).round()
    magnet += rng.normal(0, Nuisances().noise_counts, magnet.shape)
    parts = [still, *pressed, later[0], later[1], magnet.round()]
    counts = rest + np.concatenate(parts)
    scene = np.repeat([-1] * (1 + TAPS) + [0, 0, 1], [len(part) for part in parts])
    scene[-GAP_FRAMES:] = -1
    shares = np.tile(_course(), (TAPS, 1))
    end_mm = taps.indentation_mm[:, -1]
    share = np.zeros(len(counts))
    share[REST_FRAMES : REST_FRAMES + shares.size] = shares.ravel()
    tap = np.zeros(len(counts), dtype=int)
    tap[REST_FRAMES : REST_FRAMES + shares.size] = np.repeat(np.arange(TAPS), TAP_FRAMES)
    return {
        "format": np.array(NPZ_FORMAT),
        "version": np.array(NPZ_VERSION),
        "rate_hz": np.array(RATE_HZ),
        "sensor": np.full(len(share), "4"),
        "scan": np.arange(len(share)),
        "time_ns": (np.arange(len(share)) * 1e9 / RATE_HZ).astype(np.int64),
        "counts": counts.astype(np.int32),
        "tap": np.where(share > 0, tap, -1),
        "indentation_mm": (share * end_mm[tap]).astype(np.float32),
        "unit_patterns": (resample(taps.patterns[:, 0], FINE_SCALE, SCALE) / end_mm[:, None, None]).astype(np.float16),
        "surface": np.array(SURFACE),
        "angles_deg": np.array(angles_deg),
        "scene": scene,
    }


def _tap(sensor: SimulatedSensor, surfaces: list[str], angles_deg: Sequence[float]) -> Taps:
    return sensor.tap(surfaces, [Pose(*position_mm(TEST_POSITION), angle) for angle in angles_deg], FORCE_N)


def _course() -> NDArray[np.float64]:
    """Return the share of the press in each frame of a tap."""
    down, hold = np.linspace(0, 1, PRESS_FRAMES + 1)[1:], np.ones(HOLD_FRAMES)
    course = np.concatenate([down, hold, np.linspace(1, 0, LIFT_FRAMES + GAP_FRAMES)])
    course[PRESS_FRAMES + HOLD_FRAMES + LIFT_FRAMES :] = 0
    return course


def _read(taps: Taps, angles_deg: Sequence[float]) -> NDArray[np.float32]:
    """Return the readings (taps, frames, 3, rows, cols) of four taps, always by the same sensor."""
    # The zero is a second old: no drift yet, and the pad has not moved in the earth's field.
    nuisances = Nuisances().without("thermal_drift_counts", "earth_field_counts")
    counts = between_frames(taps.counts, np.tile(_course(), (TAPS, 1)))
    tap_s = TAP_FRAMES / RATE_HZ
    return apply_nuisances(counts[None, ::-1], nuisances, SEED, tap_s=tap_s, angle_deg=angles_deg[::-1])[0, ::-1]


def _magnet() -> NDArray[np.float32]:
    """Return the counts (n, 3, rows, cols) that a magnet adds that comes near, stays for a tap, and leaves."""
    far, near = MAGNET_MM
    coming = np.linspace(0, 1, MAGNET_FRAMES)
    course = np.concatenate([coming, np.ones(MAGNET_ALONE_FRAMES + TAP_FRAMES), coming[::-1], np.zeros(GAP_FRAMES)])
    distance_mm = (far + (near - far) * course)[:, None, None]
    x_mm, y_mm, z_mm = (distance_mm * part / math.hypot(*_TOWARDS) for part in _TOWARDS)
    east, south, up = (np.array(part / math.hypot(*_MOMENT)) for part in _MOMENT)
    chip_x_mm = (np.arange(USPA44.cols) - (USPA44.cols - 1) / 2) * USPA44.pitch_mm
    chip_y_mm = (np.arange(USPA44.rows) - (USPA44.rows - 1) / 2)[:, None] * USPA44.pitch_mm
    field_mt = dipole_mt(Magnet(), (chip_x_mm - x_mm, chip_y_mm - y_mm, -z_mm), (east, south, up))
    field = np.stack(np.broadcast_arrays(*field_mt), axis=1)
    field -= field[-1]
    return (field * (MAGNET_COUNTS / np.abs(field).max())).astype(np.float32)
