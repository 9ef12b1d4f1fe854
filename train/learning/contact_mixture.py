"""Distribution of a contact's readings on any pad: a mixture of Gaussians, each linear in the pad's constants.

A contact's 48 readings over the root mean square of its z do not depend on its force. Within a component they are
normal about a mean that is linear in the constants that networks take (`pad_draws.INPUTS`, over their spread).
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.recording.npz_reader import read_npz
from train.data.presses import PressSet
from train.errors import DatasetError
from train.physics.pad_draws import INPUTS
from train.physics.sensor_noise import LARGEST_COUNTS, Nuisances, read_windows

CHANNELS: Final = len(AXES) * USPA44.taxel_count
Z: Final = slice(AXES.index("z") * USPA44.taxel_count, (AXES.index("z") + 1) * USPA44.taxel_count)
LEAST_COUNTS: Final = 200.0
"""Largest z of the weakest contact used: in weaker ones, drift is over a fifth of it."""
_COMPONENTS: Final = 72
"""Largest number of components; each needs twice as many presses as there are channels."""
_ROUNDS: Final = 12
_SEED: Final = 0
"""Seed of the nuisances and of the components' initial centres."""
_RIDGE: Final = 1e-4
"""Variance added on each channel: a hundredth of the mean z."""
_MOST_BYTES: Final = 1 << 26


@dataclass(frozen=True, slots=True)
class ContactMixture:
    """Density of normalised contacts as a function of the pad's constants.

    Attributes:
        share: (k,) of the components.
        means: (k, 1 + p, channels), the mean on a middle pad, then the change by one spread of each constant.
        covariances: (k, channels, channels).
    """

    share: NDArray[np.float64]
    means: NDArray[np.float64]
    covariances: NDArray[np.float64]

    def centres(self, constants: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the means (k, channels) on a pad of these constants, (p,) over their spread."""
        return np.append(1.0, constants) @ self.means

    def responsibilities(
        self, contacts: NDArray[np.floating], constants: NDArray[np.floating], channels: NDArray[np.integer]
    ) -> NDArray[np.float64]:
        """Return the probabilities (n, k) of the components for contacts (n, channels), from some of the channels."""
        found = np.empty((len(contacts), len(self.share)))
        for number, (centre, covariance) in enumerate(zip(self.centres(constants), self.covariances, strict=True)):
            away = contacts[:, channels] - centre[channels]
            found[:, number] = _log_normal(away, covariance[np.ix_(channels, channels)])
        return _softmax(found + np.log(self.share))

    def hidden_z(
        self, contacts: NDArray[np.floating], constants: NDArray[np.floating], taxel: int
    ) -> NDArray[np.float64]:
        """Return the expected z of one taxel (n,) from the other taxels; its own readings are ignored."""
        of_taxel = np.arange(taxel, CHANNELS, USPA44.taxel_count)
        others = np.setdiff1d(np.arange(CHANNELS), of_taxel)
        weights = self.responsibilities(contacts, constants, others)
        z = Z.start + taxel
        expected = np.empty_like(weights)
        for number, (centre, covariance) in enumerate(zip(self.centres(constants), self.covariances, strict=True)):
            slope = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, z])
            expected[:, number] = centre[z] + (contacts[:, others] - centre[others]) @ slope
        return (weights * expected).sum(axis=1)

    def save(self, path: Path) -> None:
        """Write the mixture as one npz."""
        np.savez(path, allow_pickle=False, **{part.name: getattr(self, part.name) for part in fields(self)})


def load_mixture(path: Path) -> ContactMixture:
    """Load a mixture that `ContactMixture.save` has written.

    Raises:
        DatasetError: absent, damaged, or of other constants.
    """
    try:
        arrays = read_npz(path, [part.name for part in fields(ContactMixture)], _MOST_BYTES)
        mixture = ContactMixture(**arrays)
        if mixture.means.shape[1:] != (1 + len(INPUTS), CHANNELS):
            raise ValueError(f"means are {mixture.means.shape}")
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(f"{path} is not a mixture of contacts ({error}): delete it, it is made again") from error
    return mixture


def normalise(counts: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return scans (n, 3, rows, cols) as contacts (n, channels) over the RMS of z, and a mask of the usable ones.

    Usable contacts are strong enough and not clipped.
    """
    flat = counts.reshape(len(counts), -1).astype(np.float64)
    peaks = np.abs(counts).max(axis=(2, 3))
    usable = (counts[:, AXES.index("z")].max(axis=(1, 2)) > LEAST_COUNTS) & (peaks < LARGEST_COUNTS).all(axis=1)
    scale = np.sqrt((flat[:, Z] ** 2).mean(axis=1, keepdims=True))
    return flat / np.maximum(scale, 1.0), usable


def fit_mixture(presses: PressSet) -> ContactMixture:
    """Fit the mixture by expectation-maximisation to presses read by sensors with even gains.

    Args:
        presses: of many pads; the newest press of each sequence is used.

    Raises:
        DatasetError: too few presses for one component.
    """
    nuisances = Nuisances().without("gain_spread")
    contacts, usable = normalise(read_windows(presses.counts[:, :1, None], 1.0, nuisances, _SEED)[:, 0])
    contacts, design = contacts[usable], np.insert(presses.constants[usable].astype(np.float64), 0, 1.0, axis=1)
    components = min(_COMPONENTS, len(contacts) // (2 * CHANNELS))
    if not components:
        raise DatasetError(f"{len(contacts)} presses strong enough, expected {2 * CHANNELS} or more: make more")
    rng = np.random.default_rng(_SEED)
    mixture = _fitted(contacts, design, _nearest(contacts, rng, components))
    for _ in range(_ROUNDS):
        mixture = _fitted(contacts, design, _given_constants(mixture, contacts, design))
    return mixture


def _nearest(contacts: NDArray[np.float64], rng: np.random.Generator, components: int) -> NDArray[np.float64]:
    """Return weights (n, k), each 0 or 1, of k means."""
    weights = np.zeros((len(contacts), components))
    centres = contacts[rng.choice(len(contacts), components, replace=False)]
    for _ in range(_ROUNDS):
        nearest = (-2 * contacts @ centres.T + (centres**2).sum(axis=1)).argmin(axis=1)
        weights = (nearest[:, None] == np.arange(components)).astype(np.float64)
        centres = weights.T @ contacts / np.maximum(weights.sum(axis=0), 1.0)[:, None]
    return weights


def _fitted(contacts: NDArray[np.float64], design: NDArray[np.float64], weights: NDArray[np.float64]) -> ContactMixture:
    """Fit components by weighted least squares; those of few presses are regularised by the covariance of all."""
    pooled = np.cov(contacts.T)
    means, covariances = [], []
    for weight in weights.T:
        normal = design.T @ (weight[:, None] * design) + np.diag([1e-6, *[2.0 * CHANNELS] * len(INPUTS)])
        mean = np.linalg.solve(normal, design.T @ (weight[:, None] * contacts))
        away = contacts - design @ mean
        spread = away.T @ (weight[:, None] * away) + 0.1 * pooled
        means.append(mean)
        covariances.append(spread / (weight.sum() + 1) + _RIDGE * np.eye(CHANNELS))
    return ContactMixture(
        (weights.sum(axis=0) + 1) / (len(weights) + weights.shape[1]), np.array(means), np.array(covariances)
    )


def _given_constants(
    mixture: ContactMixture, contacts: NDArray[np.float64], design: NDArray[np.float64]
) -> NDArray[np.float64]:
    found = [
        _log_normal(contacts - design @ mean, covariance)
        for mean, covariance in zip(mixture.means, mixture.covariances, strict=True)
    ]
    return _softmax(np.stack(found, axis=1) + np.log(mixture.share))


def _log_normal(away: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the log density (n,) of deviations (n, d), up to a constant."""
    lower = np.linalg.cholesky(covariance)
    white = np.linalg.solve(lower, away.T)
    return -0.5 * (white**2).sum(axis=0) - np.log(np.diag(lower)).sum()


def _softmax(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    grown = np.exp(logs - logs.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)
