"""Surfaces under recorded taps: which part lies under the pad at a pose, and whether the poses are right.

Where the plate lies and how the pad is mounted was measured by someone to some tenths of a millimetre. These six
numbers are fitted first: at the right ones the readings of all taps look like those of the simulated pad.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib.image
import numpy as np
from numpy.typing import NDArray

from train.data.recorded_taps import RecordedTap
from train.errors import DatasetError, SurfaceError
from train.physics.gripped import MAX_INDENTATION_MM, SAMPLES, GrippedPad, Taps
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.meshes import load_mesh
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM
from train.surfaces.poses import over_surface

Surface = Callable[[Pose, GrippedPad], NDArray[np.float32]]
"""Function from a pose over a surface to its heights (m, m) in [mm] at the places of a pad."""
FIT_FROM: Final = 30  # taps by which the poses are fitted
_STEPS: Final = np.array([0.2, 0.2, 0.5, 0.2, 0.2, 0.5])  # by which the effect of a pose is found, in [mm] and [deg]
LEAST_LIKENESS: Final = 0.8
_FLAT_MM: Final = 0.1  # depth below the top at which a part of a flat figure carries nothing


def surface_of(path: Path, unit_mm: float = 1.0, pixel_mm: float = 0.1) -> Surface:
    """Return the surface of a mesh or of a depth image, PNG, whose middle is the origin of the poses.

    MeshError or DatasetError if it cannot be read.
    """
    if path.suffix.lower() != ".png":
        relief = Relief(path.name, load_mesh(path, unit_mm))
        return lambda pose, pad: -depth_image(relief, pose, pad.size * SAMPLES, pad.cell_mm / SAMPLES)
    try:
        image = matplotlib.image.imread(path)
    except (ValueError, SyntaxError) as error:
        raise DatasetError(f"{path} is no PNG file, or a damaged one: {error}") from error
    return image_surface(image if image.ndim == 2 else image[..., :3].mean(axis=2), pixel_mm)


def image_surface(image: NDArray[np.floating], pixel_mm: float) -> Surface:
    """Return the surface of a depth image (H, W) seen from above: figures are its brighter half."""
    high = image > (float(image.min()) + float(image.max())) / 2

    def heights(pose: Pose, pad: GrippedPad) -> NDArray[np.float32]:
        right_mm, down_mm = pad.places_mm
        cosine, sine = np.cos(np.radians(pose.angle_deg)), np.sin(np.radians(pose.angle_deg))
        x_mm, y_mm = (pose.x_mm + cosine * right_mm + sine * down_mm, pose.y_mm + sine * right_mm - cosine * down_mm)
        row, column = (
            np.floor(n / 2 + mm / pixel_mm).astype(int) for n, mm in zip(high.shape, (-y_mm, x_mm), strict=True)
        )
        inside = (row >= 0) & (row < len(high)) & (column >= 0) & (column < high.shape[1])
        drawn = np.where(high[np.where(inside, row, 0), np.where(inside, column, 0)], 0.0, -FIGURE_HEIGHT_MM)
        return np.where(inside, drawn, -NOTHING_MM).astype(np.float32)

    return heights


class Placed(NamedTuple):
    """Poses of the plate in the frame of the stated poses, and of the pad in its own, as fitted."""

    moved: NDArray[np.float64]  # (6,), x, y in [mm] and turn in [deg] of each
    likeness: tuple[float, float] = (0.0, 0.0)  # median correlation of z with the simulated pad's, before and after

    def __call__(self, pose: Pose) -> Pose:
        """Return the pose over the surface of a stated one."""
        x_mm, y_mm, turn_deg, right_mm, down_mm, pad_deg = self.moved
        plate = over_surface(Pose(x_mm, y_mm, turn_deg), pose.x_mm, -pose.y_mm, -pose.angle_deg)
        return over_surface(plate, right_mm, down_mm, -pad_deg)

    def told(self) -> str:
        """Return it in a line."""
        x_mm, y_mm, turn_deg, right_mm, down_mm, pad_deg = self.moved
        before, after = self.likeness
        return (
            f"they fit best with the surface moved by {x_mm:.2f}, {y_mm:.2f} mm and {turn_deg:.1f} deg, the pad by "
            f"{right_mm:.2f}, {down_mm:.2f} mm and {pad_deg:.1f} deg: likeness {before:.3f} -> {after:.3f}"
        )


def placed(taps: Sequence[RecordedTap], surface: Surface, pad: GrippedPad) -> Placed:
    """Fit the poses of plate and pad by Gauss-Newton; DatasetError if the readings do not fit the surface."""
    some = [taps[number] for number in np.unique(np.linspace(0, len(taps) - 1, FIT_FROM).astype(int))]
    wanted = _shape(np.stack([tap.counts[-1, 2] for tap in some]))

    def made(moved: NDArray[np.float64]) -> NDArray[np.float64]:
        return _shape(pressed([Placed(moved)(tap.pose) for tap in some], surface, pad).counts[:, -1, 2])

    moved, now = np.zeros(6), made(np.zeros(6))
    before = float(np.median((now * wanted).sum(axis=1)))
    for _ in range(3):
        slopes = np.stack([(made(moved + step) - now).ravel() / step.sum() for step in np.diag(_STEPS)], axis=1)
        moved = moved + np.linalg.lstsq(slopes, (wanted - now).ravel(), rcond=1e-3)[0].clip(-2, 2)
        now = made(moved)
    found = Placed(moved, (before, float(np.median((now * wanted).sum(axis=1)))))
    if not found.likeness[1] >= LEAST_LIKENESS:
        raise DatasetError(
            f"the readings do not fit what lies under the poses: likeness {found.likeness[1]:.2f}, at least "
            f"{LEAST_LIKENESS} expected; are the poses those of this surface, from its middle, in mm, y down?"
        )
    return found


def _shape(z: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return z (n, rows, cols) as rows (n, taxels) without their mean, of length 1."""
    flat = z.reshape(len(z), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)


def pressed(poses: Sequence[Pose], surface: Surface, pad: GrippedPad) -> Taps:
    """Return taps of the simulated pad at these poses, to the largest indentation.

    DatasetError if the surface is not under a pose, or is not a flat figure there.
    """
    try:
        heights_mm = np.stack([surface(pose, pad) for pose in poses])
        depth_mm = heights_mm.max(axis=(1, 2), keepdims=True) - heights_mm
        top = depth_mm < _FLAT_MM
        if ((depth_mm < MAX_INDENTATION_MM) & ~top).sum() > 0.2 * top.sum():
            raise DatasetError(
                "the surface is curved under the pad, expected flat figures: for curved parts use --mesh"
            )
        return pad.tap(heights_mm, np.inf)
    except (ValueError, SurfaceError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"the pad never touches the surface at a pose: {error}") from error
