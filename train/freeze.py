"""Make what every model is judged on: the frozen test set, the classical methods, and the demo's recording.

python -m train.freeze edge/models
"""

import argparse
import sys
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.classical import bilinear, fit_gain, fit_linear_map
from firmware_bridge.geometry import USPA44
from firmware_bridge.recording import NPZ_FORMAT, NPZ_VERSION
from train.dataset import (
    ANGLE_STEP_DEG,
    MAX_TAPS,
    SET_FORCE_N,
    TEST_FORCE_N,
    TEST_POSITION,
    freeze,
    position_mm,
    random_poses,
    solve_sequences,
    training_batches,
)
from train.depth import Pose
from train.simulation import SimulatedSensor
from train.skin import Nuisances, draw_gains, draw_rest, read_counts

SEED: Final = 20240228
"""The paper's day of publication; never to be changed, or no two figures can be compared."""

_CLASSICAL_SEQUENCES: Final = 3000
_CLASSICAL_EPOCHS: Final = 4
_DEMO_SURFACE: Final = "S"
_DEMO_ANGLE_DEG: Final = 30.0
_DEMO_RATE_HZ: Final = 100.0
_REST_FRAMES, _PRESS_FRAMES, _HOLD_FRAMES, _LIFT_FRAMES, _GAP_FRAMES = 150, 20, 24, 12, 24


def fit_classical(sensor: SimulatedSensor) -> dict[str, NDArray]:
    """Gain of bilinear interpolation, in mm per count, and the linear map (48, pixels), on random training taps."""
    rng = np.random.default_rng([SEED, 1])
    solved = solve_sequences(sensor, *random_poses(rng, _CLASSICAL_SEQUENCES))
    pairs = [
        pair
        for _ in range(_CLASSICAL_EPOCHS)
        for pair in training_batches(solved, rng, Nuisances(), sensor.geometry, 100, SET_FORCE_N)
    ]
    newest = np.concatenate([windows[:, 0] for windows, _ in pairs])
    patterns = np.concatenate([truth for _, truth in pairs])
    matrix = fit_linear_map(newest.reshape(len(newest), -1), patterns.reshape(len(patterns), -1))
    gain = fit_gain(bilinear(newest[:, 2], sensor.scale), patterns)
    return {"bilinear_gain": np.array(gain), "linear_map": matrix}


def demo_recording(sensor: SimulatedSensor) -> dict[str, NDArray]:
    """Four taps of one surface as a controller would send them, with the truth of every frame.

    The pad rests, then presses, holds and lifts four times, turned a step each time, at the held-out position.
    """
    rng = np.random.default_rng([SEED, 2])
    nuisances = Nuisances()
    pose = Pose(*position_mm(TEST_POSITION), _DEMO_ANGLE_DEG)
    solved = solve_sequences(sensor, [_DEMO_SURFACE] * MAX_TAPS, _demo_poses(pose))
    end_mm = solved.end_mm(np.full((MAX_TAPS, MAX_TAPS), TEST_FORCE_N))[:, 0]
    course = np.concatenate(
        [
            np.linspace(0, 1, _PRESS_FRAMES + 1)[1:],
            np.ones(_HOLD_FRAMES),
            np.linspace(1, 0, _LIFT_FRAMES + 1)[1:],
            np.zeros(_GAP_FRAMES),
        ]
    )
    share = np.concatenate([np.zeros(_REST_FRAMES), np.tile(course, MAX_TAPS)])
    tap = np.concatenate([np.full(_REST_FRAMES, -1), np.repeat(np.arange(MAX_TAPS), len(course))])
    gains = draw_gains(rng, nuisances, sensor.geometry, 1, MAX_TAPS)[0]
    depth_mm = share * end_mm[tap]
    counts = draw_rest(rng, sensor.geometry) + (solved.readings[:, 0] * gains)[tap] * depth_mm[:, None, None, None]
    frames = len(share)
    return {
        "format": np.array(NPZ_FORMAT),
        "version": np.array(NPZ_VERSION),
        "rate_hz": np.array(_DEMO_RATE_HZ),
        "sensor": np.full(frames, "4"),
        "scan": np.arange(frames),
        "time_ns": (np.arange(frames) * 1e9 / _DEMO_RATE_HZ).astype(np.int64),
        "counts": read_counts(rng, counts, nuisances).astype(np.int32),
        "tap": np.where(share > 0, tap, -1),
        "indentation_mm": depth_mm.astype(np.float32),
        "unit_patterns": solved.patterns.astype(np.float16),
        "surface": np.array(_DEMO_SURFACE),
        "angles_deg": np.array([pose.angle_deg for pose in _demo_poses(pose)]),
    }


def _demo_poses(last: Pose) -> list[Pose]:
    backs = reversed(range(MAX_TAPS))
    return [Pose(last.x_mm, last.y_mm, last.angle_deg - back * ANGLE_STEP_DEG) for back in backs]


def main(arguments: list[str] | None = None) -> None:
    """Write frozen.npz, classical.npz and demo.npz."""
    parser = argparse.ArgumentParser(prog="python -m train.freeze", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where to write frozen.npz, classical.npz and demo.npz")
    folder: Path = parser.parse_args(arguments).folder
    folder.mkdir(parents=True, exist_ok=True)
    sensor = SimulatedSensor(USPA44)
    frozen = freeze(sensor, TEST_POSITION, Nuisances(), SEED)
    frozen.save(folder / "frozen.npz")
    for name, arrays in (("classical", fit_classical(sensor)), ("demo", demo_recording(sensor))):
        np.savez_compressed(folder / f"{name}.npz", allow_pickle=False, **arrays)
    sys.stdout.write(f"{len(frozen)} frames of {len(frozen.surface)} taps, sha256 {frozen.sha256()}\n")


if __name__ == "__main__":
    main()
