"""Field of the magnets: close to the chip, tilted, pressed through it; dipole compared with the exact cylinder."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from export.stability.case import Case, refused, timed
from firmware_bridge.pad_geometry import USPA44
from train.physics.magnets import MOVEMENT, Magnet, MagnetArray, cylinder_mt, dipole_mt

PART: Final = "magnet reading"
_NEAREST: Final = 0.75
"""Least distance from the magnet's face to the chip for a dipole, in diameters."""
_DIPOLE: Final = 0.3
"""Largest accepted error of a dipole, above which it is refused. The reading's scale is calibrated away."""


def cases(_quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    magnet = Magnet()
    # Distances are from the magnet's centre to the chip; with .2 mm of clearance the magnet nearly touches it.
    for centre_mm in (2.0, 1.5, 1.0, 0.95, 0.7, 0.45):
        for tilt_deg in (0.0, 30.0, 60.0):
            yield _against_cylinder(magnet, centre_mm, tilt_deg)
    arrays = {dtype: MagnetArray(USPA44, magnet) for dtype in (np.float32, np.float64)}
    rng = np.random.default_rng(0)
    for size_mm in (1e-6, 1e-3, 0.1, 0.5, 0.9):
        moved = rng.uniform(-size_mm, size_mm, (100, USPA44.taxel_count, len(MOVEMENT)))
        single, run_ms = timed(lambda moved=moved: arrays[np.float32].change_mt(moved.astype(np.float32)))
        double = arrays[np.float64].change_mt(moved)
        apart = float(np.abs(single - double).max())
        noise_mt = 2e-3  # two counts
        yield Case(
            PART,
            "movement",
            f"{size_mm:g} mm",
            "float32 to float64, mT",
            apart,
            noise_mt,
            run_ms,
            note="two counts are 2e-3",
        )
    still = MagnetArray(USPA44, magnet).change_mt(np.zeros((1, USPA44.taxel_count, len(MOVEMENT)), np.float32))
    yield Case(PART, "movement", "none", "change, mT", float(np.abs(still).max()), 0.0)
    exact = MagnetArray(USPA44, magnet, "cylinder")
    through = np.zeros((1, USPA44.taxel_count, len(MOVEMENT)), np.float32)
    through[..., MOVEMENT.index("down_mm")] = magnet.clearance_mm
    yield refused(PART, "movement", "through the chip", lambda: exact.change_mt(through), ValueError, "into its chip")
    yield refused(PART, "magnet", "touches its chip", lambda: replace(magnet, height_mm=0.7), ValueError)


def _against_cylinder(magnet: Magnet, centre_mm: float, tilt_deg: float) -> Case:
    tilt = np.radians(tilt_deg)
    away = (np.zeros(1), np.zeros(1), np.array([-centre_mm]))
    axis = (np.array([np.sin(tilt)]), np.zeros(1), np.array([np.cos(tilt)]))
    (b, run_ms), true = (
        timed(lambda: np.array(dipole_mt(magnet, away, axis))),
        np.array(cylinder_mt(magnet, away, axis)),
    )
    apart = float(np.linalg.norm(b - true) / np.linalg.norm(true))
    severity = f"{centre_mm - magnet.thickness_mm / 2:g} mm clear, {tilt_deg:g} deg"
    if centre_mm - magnet.thickness_mm / 2 >= _NEAREST:
        return Case(PART, "dipole", severity, "to the exact cylinder", apart, _DIPOLE, run_ms)
    near = replace(magnet, height_mm=magnet.chip_height_mm + centre_mm)
    return refused(
        PART, "dipole", f"{severity}, {apart:.0%} off", lambda: MagnetArray(USPA44, near), ValueError, "dipole"
    )
