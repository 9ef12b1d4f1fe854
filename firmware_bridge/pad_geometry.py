"""Geometry of a sensor's taxels. Row-major from the top left; x to the right, y down.

The CAN ids of each are in `firmware_bridge.scans.can_id_maps`.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class SensorGeometry:
    """Grid of taxels of one sensor model; lengths in [mm]."""

    name: str
    rows: int
    cols: int
    pitch_mm: float
    width_mm: float
    height_mm: float

    @property
    def taxel_count(self) -> int:
        """Number of taxels."""
        return self.rows * self.cols

    @property
    def scan_shape(self) -> tuple[int, int, int]:
        """Shape of a scan: (axes, rows, cols)."""
        return (len(AXES), self.rows, self.cols)

    @property
    def corners(self) -> tuple[int, int, int, int]:
        """Taxels on the corners: top left, top right, bottom right, bottom left."""
        return (0, self.cols - 1, self.taxel_count - 1, self.taxel_count - self.cols)

    def taxel_centres_mm(self) -> NDArray[np.float64]:
        """Return the centres of the taxels, (taxel_count, 2), x then y in [mm] from the sensor's centre."""
        x_mm = (np.arange(self.cols) - (self.cols - 1) / 2) * self.pitch_mm
        y_mm = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_mm
        grid_x_mm, grid_y_mm = np.meshgrid(x_mm, y_mm)
        return np.stack([grid_x_mm.ravel(), grid_y_mm.ravel()], axis=1).astype(np.float64)

    def pixel_pitch_mm(self, scale: int) -> float:
        """Return the distance of neighbouring pixels of a pattern at x`scale`, in [mm]."""
        return self.pitch_mm / scale

    def pattern_shape(self, scale: int) -> tuple[int, int]:
        """Return the shape (H, W) of a pattern at x`scale`."""
        return (self.rows * scale, self.cols * scale)


USPA44: Final = SensorGeometry("uSPa44", rows=4, cols=4, pitch_mm=4.7, width_mm=20.0, height_mm=20.0)
TAXELS: Final = USPA44.taxel_count  # of the default pad
CHANNELS: Final = len(AXES) * TAXELS
USPA46: Final = SensorGeometry("uSPa46", rows=4, cols=6, pitch_mm=7.25, width_mm=43.5, height_mm=29.0)
"""Pad uSPa46, with an assumed outline of half a pitch beyond the outer taxels."""
PADS: Final = (USPA44, USPA46)  # pads with a name of their own
MOST_TAXELS: Final = 64  # most taxels of a sensor: the bits of the masks in records and files


def pad_of(rows: int, cols: int) -> SensorGeometry:
    """Return the pad of PADS with this grid, or for a recording of another one a geometry without a pitch."""
    named = next((pad for pad in PADS if (pad.rows, pad.cols) == (rows, cols)), None)
    return named or SensorGeometry(f"unknown {rows}x{cols}", rows, cols, np.nan, np.nan, np.nan)
