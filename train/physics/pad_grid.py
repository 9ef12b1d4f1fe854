"""Square grid over a pad: displacement from loads on it, and the boxes that presses take up on it.

Displacement is a convolution, done by FFT on a padded grid. Only the bounding box of the cells that a press can reach
is computed: the kernel is the whole pad's, cut to the box, so the result is that of the whole pad. Presses with boxes
of one shape are solved in a batch.
"""

from collections.abc import Callable, Iterator
from math import ceil

import numpy as np
import torch
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer

Place = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
"""Indices of boxes into maps (presses, size, size): presses (n, 1, 1), rows (n, height, 1), columns (n, 1, width)."""


class PadGrid:
    """Grid of `size` cells a side of `cell_mm` over a pad, and what its kernels make of loads.

    `compliance` is the displacement per load in [mm/MPa], (m, k) or (kernels, m, k), at `waves` (1, k) and (m, 1).
    """

    def __init__(
        self,
        layer: Layer,
        size: int,
        cell_mm: float,
        dtype: torch.dtype,
        compliance: Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.float64]],
    ) -> None:
        # A period of eight thicknesses limits the error of a punch's force to 5e-4; with one of twice the pad it was
        # .8 % for a layer of 10 mm and 9 % for one of 50 mm.
        period = 2 * max(size, ceil(4 * layer.thickness_mm / cell_mm))
        self._kernels = np.fft.irfft2(compliance(*waves(period, cell_mm)), s=(period, period))
        self._size = size
        self._dtype = dtype
        # Powers of two suit the FFT, and are few, so that many presses share one.
        self._sides = [*(side for side in (8, 16, 32, 64, 128, 256) if side < size), size]
        self._spectra: dict[tuple[int, int], torch.Tensor] = {}

    @property
    def cell_mm_per_mpa(self) -> float:
        """Displacement of a cell under its own load alone, in [mm/MPa]."""
        return float(self._kernels[..., 0, 0].flat[0])

    def spectrum(self, height: int, width: int) -> torch.Tensor:
        """Return the kernels' spectra (..., 2 height, width + 1) on a box, which symmetry makes real."""
        if (height, width) not in self._spectra:
            rows, columns = (np.fft.ifftshift(np.arange(-side, side)) for side in (height, width))
            kernels = torch.as_tensor(self._kernels[..., rows[:, None], columns], dtype=self._dtype)
            self._spectra[height, width] = torch.fft.rfft2(kernels).real
        return self._spectra[height, width]

    def boxes(self, within: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], Place]]:
        """Yield presses whose boxes have one shape, and the boxes' place: those that hold `within`, (n, size, size)."""
        presses = np.flatnonzero(within.any(axis=(1, 2)))
        shapes, starts = [], []
        for axis in (1, 2):
            used = np.asarray(within[presses].any(axis=3 - axis))
            first, last = used.argmax(axis=1), self._size - 1 - used[:, ::-1].argmax(axis=1)
            side = np.array(self._sides)[np.searchsorted(self._sides, last - first + 1)]
            shapes.append(side)
            starts.append(np.minimum(first, self._size - side))
        for height, width in np.unique(np.stack(shapes, axis=1), axis=0):
            alike = (shapes[0] == height) & (shapes[1] == width)
            rows, columns = starts[0][alike, None] + np.arange(height), starts[1][alike, None] + np.arange(width)
            yield presses[alike], (presses[alike, None, None], rows[:, :, None], columns[:, None, :])


def waves(period: int, cell_mm: float) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return wave numbers to the right (1, period / 2 + 1) and back (period, 1), in [1/mm]."""
    right, back = np.fft.rfftfreq(period, cell_mm), np.fft.fftfreq(period, cell_mm)
    return 2 * np.pi * right[None], 2 * np.pi * back[:, None]
