"""Gains of a sensor's channels from its ordinary contacts: slow, bounded, drawn to where they began.

The model is the distribution of contacts on simulated pads (`contacts.npz`): a mixture of normal distributions of a
contact's 48 readings over the RMS of its z, whose means are linear in what differs from pad to pad. What explains a
sensor's contacts are the inverses of its gains, the leans of its magnets (which show part of z in x and y), its
unevenness and its drift (offsets, which matter less the stronger a contact is), and its pad's constants. Given the
component that a contact belongs to, all of these enter linearly: so a contact adds to a matrix and a vector of fixed
size, and now and then the best gains are the solution of one small convex problem.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from edge.inference.bundled import CONTACTS
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.recording.npz_recording import read_npz
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, GAINS, LEVEL_90, PAD_RANGES, UNMEASURED_CERTAINTY, Pad

TAXELS: Final = USPA44.taxel_count
LARGEST_COUNTS: Final = (1390.0, 1390.0, 13400.0)
"""Largest readings of x, y and z of a contact that is used; chips are clipped a little above."""
LEAST_COUNTS: Final = 200.0  # largest z of the weakest contact that is used: in weaker ones drift is over a fifth of it
REMEMBERED: Final = 64
"""Newest distinct contacts, of which a further one must differ: always the same contact teaches once."""
BOUND: Final = 0.25  # largest deviation of a gain from 1
_FREEDOM: Final = 5.0  # degrees of freedom of Student's t, which weighs down contacts that no component explains well
_EVEN: Final = 1e-3
"""Deviation to which each axis' mean is held: that of z is counts per newton, and of x and y the in-plane share."""
_OPEN: Final = 1 / np.sqrt(3)  # prior deviation of a constant over half of its range: uniform within it
_ARRAYS: Final = (
    *("share", "means", "factors", "widening", "bias"),
    *("names", "middles", "halves", "constant_widening"),
)
_Z: Final = slice(2 * TAXELS, 3 * TAXELS)
_ROWS: Final = np.concatenate([np.arange(GAINS), np.arange(2 * TAXELS), np.arange(2 * TAXELS, GAINS), np.arange(GAINS)])
"""Channel that each parameter acts on: inverse gains, leans, unevenness, offsets."""
_LINEAR: Final = len(_ROWS)
_PAIRS: Final = GAINS * _ROWS[:, None] + _ROWS  # places of all pairs of them in a flat matrix of channels


@dataclass(frozen=True, slots=True)
class ContactModel:
    """Distribution of contacts.

    Attributes:
        log_shares: (k,), log share of each component less half the log determinant of its covariance.
        means: (k, 1 + p, GAINS): on a middle pad, then the change by half the range of each of p constants.
        precisions: (k, GAINS, GAINS).
        widening: factor on deviations, so that 90 % intervals hold nine in ten gains of simulated sensors.
        bias: (GAINS,), mean error of the log-gains of simulated sensors after many contacts.
        constants: name of each of the p constants, middle of its range, and half of the range.
        constant_widening: factor on their deviations, likewise.
    """

    log_shares: NDArray[np.float64]
    means: NDArray[np.float64]
    precisions: NDArray[np.float32]
    widening: float
    bias: NDArray[np.float64]
    constants: tuple[tuple[str, float, float], ...]
    constant_widening: float


def load_contact_model(path: Path = CONTACTS) -> ContactModel:
    """Load the model that `train.learning.contact_mixture` has made.

    Raises:
        EdgeError: the file cannot be read, or is of another pad.
    """
    try:
        arrays = read_npz(path, _ARRAYS, 1 << 23)
        names, middles, halves = (arrays[name].tolist() for name in ("names", "middles", "halves"))
        constants = tuple(zip(names, middles, halves, strict=True))
        factors = arrays["factors"].astype(np.float64)
        count = len(factors)
        if factors.shape != (count, GAINS, GAINS) or arrays["means"].shape != (count, 1 + len(constants), GAINS):
            raise ValueError(f"factors are {factors.shape}, expected (k, {GAINS}, {GAINS})")
        log_size = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        if not np.isfinite(log_size).all():
            raise ValueError("a component is singular")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EdgeError(
            f"{path} cannot be read ({error}): make it with 'python -m train.learning.contact_mixture'"
        ) from error
    return ContactModel(
        np.log(arrays["share"].astype(np.float64)) + log_size,
        arrays["means"].astype(np.float64),
        (factors.transpose(0, 2, 1) @ factors).astype(np.float32),
        float(arrays["widening"]),
        arrays["bias"].astype(np.float64).reshape(GAINS),
        constants,
        float(arrays["constant_widening"]),
    )


class GainLearner:
    """Learner of one sensor's gains; its memory does not grow.

    Attributes:
        contacts: distinct contacts so far.
        deviations: (GAINS,) standard deviations of the log-gains.
        constant_deviations: (p,) of the constants.
    """

    def __init__(self, model: ContactModel, start: Pad | None = None) -> None:
        """Begin with the gains of a pad, and their intervals; None for gains of 1."""
        self.contacts = 0
        self._model = model
        constants = model.means.shape[1] - 1
        size = _LINEAR + constants
        self._prior = _prior(constants)
        self._unknown = np.diag(np.linalg.inv(self._prior))[:GAINS]
        self._least_deviations = np.zeros(GAINS)
        self._begin = np.zeros(size)
        self._begin[:GAINS] = 1.0
        if start is not None and start.gains is not None and len(start.gains) == GAINS:
            self._begin[:GAINS] = 1 / np.asarray(start.gains)
            if start.gain_half_widths is None:
                deviation = np.full(GAINS, (1 - UNMEASURED_CERTAINTY) * GAIN_SPREAD)
            else:
                deviation = np.maximum(np.asarray(start.gain_half_widths) / LEVEL_90, 1e-3)
            self._prior[:GAINS, :GAINS] = np.diag((deviation / model.widening) ** -2.0) + _even_axes()
            # What contacts share does not average out, so that they make no measured gain surer than this.
            self._least_deviations = np.minimum(deviation, 0.04)
        self._best = self._begin.copy()
        before = np.diag(np.linalg.inv(self._prior))
        self._before, self._after = before[:GAINS], before[:GAINS]
        self.deviations = model.widening * np.sqrt(before[:GAINS])
        self.constant_deviations = np.sqrt(before[_LINEAR:])
        self._square = np.zeros((size, size))
        self._product = np.zeros(size)
        self._weight = self._count = 0.0
        self._recent = np.zeros((REMEMBERED, GAINS), dtype=np.float32)
        self._centres = np.empty((len(model.means), GAINS), dtype=np.float32)
        self._find_centres()

    @property
    def gains(self) -> NDArray[np.float64]:
        """Gains (GAINS,) so far, within BOUND of 1."""
        biased = self._count / (self._count + 30) * self._share_of_contacts
        return (np.exp(-biased * self._model.bias) / self._best[:GAINS]).clip(1 - BOUND, 1 + BOUND)

    def pad(self) -> Pad:
        """Return the gains with half widths of their 90 % intervals, and with intervals the constants that show."""
        half = (LEVEL_90 * self.deviations).clip(0, 1)
        constants: dict[str, float] = {}
        intervals: dict[str, tuple[float, float]] = {}
        for at in np.flatnonzero(self.determined):
            name, middle, spread = self._model.constants[at]
            if name in PAD_RANGES:
                value = self.constants[at]
                ends = np.clip(value + LEVEL_90 * self.constant_deviations[at] * np.array([-1, 1]), -1, 1)
                low, constants[name], high = (
                    float(f"{middle + spread * one:.4g}") for one in (ends[0], value, ends[1])
                )
                intervals[name] = (low, high)
        gains = tuple(self.gains.round(4).tolist())
        return Pad(**constants, intervals=intervals, gains=gains, gain_half_widths=tuple(half.round(4).tolist()))

    @property
    def disagreement(self) -> float:
        """Mean square of how far contacts move the gains, over that of a right beginning; then it is about 1."""
        moved = np.square(self._best[:GAINS] - self._begin[:GAINS])
        return float(moved.mean() / max(float((self._before - self._after).clip(0).mean()), 1e-9))

    @property
    def _share_of_contacts(self) -> float:
        """Weight of the contacts beside the beginning, over what it is where nothing is known at the beginning."""
        information = (1 / self._after - 1 / self._before).clip(0)
        weight, of_unknown = (information / (information + 1 / before) for before in (self._before, self._unknown))
        return float(weight.sum() / max(float(of_unknown.sum()), 1e-9))

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Constants (p,) that are well within the prior, and not at an end of their range."""
        return (self.constant_deviations < 0.7 * _OPEN) & (np.abs(self.constants) < 1)

    def again(self) -> "GainLearner":
        """Return a learner that has learned nothing yet and begins to look from these results: for a further pass."""
        learner = GainLearner(self._model)
        learner._prior, learner._begin = self._prior, self._begin
        learner._before = learner._after = self._before
        learner._best = self._best.copy()
        learner._find_centres()
        return learner

    @property
    def constants(self) -> NDArray[np.float64]:
        """Constants of the pad so far (p,), over half of their ranges."""
        return self._best[_LINEAR:]

    def learn(self, counts: NDArray[np.floating], dead: NDArray[np.bool_] | None = None) -> bool:
        """Learn from one contact, and return whether the gains have changed.

        Weak and clipped contacts, and those that resemble a recent one, are left out. Counts (3, rows, cols) are
        zeroed, with estimates for dead taxels (rows, cols), from which nothing is learned; None if all live.
        """
        read = np.asarray(counts, dtype=np.float64).reshape(GAINS)
        peaks = np.abs(read).reshape(len(AXES), TAXELS).max(axis=1)
        if peaks[2] <= LEAST_COUNTS or (peaks >= LARGEST_COUNTS).any():
            return False
        strength = float(np.sqrt(np.square(read[_Z]).mean()))
        contact = read / strength
        away = self._recent - contact.astype(np.float32)
        # Two distinct contacts differ by a tenth of the RMS of their z: five times the effect of noise and drift.
        if self.contacts and float(np.square(away).mean(axis=1).min()) < 0.1**2:
            return False
        before = self.contacts
        self._add(contact, strength, None if dead is None or not dead.any() else np.tile(dead.ravel(), len(AXES)))
        if self.contacts == before or self.contacts % 7:  # a step takes half a millisecond
            return False
        self._fade()
        self._step()
        return True

    def solve(self) -> None:
        """Solve for the gains now, as far as a few steps go."""
        for _ in range(4):
            if not self._step():
                break

    def _add(self, contact: NDArray[np.float64], strength: float, dead: NDArray[np.bool_] | None) -> None:
        values = _values(contact, strength)
        terms = values * self._best[:_LINEAR]
        even = terms[:GAINS] + terms[_LINEAR - GAINS :]
        even[: 2 * TAXELS] += terms[GAINS : GAINS + 2 * TAXELS]
        even[_Z] += terms[GAINS + 2 * TAXELS : _LINEAR - GAINS]
        off = even.astype(np.float32) - self._centres
        pulls = np.matmul(self._model.precisions, off[:, :, None])[:, :, 0]
        distances = np.einsum("kc,kc->k", pulls, off)
        component = int((self._model.log_shares - 0.5 * distances).argmax())
        distance = float(distances[component])
        if distance > 40 * GAINS:  # GAINS is the mean on an even sensor
            return
        self._recent[self.contacts % REMEMBERED] = contact
        self.contacts += 1
        precision = self._model.precisions[component].astype(np.float64)
        if dead is not None:
            precision = _without(precision, dead)
        weight = (_FREEDOM + GAINS) / (_FREEDOM + distance)
        means = self._model.means[component]
        weighted = weight * values
        by_constant = means[1:] @ precision
        centre = means[0] @ precision
        pairs = np.take(precision, _PAIRS)
        pairs *= weighted[:, None]
        pairs *= values
        self._square[:_LINEAR, :_LINEAR] += pairs
        cross = by_constant[:, _ROWS] * weighted
        self._square[:_LINEAR, _LINEAR:] -= cross.T
        self._square[_LINEAR:, :_LINEAR] -= cross
        self._square[_LINEAR:, _LINEAR:] += weight * (by_constant @ means[1:].T)
        self._product[:_LINEAR] += centre[_ROWS] * weighted
        self._product[_LINEAR:] -= weight * (means[1:] @ centre)
        self._weight += weight
        self._count += 1

    def _fade(self) -> None:
        """Let the oldest contacts fade."""
        share = min(1.0, 400 / max(self._count, 1.0))
        for sums in (self._square, self._product):
            sums *= share
        self._weight *= share
        self._count *= share

    def _step(self) -> bool:
        """Take one step of Newton towards the best gains; return whether they still move."""
        # Endless contacts tell no more than 150: they share what the model leaves out.
        share = 1 / (1 + self._count / 150)
        inverse = self._best[:GAINS]
        slope = share * (self._square @ self._best - self._product) + self._prior @ (self._best - self._begin)
        slope[:GAINS] -= share * self._weight / inverse
        curve = share * self._square + self._prior
        curve[np.arange(GAINS), np.arange(GAINS)] += share * self._weight / inverse**2
        covariance = np.linalg.inv(curve)
        step = -(covariance @ slope)
        longest = float(np.abs(step[:GAINS]).max())
        self._best += step * min(1.0, 0.1 / max(longest, 1e-9))
        self._best[:GAINS] = self._best[:GAINS].clip(1 / (1 + BOUND), 1 / (1 - BOUND))
        self._best[_LINEAR:] = self._best[_LINEAR:].clip(-1.2, 1.2)
        spread = np.sqrt(np.diag(covariance).clip(1e-12))
        self._after = spread[:GAINS] ** 2
        self.deviations = np.maximum(self._model.widening * spread[:GAINS] / self._best[:GAINS], self._least_deviations)
        self.constant_deviations = np.minimum(self._model.constant_widening * spread[_LINEAR:], _OPEN)
        self._find_centres()
        return longest > 1e-3

    def _find_centres(self) -> None:
        self._centres[...] = np.append(1.0, self._best[_LINEAR:]) @ self._model.means


def _values(contact: NDArray[np.float64], strength: float) -> NDArray[np.float64]:
    """Return the factor of each linear parameter in a contact's even readings, (_LINEAR,)."""
    z = contact[_Z]
    lean = -np.concatenate([z, z])
    return np.concatenate([contact, lean, z.clip(0, 1) / strength, np.full(GAINS, 1 / strength)])


def _without(precision: NDArray[np.float64], dead: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the precision of the living channels with the dead ones unknown; zero for the dead ones."""
    live = ~dead
    left = np.zeros_like(precision)
    cross = precision[np.ix_(live, dead)]
    left[np.ix_(live, live)] = precision[np.ix_(live, live)] - cross @ np.linalg.solve(
        precision[np.ix_(dead, dead)], cross.T
    )
    return left


def _even_axes() -> NDArray[np.floating]:
    """Return the precision that holds each axis' mean."""
    return np.kron(np.eye(len(AXES)), np.full((TAXELS, TAXELS), (TAXELS * _EVEN) ** -2.0))


def _prior(constants: int) -> NDArray[np.float64]:
    """Return the prior precision of all parameters of a new sensor."""
    every = np.ones((TAXELS, TAXELS))
    prior = np.zeros((_LINEAR + constants,) * 2)
    # The seat and moment of a magnet change the gains of its three axes together.
    place = np.kron(np.ones((len(AXES), len(AXES))), 0.06**2 * np.eye(TAXELS))
    prior[:GAINS, :GAINS] = np.linalg.inv(GAIN_SPREAD**2 * np.eye(GAINS) + place)
    prior[:GAINS, :GAINS] += _even_axes()
    rest = np.concatenate([np.full(2 * TAXELS, 0.025), np.full(TAXELS, 30.0)])  # leans, and unevenness in counts
    part = np.arange(GAINS, _LINEAR - GAINS)
    prior[part, part] = rest**-2.0
    offsets = np.zeros((GAINS, GAINS))
    # Deviations of drift in counts: of each taxel's own, and of what is common to all.
    for axis, (own, common) in enumerate(((2.0, 18.0), (2.0, 18.0), (12.0, 45.0))):
        part = slice(axis * TAXELS, (axis + 1) * TAXELS)
        offsets[part, part] = own**2 * np.eye(TAXELS) + common**2 * every
    prior[_LINEAR - GAINS : _LINEAR, _LINEAR - GAINS : _LINEAR] = np.linalg.inv(offsets)
    prior[_LINEAR:, _LINEAR:] = 3 * np.eye(constants)  # uniform within the range
    return prior
