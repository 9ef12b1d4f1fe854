"""Most likely gains of a sensor and constants of its pad from its own contacts, with intervals.

Readings are gains times the readings of the simulated world (`contact_mixture`). A place's strength is its chip's gain
on each axis times the common effect of its magnet's seat and moment on all three. Contacts of one pad share more than
the mixture models (its unevenness, its pitch), so the information of n of them counts as n / (1 + n / INDEPENDENT).
The maximum is computed by Fisher scoring within expectation-maximisation; the information there gives the intervals.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES, USPA44
from train.errors import DatasetError
from train.learning.contact_mixture import CHANNELS, ContactMixture, normalise
from train.physics.pad_draws import INPUTS
from train.physics.sensor_noise import Nuisances

PLACE_SPREAD: Final = 0.08
"""Standard deviation of a place's log-strength from its magnet's seat and moment: .06 to .11 on drawn pads."""
CONSTANT_SPREAD: Final = 1 / np.sqrt(3)
"""Prior deviation of a constant over its spread: uniform within its range."""
INDEPENDENT: Final = 50.0
"""Information of endless contacts of one pad, in contacts. Set on simulated pads; 10 and 250 are less accurate."""
_FREEDOM: Final = 5.0
"""Degrees of freedom of Student's t, which weighs down contacts that no component explains."""
_WIDENING: Final = np.repeat([2.3, 1.85], [CHANNELS, len(INPUTS)])
"""Factors on the deviations of gains and constants.

With them 90 % intervals hold nine in ten true gains and determined constants, on 20 simulated pads of 200 contacts.
"""
_LEVEL_90: Final = 1.645
"""Half width of a normal 90 % interval, in deviations."""
_TOLD: Final = 0.7
"""Largest deviation of a constant that counts as determined, over that of its prior."""
_ROUNDS: Final = 20
_STEP: Final = 0.2
_DONE: Final = 1e-3
_EVEN: Final = 1e-3
"""Standard deviation to which each axis' mean log-gain is held.

The mean of z is part of counts_per_newton, and the excess of x and y cannot be separated from the in-plane share.
"""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Gains and constants of a sensor, estimated from contacts.

    Attributes:
        contacts: number of contacts that were strong enough to be used.
        log_gains: (channels,); the mean of each axis is 0.
        constants: (p,) over their spread, in the order of train.physics.pad_draws.INPUTS.
        deviations: (channels + p,), standard deviations of both.
    """

    contacts: int
    log_gains: NDArray[np.float64]
    constants: NDArray[np.float64]
    deviations: NDArray[np.float64]

    @property
    def half_width(self) -> NDArray[np.float64]:
        """Half widths (channels + p,) of 90 % intervals."""
        return _LEVEL_90 * self.deviations

    @property
    def determined(self) -> NDArray[np.bool_]:
        """True for constants (p,) that contacts determine: well within the prior, and not at an end of the range."""
        return (self.deviations[CHANNELS:] < _TOLD * CONSTANT_SPREAD) & (np.abs(self.constants) < 1)


def estimate(counts: NDArray[np.floating], mixture: ContactMixture) -> Estimate:
    """Estimate gains and constants.

    Args:
        counts: (n, 3, rows, cols), zeroed, of contacts that differ; weak and clipped ones are left out.
        mixture: distribution of the readings of contacts.

    Raises:
        DatasetError: no contact is strong enough.
    """
    contacts, usable = normalise(counts)
    contacts = contacts[usable]
    if not len(contacts):
        raise DatasetError(
            f"none of {len(counts)} contacts is strong and unclipped: press so that z exceeds 200 counts"
        )
    prior = _prior_precision()
    weight = 1 / (1 + len(contacts) / INDEPENDENT)
    precisions = np.linalg.inv(mixture.covariances).astype(np.float64)
    found, information = np.zeros(len(prior)), prior
    for _ in range(_ROUNDS):
        slope, information = _likelihood(contacts, found, mixture, precisions)
        information = weight * information + prior
        step = np.linalg.solve(information, weight * slope - prior @ found)
        found += step * min(1.0, _STEP / np.abs(step).max())
        found[CHANNELS:] = found[CHANNELS:].clip(-1, 1)
        if np.abs(step).max() < _DONE:
            break
    before = np.sqrt(np.diag(np.linalg.inv(prior)))
    deviations = np.minimum(_WIDENING * np.sqrt(np.diag(np.linalg.inv(information))), before)
    return Estimate(len(contacts), found[:CHANNELS], found[CHANNELS:], deviations)


def _prior_precision() -> NDArray[np.float64]:
    """Return the prior precision of log-gains and constants, (channels + p, channels + p)."""
    own = Nuisances().gain_spread ** 2 * np.eye(CHANNELS)
    shared = PLACE_SPREAD**2 * np.kron(np.ones((len(AXES), len(AXES))), np.eye(USPA44.taxel_count))
    prior = CONSTANT_SPREAD**-2 * np.eye(CHANNELS + len(INPUTS))
    prior[:CHANNELS, :CHANNELS] = np.linalg.inv(own + shared)
    mean = np.kron(np.eye(len(AXES)), np.full([USPA44.taxel_count] * 2, (_EVEN * USPA44.taxel_count) ** -2.0))
    prior[:CHANNELS, :CHANNELS] += mean
    return prior


def _likelihood(
    contacts: NDArray[np.float64],
    found: NDArray[np.float64],
    mixture: ContactMixture,
    precisions: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gradient of the log-likelihood by log-gains and constants, and its information."""
    read = contacts / np.exp(found[:CHANNELS])
    constants = found[CHANNELS:]
    shares = mixture.responsibilities(read, constants, np.arange(CHANNELS))
    slope, information = np.zeros(len(found)), np.zeros((len(found), len(found)))
    gains, rest = slice(0, CHANNELS), slice(CHANNELS, None)
    centres = mixture.centres(constants)
    for number in np.flatnonzero(shares.sum(axis=0) > 1e-6):
        precision, by_constant = precisions[number], mixture.means[number, 1:]
        away = read - centres[number]
        pull = away @ precision
        weight = shares[:, number] * (_FREEDOM + CHANNELS) / (_FREEDOM + (pull * away).sum(axis=1))
        count = shares[:, number].sum()
        cross = (precision @ by_constant.T) * (weight @ read)[:, None]
        slope[gains] += weight @ (read * pull) - count
        slope[rest] += by_constant @ (weight @ pull)
        information[gains, gains] += precision * (read.T @ (weight[:, None] * read)) + count * np.eye(CHANNELS)
        information[gains, rest] += cross
        information[rest, gains] += cross.T
        information[rest, rest] += weight.sum() * by_constant @ precision @ by_constant.T
    return slope, information
