"""Readings that no contact makes: magnets near the pad, wrong maps and axes, taxels of another contact, wrong gains."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.networks.symmetric import symmetries

_FAR_MM: Final = (25.0, 80.0)
_FIELD_COUNTS: Final = (150.0, 1500.0)
"""Largest count of a far magnet's field on the pad: from a tenth of a firm press to the end of the range of x and y."""
_WRONG_GAINS: Final = 0.25
Counts = NDArray[np.float32]
Spoiling = Callable[[np.random.Generator, Counts], Counts]


def magnet_field(rng: np.random.Generator, count: int, geometry: SensorGeometry = USPA44) -> Counts:
    """Draw the counts (n, 3, rows, cols) that far dipoles add, each with its gradient over the pad.

    The dipole is above the pad, in any direction, and its moment points anywhere.
    """
    towards, moment = (_unit(rng.standard_normal((count, 3))) for _ in range(2))
    towards[:, 2] = np.abs(towards[:, 2])
    place_mm = towards * rng.uniform(*_FAR_MM, count)[:, None]
    x_mm = (np.arange(geometry.cols) - (geometry.cols - 1) / 2) * geometry.pitch_mm
    y_mm = (np.arange(geometry.rows) - (geometry.rows - 1) / 2) * geometry.pitch_mm
    chips = np.stack(np.broadcast_arrays(x_mm, y_mm[:, None], 0.0), axis=-1)
    away = chips - place_mm[:, None, None]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    away /= length
    along = (away * moment[:, None, None]).sum(axis=-1, keepdims=True)
    field = ((3 * away * along - moment[:, None, None]) / length**3).transpose(0, 3, 1, 2)
    field /= np.abs(field).max(axis=(1, 2, 3), keepdims=True)
    return (field * rng.uniform(*_FIELD_COUNTS, count)[:, None, None, None]).astype(np.float32)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _near_magnet(rng: np.random.Generator, counts: Counts) -> Counts:
    free = rng.random((len(counts), 1, 1, 1)) < 0.25
    return np.where(free, np.float32(0), counts) + magnet_field(rng, len(counts))


def _shuffled(rng: np.random.Generator, counts: Counts) -> Counts:
    flat = counts.reshape(*counts.shape[:2], -1)
    order = rng.random((len(flat), 1, flat.shape[2])).argsort(axis=2)
    return np.take_along_axis(flat, order, axis=2).reshape(counts.shape)


def _two_exchanged(rng: np.random.Generator, counts: Counts) -> Counts:
    flat = counts.reshape(*counts.shape[:2], -1)
    taken = flat.copy()
    rows, (one, other) = np.arange(len(flat)), rng.integers(flat.shape[2], size=(2, len(flat)))
    taken[rows, :, one], taken[rows, :, other] = flat[rows, :, other], flat[rows, :, one]
    return taken.reshape(counts.shape)


def _places_moved(rng: np.random.Generator, counts: Counts) -> Counts:
    """Turn or mirror the places of the taxels, but not their axes, as another id map does."""
    moves = symmetries("p4m")[1:]
    which = rng.integers(len(moves), size=len(counts))
    moved = np.stack([np.asarray(move(counts), dtype=np.float32) for move in moves])
    return moved[which, np.arange(len(counts))]


def _axes_exchanged(rng: np.random.Generator, counts: Counts) -> Counts:
    orders = np.array([(1, 0, 2), (1, 0, 2), (2, 1, 0), (0, 2, 1)])
    return np.take_along_axis(counts, orders[rng.integers(len(orders), size=len(counts))][:, :, None, None], axis=1)


def _axes_turned(rng: np.random.Generator, counts: Counts) -> Counts:
    signs = np.array([(-1, 1, 1), (1, -1, 1), (-1, -1, 1)], dtype=np.float32)
    return counts * signs[rng.integers(len(signs), size=len(counts))][:, :, None, None]


def _one_of_another(rng: np.random.Generator, counts: Counts) -> Counts:
    """Let one taxel hold what it read in another contact, or its rest level."""
    spoiled = counts.reshape(*counts.shape[:2], -1).copy()
    rows, taxel = np.arange(len(counts)), rng.integers(spoiled.shape[2], size=len(counts))
    held = spoiled[rng.permutation(len(counts))][rows, :, taxel]
    at_rest = rng.random((len(counts), 1)) < 1 / 3
    spoiled[rows, :, taxel] = np.where(at_rest, np.float32(0), held)
    return spoiled.reshape(counts.shape)


def _half_of_another(rng: np.random.Generator, counts: Counts) -> Counts:
    mixed = rng.random((len(counts), 1, *counts.shape[2:])) < 0.5
    return np.where(mixed, counts[rng.permutation(len(counts))], counts)


def _wrong_gains(rng: np.random.Generator, counts: Counts) -> Counts:
    gains = 1 + _WRONG_GAINS * rng.standard_normal(counts.shape)
    return (counts * gains).astype(np.float32)


SPOILINGS: Final[dict[str, Spoiling]] = {
    "a magnet near the pad": _near_magnet,
    "taxels shuffled": _shuffled,
    "two taxels exchanged": _two_exchanged,
    "places turned or mirrored": _places_moved,
    "axes exchanged": _axes_exchanged,
    "axes turned": _axes_turned,
    "a taxel of another contact": _one_of_another,
    "half of another contact": _half_of_another,
    "gains off by a quarter": _wrong_gains,
}
"""Ways in which readings are wrong, by name; each takes readings (n, 3, rows, cols) and leaves them as they are."""


def spoiled(rng: np.random.Generator, counts: Counts) -> tuple[Counts, NDArray[np.str_]]:
    """Return readings (n, 3, rows, cols) with one fault each, and the name of the fault (n,)."""
    names = np.array(list(SPOILINGS))[rng.permutation(len(counts)) % len(SPOILINGS)]
    wrong = counts.copy()
    for name, spoil in SPOILINGS.items():
        wrong[names == name] = spoil(rng, counts[names == name])
    return wrong, names
