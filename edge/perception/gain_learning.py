"""Stage that learns the gains of a sensor's channels from its ordinary contacts: slow, bounded, drawn to their start.

The model is the distribution of contacts on simulated pads (`contacts.npz`): a mixture of normal distributions of a
contact's 48 readings over the RMS of its z, whose means are linear in what differs from pad to pad. What explains a
sensor's contacts are the inverses of its gains, the leans of its magnets (which show part of z in x and y), its
unevenness, its drift (offsets) and its pad's constants. Given the component that a contact belongs to, all of these
enter linearly: a contact adds to a matrix and a vector of fixed size, and the best gains solve a small convex problem.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from edge.inference.bundled import CONTACTS_FILE
from edge.perception.event import Report
from edge.perception.result import Estimate, Step
from edge.perception.trust_check import PatternCheck, SensorPad
from firmware_bridge.pad_geometry import AXES, CHANNELS, TAXELS
from firmware_bridge.recording.npz_recording import read_npz
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, LEVEL_90, PAD_RANGES, UNMEASURED_CERTAINTY, Pad

LARGEST_COUNTS: Final = (1390.0, 1390.0, 13400.0)  # of x, y, z of a contact that is used: chips clip a little above
LEAST_COUNTS: Final = 200.0  # largest z of the weakest contact that is used: in weaker ones drift is over a fifth of it
REMEMBERED: Final = 64  # newest contacts, of which a further one must differ: always the same contact teaches once
BOUND: Final = 0.25  # largest deviation of a gain from 1
_FREEDOM: Final = 5.0  # degrees of freedom of Student's t, which weighs down contacts that no component explains well
CONTRADICTED_CONTACTS: Final = 25  # fewest distinct contacts by which measured gains are found to be another sensor's
_OPEN: Final = 1 / np.sqrt(3)  # prior deviation of a constant over half of its range: uniform within it
_Z: Final = slice(2 * TAXELS, 3 * TAXELS)
# Linear parameters beside the pad's constants: inverse gains, leans of x and y, unevenness of z, and offsets.
_LINEAR: Final = CHANNELS + 2 * TAXELS + TAXELS + CHANNELS


@dataclass(frozen=True, slots=True)
class ContactModel:
    """Distribution of contacts: k components, whose means depend on p constants of the pad."""

    log_shares: NDArray[np.float64]  # (k,), log share of each less half the log determinant of its covariance
    means: NDArray[np.float64]  # (k, 1 + p, CHANNELS): on a middle pad, then the change by half the range of a constant
    precisions: NDArray[np.float32]  # (k, CHANNELS, CHANNELS)
    widening: float  # factor on deviations, so that 90 % intervals hold nine in ten gains of simulated sensors
    bias: NDArray[np.float64]  # (CHANNELS,), mean error of the log-gains of simulated sensors after many contacts
    constants: tuple[tuple[str, float, float], ...]  # name, middle and half of the range of each of the p
    constant_widening: float  # factor on their deviations, likewise


def load_contact_model(path: Path = CONTACTS_FILE) -> ContactModel:
    """Load the model that `train.learning.contact_mixture` has made, or raise an EdgeError."""
    try:
        of_contacts = ("share", "means", "factors", "widening", "bias")
        of_constants = ("names", "middles", "halves", "constant_widening")
        arrays = read_npz(path, (*of_contacts, *of_constants), 1 << 23)
        names, middles, halves = (arrays[name].tolist() for name in ("names", "middles", "halves"))
        constants = tuple(zip(names, middles, halves, strict=True))
        factors = arrays["factors"].astype(np.float64)
        count = len(factors)
        if factors.shape != (count, CHANNELS, CHANNELS) or arrays["means"].shape != (
            count,
            1 + len(constants),
            CHANNELS,
        ):
            raise ValueError(f"factors are {factors.shape}, expected (k, {CHANNELS}, {CHANNELS})")
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
        arrays["bias"].astype(np.float64).reshape(CHANNELS),
        constants,
        float(arrays["constant_widening"]),
    )


class GainLearner:
    """Learner of one sensor's gains; its memory does not grow."""

    def __init__(self, model: ContactModel, start: Pad | None = None, look_from: "GainLearner | None" = None) -> None:
        """Begin with the gains of a pad, else 1; a further pass over the same contacts looks from another's results."""
        self.contacts = 0  # distinct ones
        self._model = model
        constants = model.means.shape[1] - 1
        size = _LINEAR + constants
        self._prior = _prior(constants)
        self._unknown = np.diag(np.linalg.inv(self._prior))[:CHANNELS]
        self._least_deviations = np.zeros(CHANNELS)
        self._begin = np.zeros(size)
        self._begin[:CHANNELS] = 1.0
        if start is not None and start.gains is not None and len(start.gains) == CHANNELS:
            self._begin[:CHANNELS] = 1 / np.asarray(start.gains)
            if start.gain_half_widths is None:
                deviation = np.full(CHANNELS, (1 - UNMEASURED_CERTAINTY) * GAIN_SPREAD)
            else:
                deviation = np.maximum(np.asarray(start.gain_half_widths) / LEVEL_90, 1e-3)
            self._prior[:CHANNELS, :CHANNELS] = np.diag((deviation / model.widening) ** -2.0) + _even_axes()
            # What contacts share does not average out, so that they make no measured gain surer than this.
            self._least_deviations = np.minimum(deviation, 0.04)
        self._best = self._begin.copy() if look_from is None else look_from._best.copy()
        before = np.diag(np.linalg.inv(self._prior))
        self._before, self._after = before[:CHANNELS], before[:CHANNELS]
        self.deviations = model.widening * np.sqrt(before[:CHANNELS])  # of the log-gains
        self.constant_deviations = np.sqrt(before[_LINEAR:])  # over half of their ranges
        self._square = np.zeros((size, size))
        self._product = np.zeros(size)
        self._weight = self._count = 0.0
        self._recent = np.zeros((REMEMBERED, CHANNELS), dtype=np.float32)
        self._centres = np.empty((len(model.means), CHANNELS), dtype=np.float32)
        self._find_centres()

    @property
    def gains(self) -> NDArray[np.float64]:
        """Gains (CHANNELS,) so far, within BOUND of 1."""
        # Weight of the contacts beside the beginning, over what it is where nothing is known at the beginning.
        information = (1 / self._after - 1 / self._before).clip(0)
        weight, of_unknown = ((information / (information + 1 / var)).sum() for var in (self._before, self._unknown))
        biased = self._count / (self._count + 30) * weight / max(of_unknown, 1e-9)
        return (np.exp(-biased * self._model.bias) / self._best[:CHANNELS]).clip(1 - BOUND, 1 + BOUND)

    def pad(self) -> Pad:
        """Return the gains with half widths of their 90 % intervals, and with intervals the constants that show."""
        half = (LEVEL_90 * self.deviations).clip(0, 1)
        constants: dict[str, float] = {}
        intervals: dict[str, tuple[float, float]] = {}
        for at in np.flatnonzero(self.determined):
            name, middle, spread = self._model.constants[at]
            if name in PAD_RANGES:
                ends = self.constants[at] + LEVEL_90 * self.constant_deviations[at] * np.array([-1, 0, 1])
                low, constants[name], high = (float(f"{middle + spread * end:.4g}") for end in ends.clip(-1, 1))
                intervals[name] = (low, high)
        gains = tuple(self.gains.round(4).tolist())
        return Pad(**constants, intervals=intervals, gains=gains, gain_half_widths=tuple(half.round(4).tolist()))

    @property
    def constants(self) -> NDArray[np.float64]:
        """Constants of the pad so far (p,), over half of their ranges."""
        return self._best[_LINEAR:]

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Constants (p,) that are well within the prior, and not at an end of their range."""
        return (self.constant_deviations < 0.7 * _OPEN) & (np.abs(self.constants) < 1)

    @property
    def disagreement(self) -> float:
        """Mean square of how far contacts move the gains, over that of a right beginning; then it is about 1."""
        moved = np.square(self._best[:CHANNELS] - self._begin[:CHANNELS])
        return float(moved.mean() / max(float((self._before - self._after).clip(0).mean()), 1e-9))

    def learn(self, counts: NDArray[np.floating], dead: NDArray[np.bool_] | None = None) -> bool:
        """Learn from a contact's zeroed counts (3, rows, cols), and return whether the gains have changed.

        Weak and clipped contacts, those that resemble a recent one, and readings of dead taxels are left out.
        """
        read = np.asarray(counts, dtype=np.float64).reshape(CHANNELS)
        peaks = np.abs(read).reshape(len(AXES), TAXELS).max(axis=1)
        if peaks[2] <= LEAST_COUNTS or (peaks >= LARGEST_COUNTS).any():
            return False
        strength = float(np.sqrt(np.square(read[_Z]).mean()))
        contact = read / strength
        away = self._recent - contact.astype(np.float32)
        # Two distinct contacts differ by a tenth of the RMS of their z: five times the effect of noise and drift.
        if self.contacts and float(np.square(away).mean(axis=1).min()) < 0.1**2:
            return False
        if not self._add(
            contact, strength, None if dead is None or not dead.any() else np.tile(dead.ravel(), len(AXES))
        ):
            return False
        if self.contacts % 7:  # a step takes half a millisecond
            return False
        fading = min(1.0, 400 / max(self._count, 1.0))  # so the oldest contacts fade
        self._square *= fading
        self._product *= fading
        self._weight *= fading
        self._count *= fading
        self._step()
        return True

    def solve(self) -> None:
        """Solve for the gains, as far as a few steps go."""
        for _ in range(4):
            if not self._step():
                break

    def _add(self, contact: NDArray[np.float64], strength: float, dead: NDArray[np.bool_] | None) -> bool:
        """Add a contact to the sums, by the component that explains it best; return False if none does."""
        model, design = self._model, _design(contact, strength)
        off = (design @ self._best[:_LINEAR]).astype(np.float32) - self._centres
        pulls = np.matmul(model.precisions, off[:, :, None])[:, :, 0]
        distances = np.einsum("kc,kc->k", pulls, off)
        component = int((model.log_shares - 0.5 * distances).argmax())
        distance = float(distances[component])
        if distance > 40 * CHANNELS:  # CHANNELS is the mean on an even sensor
            return False
        self._recent[self.contacts % REMEMBERED] = contact
        self.contacts += 1
        precision, means = model.precisions[component].astype(np.float64), model.means[component]
        if dead is not None:
            precision = _without(precision, dead)
        weight = (_FREEDOM + CHANNELS) / (_FREEDOM + distance)
        # The constants move what the even readings are to be like: readings less their effect are to be the first mean.
        design = np.hstack([design, -means[1:].T])
        pull = weight * design.T @ precision
        self._square += pull @ design
        self._product += pull @ means[0]
        self._weight += weight
        self._count += 1
        return True

    def _step(self) -> bool:
        """Take one step of Newton towards the best gains; return whether they still move."""
        # Endless contacts tell no more than 150: they share what the model leaves out.
        share = 1 / (1 + self._count / 150)
        inverse = self._best[:CHANNELS]
        slope = share * (self._square @ self._best - self._product) + self._prior @ (self._best - self._begin)
        slope[:CHANNELS] -= share * self._weight / inverse
        curve = share * self._square + self._prior
        curve[np.arange(CHANNELS), np.arange(CHANNELS)] += share * self._weight / inverse**2
        covariance = np.linalg.inv(curve)
        step = -(covariance @ slope)
        longest = float(np.abs(step[:CHANNELS]).max())
        self._best += step * min(1.0, 0.1 / max(longest, 1e-9))
        self._best[:CHANNELS] = self._best[:CHANNELS].clip(1 / (1 + BOUND), 1 / (1 - BOUND))
        self._best[_LINEAR:] = self._best[_LINEAR:].clip(-1.2, 1.2)
        spread = np.sqrt(np.diag(covariance).clip(1e-12))
        self._after = spread[:CHANNELS] ** 2
        self.deviations = np.maximum(
            self._model.widening * spread[:CHANNELS] / self._best[:CHANNELS], self._least_deviations
        )
        self.constant_deviations = np.minimum(self._model.constant_widening * spread[_LINEAR:], _OPEN)
        self._find_centres()
        return longest > 1e-3

    def _find_centres(self) -> None:
        self._centres[...] = np.append(1.0, self._best[_LINEAR:]) @ self._model.means


def _design(contact: NDArray[np.float64], strength: float) -> NDArray[np.float64]:
    """Return the matrix (CHANNELS, _LINEAR) that makes a contact's even readings of the linear parameters."""
    z = contact[_Z]
    design = np.zeros((CHANNELS, _LINEAR))
    blocks = (contact, -np.concatenate([z, z]), z.clip(0, 1) / strength, np.full(CHANNELS, 1 / strength))
    column = 0
    for row, block in zip((0, 0, 2 * TAXELS, 0), blocks, strict=True):
        at = np.arange(len(block))
        design[row + at, column + at] = block
        column += len(block)
    return design


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
    """Return the precision that holds each axis' mean within 0.001: of z counts per newton, else the in-plane share."""
    return np.kron(np.eye(len(AXES)), np.full((TAXELS, TAXELS), (TAXELS * 1e-3) ** -2.0))


def _prior(constants: int) -> NDArray[np.float64]:
    """Return the prior precision of all parameters of a new sensor, in the order of `_design`."""
    # The seat and moment of a magnet change the gains of its three axes together.
    place = np.kron(np.ones((len(AXES), len(AXES))), 0.06**2 * np.eye(TAXELS))
    gains = np.linalg.inv(GAIN_SPREAD**2 * np.eye(CHANNELS) + place) + _even_axes()
    rest = np.concatenate([np.full(2 * TAXELS, 0.025), np.full(TAXELS, 30.0)])  # leans, and unevenness in counts
    # Deviations of drift in counts: of each taxel's own, and of what is common to all.
    drift = ((2.0, 18.0), (2.0, 18.0), (12.0, 45.0))
    offsets = [np.linalg.inv(own**2 * np.eye(TAXELS) + common**2) for own, common in drift]
    blocks = (gains, np.diag(rest**-2.0), *offsets, 3 * np.eye(constants))  # constants: uniform within the range
    prior, start = np.zeros((_LINEAR + constants,) * 2), 0
    for block in blocks:
        part = slice(start, start + len(block))
        prior[part, part] = block
        start += len(block)
    return prior


class Learn:
    """Stage: learns the sensor's gains from the strongest scan of each contact, once the pad is free.

    It begins with what was measured. What an earlier run has learned is in use until this run is as sure, but is no
    beginning: counted again with each start, the same errors would come to look certain.
    """

    def __init__(
        self, model: ContactModel, measured: Pad | None, pad: SensorPad, check: PatternCheck | None, report: Report
    ) -> None:
        self.waiting = False  # a contact is there to be learned from
        self._pad, self._check, self._report = pad, check, report
        self._learner = GainLearner(model, measured)
        self._from_file = measured is not None and measured.gains is not None
        self._used = pad.pad or measured or Pad()
        self._by_hand = Pad() if measured is None else replace(measured, gains=None, gain_half_widths=None)
        self._strongest = np.zeros(0, dtype=np.float32)
        self._force_counts = 0.0
        self._learned: Pad | None = None

    def __call__(self, step: Step, made: Estimate, counts: NDArray[np.float32]) -> None:
        """Take a contact's readings; one that is not to be trusted teaches nothing, nor what came before it."""
        force_counts = step.force_counts or 0.0
        if made.trusted is False:
            self.waiting, self._force_counts = False, 0.0
        elif force_counts > self._force_counts:
            self._strongest, self._force_counts = counts, force_counts
            self.waiting = True

    def learn(self, dead: NDArray[np.bool_]) -> bool:
        """Learn from the contact that waits; return whether another pad is in use since."""
        learner, check = self._learner, self._check
        self.waiting, self._force_counts = False, 0.0
        learned = learner.learn(self._strongest, dead)
        enough = self._from_file and learner.contacts >= CONTRADICTED_CONTACTS
        # A sensor's own gains reached 4.4 at most in a thousand contacts, on 48 simulated sensors (docs/decisions.md).
        if check is not None and enough and learner.disagreement > 6.0:
            if not check.suspected:
                why = "its contacts contradict the gains of its sensor file: is it another sensor's file?"
                self._report("suspected", why)
            check.suspect_file()
            return False
        if not learned or not self._is_better(new := learner.pad()):
            return False
        self._learned, self._used = new, new.behind(self._by_hand)
        self._pad.use(self._used)
        percent = 100 * float(np.sqrt(np.square(self._used.gain_half_widths or ()).mean()))
        self._report("gains_learned", f"gains learned from {learner.contacts} contacts, each within {percent:.0f} %")
        return True

    def _is_better(self, new: Pad) -> bool:
        """Return whether a pad is as sure as the one in use, and noticeably surer or other."""
        used = self._used
        if new.gains is None or new.gains_certainty < max(0.1, used.gains_certainty):
            return False
        shift = np.log(new.gains) - (0.0 if used.gains is None else np.log(used.gains))
        surer = new.gains_certainty >= used.gains_certainty + 0.05 or not set(new.constants) <= set(used.constants)
        return surer or bool(np.sqrt(np.square(shift).mean()) >= 0.01)

    def take_learned(self) -> Pad | None:
        """Return the pad by contacts alone if it was learned since the last call."""
        learned, self._learned = self._learned, None
        return learned
