"""Make the data that come with the models: the frozen test set, classical methods, taxels' covariance, recordings.

    python -m train.freeze edge/models --data data/gripped.npz

An existing frozen test set is kept, because models name it by its hash and processors round differently: delete it
to freeze it again.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import bicubic, bilinear, fit_gain, fit_linear_map, fitted_methods
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.perception.taxel_health import Kinds, load_estimator, ridged
from edge.terminal.progress_bar import tracked
from firmware_bridge.in_place import write_in_place
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from train.data.press_batches import read_presses
from train.data.presses import SEED, PressSet, join_presses, load_presses, one_thread
from train.demo import demo_recording, grip_recording
from train.errors import ended_by_errors
from train.families.catalogue import tap
from train.networks.symmetric import moved_scans
from train.physics.gripped import FINE_SCALE, FRAMES, MAX_INDENTATION_MM, SCALE, GrippedPad, between_frames
from train.physics.pad_draws import NOMINAL
from train.physics.sensor_noise import Nuisances, apply_nuisances, jitter_poses
from train.physics.tpsf import resample, resample_touching
from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, MAX_TAPS, PLACES_MM, TARGET_ANGLES_DEG, Split

TEST_FORCE_N: Final = 5.0  # at which every tap of a frozen set ends, unless the largest depth is reached before
CLASSICAL_WINDOWS: Final = 12_000
KINDS: Final = 16  # of contact: with more the error of a hidden taxel is less on figures alone
FIRST_FRAME: Final = 6  # frames of a press before those that are kept, from 30 % of the set force on, as in the paper
_PRESSED_TO_N: Final = 9.2  # force at which presses end; their courses lead to TEST_FORCE_N
_AT_ONCE: Final = 48  # sequences whose pose errors are drawn at once: so the bundled frozen set has its poses


@one_thread()
def freeze(
    surfaces: Sequence[str] = SURFACES,
    split: Split = "test",
    scale: int = SCALE,
    angle_step_deg: float = ANGLE_STEP_DEG,
) -> FrozenSet:
    """Return the frames of the paper's protocol, in the simulated world with one pad, and a sensor for each sequence.

    A sequence is MAX_TAPS whole taps of one flat figure by the nominal pad, each turned by a step from the one before
    and off by a robot's error; the newest, at the place of a split in four turns, is the target.

    Source: Wu and Liu 2024, Sec. V and Table II.
    """
    taps, names = MAX_TAPS, [name for name in surfaces for _ in TARGET_ANGLES_DEG]
    turns_deg = [angle - angle_step_deg * back for angle in TARGET_ANGLES_DEG for back in range(taps)]
    sent = [Pose(*PLACES_MM[split], turn_deg) for _ in surfaces for turn_deg in turns_deg]
    poses: list[Pose] = []
    while part := sent[len(poses) :][: _AT_ONCE * taps]:
        poses += jitter_poses(np.random.default_rng([SEED, len(poses) // (_AT_ONCE * taps)]), part)
    pad, numbers = GrippedPad(NOMINAL), tracked(range(len(names)), "tapping", "sequence")
    solved = [tap(pad, [names[at]] * taps, poses[at * taps : (at + 1) * taps], _PRESSED_TO_N) for at in numbers]
    true_poses = np.array(poses).reshape(-1, taps, 3)
    end_n = np.stack([sequence.force_n[:, -1] for sequence in solved])
    end_mm = np.stack([sequence.indentation_mm[0, -1] for sequence in solved])

    share = np.minimum(np.float64(TEST_FORCE_N) / end_n, 1.0)
    course = np.arange(1, FIRST_FRAME + FRAMES + 1) / (FIRST_FRAME + FRAMES)
    clean = between_frames(np.concatenate([sequence.counts for sequence in solved]), share.reshape(-1, 1) * course)
    presses = clean.reshape(*share.shape, *clean.shape[1:])
    readings = apply_nuisances(presses, Nuisances(), SEED, angle_deg=true_poses[..., 2])
    moments = share[:, :1] * course[FIRST_FRAME:]
    unit_patterns = np.stack([sequence.unit_patterns[0] for sequence in solved])
    return FrozenSet(
        newest=readings[:, 0, FIRST_FRAME:].reshape(-1, *readings.shape[3:]).astype(np.int16),
        earlier=readings[:, 1:, -1].astype(np.int16),
        tap=np.repeat(np.arange(len(share)), FRAMES).astype(np.int16),
        indentation_mm=(end_mm[:, None] * moments).ravel().astype(np.float32),
        force_n=(end_n[:, :1] * moments).ravel().astype(np.float32),
        unit_patterns=resample(unit_patterns, FINE_SCALE, scale).astype(np.float16),
        touched=resample_touching(np.stack([sequence.touching[0] for sequence in solved]), FINE_SCALE, scale),
        surface=np.array(names),
        angle_deg=true_poses[:, 0, 2].astype(np.float32),
        full_scale_mm=MAX_INDENTATION_MM,
    )


def fit_classical(taps: PressSet, windows: int = CLASSICAL_WINDOWS) -> dict[str, NDArray]:
    """Return the gains of bilinear and bicubic interpolation, in mm per count, and the linear map (48, pixels)."""
    newest, patterns = drawn(taps, windows)
    matrix = fit_linear_map(newest.reshape(len(newest), -1), patterns.reshape(len(patterns), -1))
    return {
        "bilinear_gain": np.array(fit_gain(bilinear(newest[:, 2], SCALE), patterns)),
        "bicubic_gain": np.array(fit_gain(bicubic(newest[:, 2], SCALE), patterns)),
        "linear_map": matrix,
    }


def fit_taxels(taps: PressSet, windows: int = 2 * CLASSICAL_WINDOWS) -> dict[str, NDArray]:
    """Return covariances (kinds, 48, 48) of healthy taxels' readings, all x first, with the pad in all four turns."""
    newest = drawn(taps, windows)[0]
    return {"covariances": fit_kinds(np.concatenate([moved_scans(newest, turns) for turns in range(4)]))}


def fit_kinds(readings: NDArray[np.floating], kinds: int = KINDS) -> NDArray[np.float32]:
    """Return covariances (kinds, 3 taxels, 3 taxels) of zeroed scans (n, 3, rows, cols), scaled to one strength.

    By expectation maximisation: kinds start with equally many scans, sorted by the share of taxels that read nearly as
    much as the strongest ones.
    """
    flat = readings.reshape(len(readings), -1).astype(np.float64)
    # Below 20 counts noise would be scaled up.
    flat /= np.maximum(np.sqrt(np.square(flat).mean(axis=1, keepdims=True)), 20.0)
    z = np.abs(flat[:, -readings.shape[2] * readings.shape[3] :])
    felt = (z / np.quantile(z, 0.9, axis=1, keepdims=True) > 0.5).mean(axis=1) + z.mean(axis=1) / 1e3
    weight = np.eye(kinds)[felt.argsort().argsort() * kinds // len(flat)]
    covariances = np.empty((kinds, flat.shape[1], flat.shape[1]), dtype=np.float64)
    for _ in range(10):
        for kind, share in enumerate(weight.T):
            covariances[kind] = (flat * share[:, None]).T @ flat / share.sum()
        fitted = Kinds(ridged(covariances))
        # In parts, to use less than a gigabyte.
        weight = np.concatenate([fitted.weigh(part) for part in np.array_split(flat, 40)])
    return covariances.astype(np.float32)


def drawn(taps: PressSet, windows: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return zeroed readings (n, 3, rows, cols) by different, healthy sensors, and patterns (n, H, W) in [mm]."""
    index = np.random.default_rng(SEED).permutation(len(taps))[np.arange(windows) % len(taps)]
    newest = taps.with_taps(1).pick(index)
    return read_presses(newest, Nuisances(), SEED)[:, 0], newest.patterns.astype(np.float32)


def main(arguments: list[str] | None = None) -> None:
    """Write classical.npz, taxels.npz, demo.npz, grip.npz, and frozen.npz where it does not exist."""
    parser = argparse.ArgumentParser(prog="python -m train.freeze", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder for these files")
    help_of_data = "taps to fit the classical methods and the taxels' covariance on"
    parser.add_argument("--data", type=Path, nargs="+", required=True, help=help_of_data)
    options = parser.parse_args(arguments)
    folder: Path = options.folder
    with ended_by_errors("freeze"):
        taps = join_presses([*map(load_presses, options.data)])
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "frozen.npz").exists():
            freeze().save(folder / "frozen.npz")
        frozen = load_frozen_set(folder / "frozen.npz")
        _save(folder / "classical.npz", fit_classical(taps), lambda draft: fitted_methods(draft, frozen.scale))
        grid = (USPA44.rows, USPA44.cols)
        _save(folder / "taxels.npz", fit_taxels(taps), lambda draft: load_estimator(draft, grid))
        _save(folder / "demo.npz", demo_recording(), load_recording)
        _save(folder / "grip.npz", grip_recording(), load_recording)
    sys.stdout.write(f"{len(frozen)} frames of {len(frozen.surface)} taps, sha256 {frozen.sha256()}\n")


def _save(path: Path, arrays: Mapping[str, NDArray[Any]], load: Callable[[Path], object]) -> None:
    write_in_place(path, lambda draft: np.savez_compressed(draft, allow_pickle=False, **arrays), load)


if __name__ == "__main__":
    main()
