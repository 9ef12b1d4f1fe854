"""Configuration of a dataset: surfaces, poses and presses, in chunks that depend on it and their number alone."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import ceil, isfinite
from typing import Any, Final, Literal

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import PADS, USPA44
from train.data.dataset import Sequences, join
from train.errors import DatasetError, TrainError
from train.physics.elastic_layer import Layer
from train.physics.magnets import Magnet
from train.physics.sensor_noise import Nuisances, jitter_poses
from train.physics.simulated_sensor import SimulatedSensor
from train.physics.taxel_response import IN_PLANE_SHARE
from train.physics.tpsf import BETA_MM
from train.surfaces.depth_image import SAMPLES
from train.surfaces.meshes import MESH, mesh_file
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import (
    ANGLE_STEP_DEG,
    MAX_TAPS,
    Split,
    Targets,
    as_poses,
    paper_targets,
    positions_of,
    random_targets,
    turned_back,
)

SEED: Final = 20240228
"""Seed of all frozen sets: the paper's day of publication. It must never change, or figures cannot be compared."""
FORCE_N: Final = 9.2
"""Force at which presses end, so that set forces up to 8 N with 15 % of spread lie on them."""
_FIGURES_PER_SEED: Final = 1_000_000
_PADS: Final = {pad.name: pad for pad in PADS}


@dataclass(frozen=True, slots=True, kw_only=True)
class Generation:
    """Configuration that determines a dataset.

    Attributes:
        surfaces: names, used in turn by random poses.
        poses: the paper's schedule, or poses drawn at random.
        split: positions of the paper's schedule; random poses always keep away from the held-out ones.
        count: sequences with random poses; the paper's schedule has its own number.
        taps: K.
        angle_step_deg: turn between taps.
        force_n: at which presses end, unless they reach the sensor's largest depth before.
        pose_error_mm: of every tap, as in Nuisances; the truth is that of the true pose.
        pose_error_deg: the same of its angle.
        seed: of the poses.
        chunk: sequences solved at once.
        pad: name of the sensor model.
    """

    surfaces: tuple[str, ...] = SURFACES
    poses: Literal["random", "paper"] = "random"
    split: Split = "train"
    count: int = 9000
    taps: int = 4
    angle_step_deg: float = ANGLE_STEP_DEG
    force_n: float = FORCE_N
    pose_error_mm: float = Nuisances().pose_error_mm
    pose_error_deg: float = Nuisances().pose_error_deg
    seed: int = 1
    chunk: int = 48
    pad: str = USPA44.name

    def __post_init__(self) -> None:
        object.__setattr__(self, "surfaces", tuple(self.surfaces))  # a list, if it comes from JSON
        if not self.surfaces:
            raise DatasetError("no surfaces to tap: name some, or ask for glyphs, polygons or a mesh")
        if not (isfinite(self.force_n) and self.force_n > 0):
            raise DatasetError(f"force_n is {self.force_n}, expected more than 0 N")
        if not 0 <= self.angle_step_deg <= 180:
            raise DatasetError(f"angle_step_deg is {self.angle_step_deg}, expected 0 to 180")
        if self.pad not in _PADS:
            raise DatasetError(f"pad is {self.pad!r}, expected one of {', '.join(_PADS)}")
        if self.seed < 0:
            raise DatasetError(f"seed is {self.seed}, expected 0 or more")
        for name, value, most in (
            ("taps", self.taps, MAX_TAPS),
            ("count", self.count, None),
            ("chunk", self.chunk, None),
        ):
            if value < 1 or (most and value > most):
                raise DatasetError(
                    f"{name} is {value}, expected 1 to {most}" if most else f"{name} is {value}, expected 1 or more"
                )

    @property
    def sequences(self) -> int:
        """Number of sequences."""
        return self.count if self.poses == "random" else len(self._paper_targets())

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return ceil(self.sequences / self.chunk)

    def facts(self) -> dict[str, Any]:
        """Return the configuration as read from JSON, with the simulator's constants: other files are stale."""
        world = {
            "layer": asdict(Layer()),
            "magnet": asdict(Magnet()),
            "in plane": IN_PLANE_SHARE,
            "beta mm": BETA_MM,
            "samples of a cell": SAMPLES,
        }
        facts = asdict(self) | {"surfaces": list(self.surfaces), "world": world}
        if self.pad == USPA44.name:
            del facts["pad"]  # what was made before there was a choice keeps its name
        meshes = {name: mesh_sha256(name) for name in self.surfaces if name.startswith(MESH)}
        return facts | ({"meshes": meshes} if meshes else {})

    def targets(self, chunk: int, rng: np.random.Generator) -> Targets:
        """Return the targets of one chunk."""
        first = chunk * self.chunk
        if self.poses == "random":
            return random_targets(rng, min(self.chunk, self.count - first), self.surfaces, first)
        targets, part = self._paper_targets(), slice(first, first + self.chunk)
        return Targets(targets.surfaces[part], targets.poses[part])

    def _paper_targets(self) -> Targets:
        return paper_targets(positions_of(self.split), self.surfaces)


def mesh_sha256(name: str) -> str:
    """Return the hash of a user's file, because the content under a name may change."""
    try:
        return hashlib.sha256(mesh_file(name)[0].read_bytes()).hexdigest()
    except OSError as error:
        raise DatasetError(f"{name} cannot be read: {error.strerror or error}") from error


def random_figures(glyphs: int, polygons: int, seed: int) -> tuple[str, ...]:
    """Return names of random figures; those of different seeds have nothing in common.

    Raises:
        DatasetError: more than one seed provides.
    """
    if not 0 <= min(glyphs, polygons) <= max(glyphs, polygons) <= _FIGURES_PER_SEED:
        raise DatasetError(f"{glyphs} glyphs and {polygons} polygons: expected 0 to {_FIGURES_PER_SEED} of each")
    first = seed * _FIGURES_PER_SEED
    return (
        *(f"glyph:{first + i}" for i in range(glyphs)),
        *(f"polygon:{first + i}" for i in range(polygons)),
    )


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


@one_thread()
def solve_chunk(config: Generation, chunk: int) -> Sequences:
    """Tap the sequences of one chunk; the result is the same on every machine of a kind, whatever was solved before."""
    rng = np.random.default_rng([config.seed, chunk])
    targets = config.targets(chunk, rng)
    sent = as_poses(turned_back(targets, config.taps, config.angle_step_deg))
    error = Nuisances(pose_error_mm=config.pose_error_mm, pose_error_deg=config.pose_error_deg)
    poses = jitter_poses(rng, sent, error)
    names = [name for name in targets.surfaces for _ in range(config.taps)]
    newest = np.arange(len(poses)) % config.taps == 0
    try:
        solved = _sensor(config.pad).tap(names, poses, config.force_n, newest)
    except TrainError:
        raise
    except ValueError as error:  # nothing under the pad: a user's mesh is smaller than the poses' reach
        raise DatasetError(f"chunk {chunk}: {error}") from error
    shape = (len(targets), config.taps)
    indentation_mm = solved.indentation_mm[newest]
    maps = solved.patterns.shape[1]
    return Sequences(
        surfaces=np.array(targets.surfaces),
        poses=np.array([(pose.x_mm, pose.y_mm, pose.angle_deg) for pose in poses]).reshape(*shape, 3),
        counts=solved.counts.reshape(*shape, *solved.counts.shape[1:]),
        force_n=solved.force_n.reshape(*shape, -1),
        indentation_mm=solved.indentation_mm.reshape(*shape, -1),
        unit_patterns=(solved.patterns / indentation_mm[:, -maps:, None, None]).astype(np.float16),
        touching=solved.touching,
        seed=config.seed,
        config=config.facts(),
    )


def solve_all(config: Generation) -> Sequences:
    """Solve all chunks, one after the other, for small sets that need no file."""
    return join([solve_chunk(config, chunk) for chunk in tracked(range(config.chunks), "solving", "chunk")])


@lru_cache(maxsize=1)
def _sensor(pad: str) -> SimulatedSensor:
    return SimulatedSensor(_PADS[pad])
