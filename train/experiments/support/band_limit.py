"""Band limit of a pad: distances to a contact's edge, damping by the layer, and gratings to measure both."""

from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage

from edge.evaluation.test_set import FrozenSet
from firmware_bridge.pad_geometry import USPA44
from train.experiments.support.workbench import Workbench
from train.physics.elastic_layer import Layer, inner_displacement, surface_compliance
from train.physics.magnets import Magnet

WAVELENGTHS_MM: Final = (20.0, 14.0, 10.0, 7.0, 5.0, 3.0)
_GRATING_MM: Final = 60.0
_GRATING_HEIGHT_MM: Final = 2.0


def edge_distance_mm(touched: NDArray[np.bool_], scale: int) -> NDArray[np.float64]:
    """Return the distance of pixels (n, H, W) to the contact's edge, in [mm].

    The distance is below 0 inside the contact, and infinite where there is no edge.
    """
    pixel_mm = USPA44.pixel_pitch_mm(scale)
    distance_mm = np.full(touched.shape, np.inf)
    for tap, contact in enumerate(touched):
        if contact.any() and not contact.all():
            outside, inside = (np.asarray(ndimage.distance_transform_edt(side)) for side in (~contact, contact))
            # The edge lies halfway between the centres of two neighbouring pixels, so half a pixel is subtracted.
            pixels = np.where(contact, 0.5 - inside, outside - 0.5)
            distance_mm[tap] = pixel_mm * pixels
    return distance_mm


def let_through(wavelength_mm: ArrayLike) -> NDArray[np.float64]:
    """Return the share of a surface's wave that reaches the magnets, relative to an even press; 1 for long waves."""
    q_per_mm = 2 * np.pi / np.append(np.ravel(np.asarray(wavelength_mm, dtype=np.float64)), np.inf)
    layer = Layer()
    share = inner_displacement(layer, q_per_mm, Magnet().height_mm)[0] / surface_compliance(layer, q_per_mm)
    return (share[:-1] / share[-1]).reshape(np.shape(wavelength_mm))


def kept_back(patterns: NDArray[np.floating], scale: int) -> NDArray[np.float64]:
    """Return the part of patterns (n, H, W) that the layer keeps from magnets; windows are mirrored at the sides."""
    pixel_mm = USPA44.pixel_pitch_mm(scale)
    down_per_mm, right_per_mm = (np.arange(length) / (2 * length * pixel_mm) for length in patterns.shape[1:])
    waves_per_mm = np.hypot(down_per_mm[:, None], right_per_mm)
    with np.errstate(divide="ignore"):
        share = let_through(1 / waves_per_mm)
    spectrum = np.asarray(fft.dctn(patterns.astype(np.float64), axes=(1, 2), norm="ortho"))
    return np.asarray(fft.idctn(spectrum * (1 - share), axes=(1, 2), norm="ortho"))


def save_grating(path: Path, wavelength_mm: float) -> None:
    """Write a mesh of parallel bars, half a wavelength wide, that is wider than the pad."""
    count = int(_GRATING_MM // wavelength_mm)
    bars = []
    for number in range(count):
        bar = trimesh.creation.box([wavelength_mm / 2, _GRATING_MM, _GRATING_HEIGHT_MM])
        bar.apply_translation([(number - (count - 1) / 2) * wavelength_mm, 0.0, 0.0])
        bars.append(bar)
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.util.concatenate(bars).export(str(path))


def gratings(bench: Workbench) -> FrozenSet:
    """Return a frozen set of gratings of every wavelength; meshes that do not exist yet are written."""
    names: list[str] = []
    for wave_mm in WAVELENGTHS_MM:
        path = (bench.data_folder / "gratings" / f"grating-{wave_mm:g}.stl").resolve()
        if not path.exists():
            save_grating(path, wave_mm)
        names.append(f"mesh:{path}")
    return bench.frozen("test", names)
