"""Inputs of the golden records: presses on a pad made by arithmetic alone, also as bytes of a link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

PITCH_MM = 4.7
PLACES_MM = (np.arange(4) - 1.5) * PITCH_MM
REST = np.array([16_000, 16_400, 38_600])[:, None, None] + 37 * np.arange(16).reshape(4, 4)
FREE_SCANS = 110
"""Scans of the free pad before the first press: those of a zeroing, and some."""
TAP_SCANS = 40
ABSENT = -1


@dataclass(frozen=True)
class Press:
    """Round press: its place and radius in [mm], the z of its strongest taxel in [counts], and its drag along x."""

    x_mm: float
    y_mm: float
    radius_mm: float
    counts: float
    drag: float = 0.0

    def readings(self) -> np.ndarray:
        """Return what it adds to the counts of the pad, (3, 4, 4), x right and y down."""
        x, y = np.meshgrid(PLACES_MM - self.x_mm, PLACES_MM - self.y_mm)
        # The layer spreads a load by its thickness, and pushes material outwards at the edge of a contact.
        spread = self.radius_mm**2 + 3.0**2
        z = self.counts * np.exp(-(x**2 + y**2) / spread)
        return np.stack([z * (0.12 * x + self.drag), z * 0.12 * y, z])


PRESSES = (
    Press(0.0, 0.0, 5.0, 700),
    Press(2.0, -3.0, 4.0, 900, drag=0.3),
    Press(-4.0, 4.0, 6.0, 600),
    Press(1.0, 1.0, 3.0, 1100, drag=-0.2),
)


def pressed(presses: Sequence[Press] = PRESSES, *, seed: int = 1, free: int = FREE_SCANS) -> np.ndarray:
    """Return the counts (n, 3, 4, 4) of a free pad and of taps, each pressed, held and released."""
    force = np.concatenate([np.linspace(0, 1, 8), np.ones(12), np.linspace(1, 0, 8), np.zeros(TAP_SCANS - 28)])
    taps = [force[:, None, None, None] * press.readings() for press in presses]
    made = np.concatenate([np.zeros((free, 3, 4, 4)), *taps])
    noise = np.random.default_rng(seed).normal(0, 2, made.shape)
    return np.rint(REST + made + noise).astype(np.int32)


def gripped(scans: int = 200, *, free: int = 60) -> np.ndarray:
    """Return the counts of a grip from the first scan, which is opened before the last `free` ones."""
    load = np.ones(scans)
    load[scans - free - 10 : scans - free], load[scans - free :] = np.linspace(1, 0, 10), 0
    face = np.stack([np.zeros((4, 4)), np.zeros((4, 4)), np.full((4, 4), 650.0)])
    noise = np.random.default_rng(2).normal(0, 2, (scans, 3, 4, 4))
    return np.rint(REST + load[:, None, None, None] * face + noise).astype(np.int32)


def slcan_cycle(counts: np.ndarray, number: int, *, stamped: bool, controller: int = 4) -> list[bytes]:
    """Return the lines of one scan as an adapter sends them: a frame a taxel, each row from right to left."""
    lines = []
    for place in range(16):
        row, taxel = divmod(place, 4)
        x, y, z = counts[:, row, 3 - taxel].tolist()
        stamp = f"{(10 * number + place // 8) % 60_000:04X}" if stamped else ""
        lines.append(f"t{row << 8 | taxel << 4 | controller:03X}8A5{x:04X}{y:04X}{z:04X}0F{stamp}\r".encode())
    return lines
