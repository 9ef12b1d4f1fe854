"""The paper's protocol in the simulated world: its figures, whole taps from first contact to full force, one pad.

A sequence is K taps of one figure by the nominal pad, each turned by a step from the one before; the newest is the
target. Each tap has FRAMES frames, so that readings and truth are available at any lower force: frame i lies at
(i + 1) / FRAMES of the press, readings at 0 are zero, and values between frames are interpolated linearly.

Networks of the paper are trained on presses of the same pad and schedule:

    python -m train.data.make_presses data/paper.npz --families paper --schedule turns --spread 0 --taps 7

Source: Wu and Liu 2024, Sec. V and Table II.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.terminal.progress_bar import tracked
from train.data.presses import SEED, one_thread
from train.families.catalogue import heights_of
from train.physics.gripped import FINE_SCALE, FRAMES, GrippedPad, Taps
from train.physics.pad_draws import NOMINAL
from train.physics.sensor_noise import Nuisances, Seed, jitter_poses, read_windows
from train.physics.tpsf import resample, resample_touching
from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, MAX_TAPS, PLACES_MM, TARGET_ANGLES_DEG, Split

FORCE_N: Final = 9.2  # force at which presses end, so that set forces up to 8 N with 15 % of spread lie on them
_AT_ONCE: Final = 48  # sequences whose pose errors are drawn at once: so the bundled frozen set has its poses
_PER_TAP: Final = ("poses", "counts", "force_n", "indentation_mm")


@dataclass(frozen=True, slots=True)
class PaperTaps:
    """n sequences of K clean whole taps, newest first."""

    surfaces: NDArray[np.str_]  # (n,) names
    poses: NDArray[np.float64]  # (n, K, 3), true ones of the pad: x, y in [mm], angle in [deg]
    counts: NDArray[np.float32]  # (n, K, FRAMES, 3, rows, cols), zeroed, without nuisances
    force_n: NDArray[np.float32]  # (n, K, FRAMES), in [N]
    indentation_mm: NDArray[np.float32]  # (n, K, FRAMES), in [mm], even steps
    unit_patterns: NDArray[np.float32]  # (n, H, W) of the newest tap, deformation per indentation
    touching: NDArray[np.bool_]  # (n, H, W), pixels that the surface touches
    scale: int = FINE_SCALE  # pattern pixels per taxel pitch

    def __len__(self) -> int:
        return len(self.surfaces)

    @property
    def taps(self) -> int:
        """Number of taps in a sequence, K."""
        return self.counts.shape[1]

    def newest(self, taps: int) -> "PaperTaps":
        """Return the sequences with only their newest `taps` taps."""
        return replace(self, **{name: getattr(self, name)[:, :taps] for name in _PER_TAP})

    def pick(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> "PaperTaps":
        """Return the sequences at the indices."""
        names = ("surfaces", *_PER_TAP, "unit_patterns", "touching")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def at_scale(self, scale: int) -> "PaperTaps":
        """Return the sequences with the truth at another scale."""
        return replace(
            self,
            unit_patterns=resample(self.unit_patterns, self.scale, scale),
            touching=resample_touching(self.touching, self.scale, scale),
            scale=scale,
        )

    def share_at_force(self, index: NDArray[np.integer], force_n: ArrayLike) -> NDArray[np.float64]:
        """Return the shares (B, K) of presses at which they reach their set forces in [N]; 1 if a press ends before."""
        return np.minimum(np.asarray(force_n, dtype=np.float64) / self.force_n[index, :, -1], 1.0)

    def patterns_at(self, index: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the truth of the newest tap, (B, H, W) in [mm], at shares (B,) of its press."""
        depth_mm = (self.indentation_mm[index, 0, -1] * share).astype(np.float32)
        return self.unit_patterns[index] * depth_mm[:, None, None]


@one_thread()
def paper_taps(
    split: Split, surfaces: Sequence[str] = SURFACES, taps: int = MAX_TAPS, angle_step_deg: float = ANGLE_STEP_DEG
) -> PaperTaps:
    """Tap each flat surface at the places of a split, in four turns; poses and truth are off by a robot's error."""
    pad = GrippedPad(NOMINAL)
    names = [name for name in surfaces for _ in TARGET_ANGLES_DEG]
    turns_deg = [angle - angle_step_deg * back for angle in TARGET_ANGLES_DEG for back in range(taps)]
    sent = [Pose(*PLACES_MM[split], turn_deg) for _ in surfaces for turn_deg in turns_deg]
    poses: list[Pose] = []
    while part := sent[len(poses) :][: _AT_ONCE * taps]:
        rng = np.random.default_rng([SEED, len(poses) // (_AT_ONCE * taps)])
        poses += jitter_poses(rng, part, Nuisances())
    numbers = tracked(range(len(names)), "tapping", "sequence")
    solved = [tap(pad, [names[at]] * taps, poses[at * taps : (at + 1) * taps], FORCE_N) for at in numbers]
    return PaperTaps(
        surfaces=np.array(names),
        poses=np.array(poses).reshape(-1, taps, 3),
        counts=np.stack([one.counts for one in solved]),
        force_n=np.stack([one.force_n for one in solved]),
        indentation_mm=np.stack([one.indentation_mm for one in solved]),
        unit_patterns=np.stack([one.unit_patterns[0] for one in solved]),
        touching=np.stack([one.touching[0] for one in solved]),
    )


def tap(pad: GrippedPad, surfaces: Sequence[str], poses: Sequence[Pose], force_n: float) -> Taps:
    """Return whole taps of flat surfaces, each from a pose over it."""
    heights_mm = [heights_of(surface, pose, pad) for surface, pose in zip(surfaces, poses, strict=True)]
    return pad.tap(np.stack(heights_mm), force_n)


def windows(
    sequences: PaperTaps, index: NDArray[np.integer], force_n: ArrayLike, nuisances: Nuisances, seed: Seed
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return windows (B, K, 3, rows, cols) in whole zeroed counts, and the newest taps' truth (B, H, W) in [mm].

    Every tap is read at its force in [N], broadcast to (B, K), by one sensor for each of the B sequences.
    """
    share = sequences.share_at_force(index, force_n)
    readings = read_windows(sequences.counts[index], share, nuisances, seed, None, sequences.poses[index, :, 2])
    return readings, sequences.patterns_at(index, share[:, 0])


def between_frames(frames: NDArray[np.float32], share: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return values (b, m, ...) at shares (b, m) of presses, between frames (b, FRAMES, ...) and 0 at the start."""
    away = np.abs(share[..., None] * FRAMES - np.arange(1, FRAMES + 1))
    weights = np.maximum(1 - away, 0).astype(np.float32)
    return (weights @ frames.reshape(*frames.shape[:2], -1)).reshape(*share.shape, *frames.shape[2:])
