"""Gratings: meshes of parallel bars, which a pad resolves down to a wavelength of its own."""

from pathlib import Path
from typing import Final

import trimesh

from edge.evaluation.test_set import FrozenSet
from train.experiments.support.workbench import Workbench

WAVELENGTHS_MM: Final = (20.0, 14.0, 10.0, 7.0, 5.0, 3.0)
_GRATING_MM: Final = 60.0
_GRATING_HEIGHT_MM: Final = 2.0


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
