"""Simulated world of grips: pads, families of shapes, depths and drags."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import ceil, inf
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import PADS, USPA44
from train.data.presses import VERSION, PressSet, join_presses, one_thread
from train.errors import DatasetError
from train.families.catalogue import SHARES, Tapped, draw_shape
from train.physics.gripped import FINE_SCALE, SCALE, GrippedPad
from train.physics.pad_draws import INPUTS, RANGES, Pad, constants, draw_pad
from train.physics.sensor_noise import log_uniform
from train.surfaces.meshes import MESH, mesh_file
from train.surfaces.named_surfaces import SURFACES, surface_mesh
from train.surfaces.poses import MAX_TAPS, schedule_of

INDENTATION_MM: Final = (0.03, 0.5)  # bounds of the uniform draw; the layer is linear up to the upper one
LEAST_FORCE_N: Final = 0.1  # of a press that is kept: twice that at which a contact is detected above the noise
MOST_DRAWS: Final = 40  # of a press of a user's mesh: of a sloping finger one in seven is kept, so that all are found


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Configuration that determines a set of presses."""

    count: int = 24_000  # sequences drawn; light ones are left out, or drawn again where they are of a user's mesh
    taps: int = 1  # presses in each sequence
    schedule: str = "mixed"  # of the taps' poses, see train.surfaces.poses.schedule_of
    begun: float = 0.5  # share of sequences whose newest tap has only begun, while the earlier ones are at their ends
    per_pad: int = 24  # sequences of one pad
    families: Mapping[str, float] = field(default_factory=lambda: dict(SHARES))  # frequency of families or figures
    spread: float = 1.0  # of the pads' constants, 1 for the whole ranges, 0 for the nominal pad
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=lambda: dict(RANGES))  # of the pads' constants
    seed: int = 1
    scale: int = SCALE  # pattern pixels per taxel pitch
    pad: str = USPA44.name  # model of the pads, one of firmware_bridge.pad_geometry.PADS

    def __post_init__(self) -> None:
        bounds = {"count": (1, inf), "taps": (1, MAX_TAPS), "per_pad": (1, inf), "scale": (1, FINE_SCALE)}
        bounds |= {"spread": (0, 1), "begun": (0, 1), "seed": (0, inf)}
        for name, (low, high) in bounds.items():
            if not low <= (value := getattr(self, name)) <= high:
                expected = f"{low} or more" if high == inf else f"{low} to {high}"
                raise DatasetError(f"{name} is {value}, expected {expected}")
        try:
            schedule_of(self.schedule)
        except ValueError as error:
            raise DatasetError(str(error)) from error
        if self.pad not in {pad.name for pad in PADS}:
            raise DatasetError(f"pad is {self.pad!r}, expected one of {', '.join(pad.name for pad in PADS)}")
        known = {*SHARES, *SURFACES}
        unknown = [name for name in self.families if name not in known and not name.startswith(MESH)]
        if unknown or not self.families:
            named = ", ".join(map(repr, unknown)) if unknown else "named"
            raise DatasetError(f"no family {named}: expected some of {', '.join(SHARES)}, or a mesh")
        for name, share in self.families.items():
            if not 0 < share < inf:
                raise DatasetError(f"frequency of {name} is {share}, expected more than 0")
            if name.startswith(MESH):
                surface_mesh(name)  # checked before any work, because meshes fail most often

    @property
    def chunks(self) -> int:
        """Number of chunks, each with one pad."""
        return ceil(self.count / self.per_pad)

    def facts(self) -> dict[str, Any]:
        """Return the configuration as read from JSON, with the ranges of the pads' constants and the meshes' hashes."""
        facts = asdict(self) | {
            "families": dict(self.families),
            "ranges": {name: list(bounds) for name, bounds in self.ranges.items()},
            "inputs": list(INPUTS),
            "version": VERSION,
        }
        if self.scale == SCALE:
            del facts["scale"]  # what was made before there was a choice keeps its name
        if self.pad == USPA44.name:
            del facts["pad"]
        meshes = [name for name in self.families if name.startswith(MESH)]
        if meshes:  # the content under a name may change
            hashes = {name: hashlib.sha256(mesh_file(name)[0].read_bytes()).hexdigest() for name in meshes}
            facts |= {"meshes": hashes, "most_draws": MOST_DRAWS}
        return facts


@one_thread()
def solve_pad(world: World, number: int) -> PressSet:
    """Solve all sequences of one pad; the result does not depend on other pads."""
    rng = np.random.default_rng([world.seed, number])
    pad = draw_pad(rng, world.spread, world.ranges) if world.spread else Pad()
    gripped = GrippedPad(replace(pad, model=world.pad))
    count = min(world.per_pad, world.count - number * world.per_pad)
    shares = np.array(list(world.families.values()), dtype=float)
    # Families alternate over the pads, so that a small set has all of them.
    order = np.random.default_rng([world.seed, 0, 1]).permutation(world.count)[number * world.per_pad :][:count]
    at = (order + 0.5) / world.count
    family = np.array(list(world.families))[np.searchsorted(np.cumsum(shares / shares.sum()), at)]
    schedule = schedule_of(world.schedule)
    kept: list[PressSet] = []
    for _ in range(MOST_DRAWS):
        tapped = [draw_shape(rng, str(name), gripped, schedule(rng, world.taps)) for name in family]
        made = press_shapes(rng, gripped, family, tapped, world.begun, world.scale)
        right = (made.force_n[:, 2] > LEAST_FORCE_N) & made.touching.any(axis=(1, 2))
        kept.append(made.pick(right))
        family = family[~right & np.char.startswith(family, MESH)]
        if not len(family):
            break
    made = join_presses(kept)
    return replace(made, pad=np.full(len(made), number, dtype=np.int64))


def press_shapes(
    rng: np.random.Generator,
    gripped: GrippedPad,
    family: NDArray[np.str_],
    tapped: list[Tapped],
    begun: float = 0.0,
    scale: int = SCALE,
) -> PressSet:
    """Press shapes onto a pad with drawn depths, drags and friction; light presses are kept.

    In a share `begun` of the sequences the newest tap is not as deep yet as the earlier ones were at their ends.
    """
    n, taps = len(tapped), len(tapped[0].heights_mm)
    depths_mm = np.repeat(rng.uniform(*INDENTATION_MM, n)[:, None], taps, axis=1)
    depths_mm[:, 1:] *= rng.uniform(0.85, 1.15, (n, taps - 1))  # ends of taps differ
    only_begun = rng.random(n) < begun
    depths_mm[only_begun, 1:] /= rng.uniform(0.2, 1, (int(only_begun.sum()), 1))
    depth_mm = depths_mm.ravel()
    dragged = rng.random(n * taps) > 0.35  # half of these are twisted as well
    way = rng.uniform(0, 2 * np.pi, n * taps)
    far = log_uniform(rng, 0.02, 0.6, (n * taps,)) * dragged
    twist = rng.normal(0, 0.03, n * taps) * (dragged & (rng.random(n * taps) < 0.5))
    done = gripped.press(
        np.concatenate([one.heights_mm for one in tapped]),
        np.clip(depth_mm, *INDENTATION_MM),
        np.stack([far * np.cos(way), far * np.sin(way)], axis=1),
        twist,
        rng.uniform(0.2, 1.2, n * taps),  # Coulomb's coefficient: polished steel to rubber on silicone
        [one.cover for one in tapped for _ in range(taps)],
        scale=scale,
    )
    newest = {name: getattr(done, name)[::taps] for name in ("touching", "force_n", "twist_nmm", "indentation_mm")}
    return PressSet(
        family=family,
        pad=np.zeros(n, dtype=np.int64),
        constants=np.tile(constants(gripped.pad), (n, 1)),
        counts=done.counts.reshape(n, taps, *done.counts.shape[1:]),
        angle_deg=np.array([one.angle_deg for one in tapped], dtype=np.float32),
        poses=np.array([one.poses for one in tapped], dtype=np.float32),
        patterns=done.patterns[::taps].astype(np.float16),
        traction_kpa=done.traction_kpa[::taps].astype(np.float16),
        **newest,
    )
