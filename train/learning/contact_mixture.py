"""Distribution of a contact's readings on any pad: a mixture of normal distributions, linear in the pad's constants.

    python -m train.learning.contact_mixture data/gripped.npz edge/models/contacts.npz

A contact's 48 readings over the root mean square of its z do not depend on its force. Within a component they are
normal about a mean that is linear in what differs from pad to pad. Readings are of even sensors: what the seats,
moments and leans of the magnets do to them is taken out, since a learner estimates it for every place.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from edge.perception.gain_learning import (
    LARGEST_COUNTS,
    LEAST_COUNTS,
    ContactModel,
    GainLearner,
    load_contact_model,
)
from firmware_bridge.in_place import check_writable, write_in_place
from firmware_bridge.pad_geometry import AXES, CHANNELS, TAXELS, USPA44
from firmware_bridge.scans.pad_constants import LEVEL_90
from train.data.make_presses import make_presses
from train.data.presses import PressSet, load_presses
from train.data.world import World
from train.errors import DatasetError, ended_by_errors
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import RANGES, Pad, draw_pad
from train.physics.sensor_noise import Nuisances, apply_nuisances, neighbours

CALIBRATION: Final = World(count=4800, per_pad=200, seed=9014)  # by which bias and intervals of learned gains are set
Z: Final = slice(AXES.index("z") * TAXELS, (AXES.index("z") + 1) * TAXELS)
CONSTANTS: Final = (
    *("thickness_mm", "poisson", "in_plane_share", "magnet_height_mm", "pitch_mm", "free_sides"),
    "cross_talk",
)
"""Constants that differ from pad to pad and change a contact's shape; each over half of its range."""
_SCALES: Final = (  # name, middle and half range of each
    *((name, sum(RANGES[name]) / 2, (RANGES[name][1] - RANGES[name][0]) / 2) for name in CONSTANTS[:-1]),
    (CONSTANTS[-1], Nuisances().cross_talk / 2, Nuisances().cross_talk / 2),
)
_ROUNDS: Final = 12


@dataclass(frozen=True, slots=True)
class ContactMixture:
    """Density of normalised contacts as a function of the pad's constants."""

    share: NDArray[np.float64]  # (k,) of the components
    means: NDArray[np.float64]  # (k, 1 + p, channels), of a middle pad, then the change by half a constant's range
    covariances: NDArray[np.float64]  # (k, channels, channels)

    def model(self) -> ContactModel:
        """Return the mixture as a running sensor learns by it, before it is calibrated."""
        log_shares = np.log(self.share) - 0.5 * np.linalg.slogdet(self.covariances)[1]
        precisions = np.linalg.inv(self.covariances).astype(np.float32)
        return ContactModel(log_shares, self.means, precisions, 1.0, np.zeros(CHANNELS), _SCALES, 1.0)


def normalise(counts: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return scans (n, 3, rows, cols) as contacts (n, channels) over the RMS of z, and which are strong, unclipped."""
    flat = counts.reshape(len(counts), -1).astype(np.float64)
    peaks = np.abs(counts).max(axis=(2, 3))
    usable = (peaks[:, AXES.index("z")] > LEAST_COUNTS) & (peaks < LARGEST_COUNTS).all(axis=1)
    scale = np.sqrt((flat[:, Z] ** 2).mean(axis=1, keepdims=True))
    return flat / np.maximum(scale, 1.0), usable


def scaled_constants(pad: Pad) -> NDArray[np.float64]:
    """Return CONSTANTS of a pad over half of their ranges, (p,); the last is of its sensor, and in the middle."""
    bounds = ((name, *RANGES[name]) for name in CONSTANTS[:-1])
    scaled = [2 * (getattr(pad, name) - low) / (high - low) - 1 for name, low, high in bounds]
    return np.array([*scaled, 0.0])


def place_effects(pad: Pad) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gains (taxels,) that seat and moment of each magnet make, and the share (2, taxels) of z in x and y.

    On the axis of a dipole the field's change grows with the inverse fourth power of the distance; a leaning dipole
    shows half of its slope times the change of z on the other axes.
    """
    rest, gap_mm = pad.rest(TAXELS), pad.magnet.gap_mm
    return (gap_mm / (gap_mm - rest[:, 2])) ** 4 * pad.moments(TAXELS), -rest[:, 3:5].T / 2


def even_contacts(presses: PressSet, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return usable contacts (n, channels) as even sensors read the newest presses, and their constants (n, p).

    The presses are whole sets of `make_presses`, whose pads can be drawn again.
    """
    rng = np.random.default_rng(seed)
    cross = rng.random(len(presses))
    flat = presses.counts[:, 0].reshape(len(presses), len(AXES), TAXELS).astype(np.float64)
    nuisances = Nuisances().without("gain_spread", "cross_talk")
    shown = Nuisances().cross_talk * cross[:, None, None]
    flat = flat + shown * (flat @ neighbours(USPA44.rows, USPA44.cols))
    clean = flat.reshape(len(flat), 1, 1, *USPA44.scan_shape).astype(np.float32)
    read = apply_nuisances(clean, nuisances, seed).reshape(flat.shape).astype(np.float64)
    # Joined sets number their pads with gaps, in the order in which they were drawn.
    numbers, of_pad = np.unique(presses.pad, return_inverse=True)
    pads = [draw_pad(np.random.default_rng([presses.config["seed"], number])) for number in range(len(numbers))]
    effects = [place_effects(pad) for pad in pads]
    read /= np.array([seat for seat, _ in effects])[of_pad][:, None]
    read[:, :2] -= np.array([lean for _, lean in effects])[of_pad] * read[:, 2:]
    contacts, usable = normalise(read.reshape(len(read), *USPA44.scan_shape))
    constants = np.array([scaled_constants(pad) for pad in pads])[of_pad]
    constants[:, -1] = 2 * cross - 1
    return contacts[usable], constants[usable]


def fit_mixture(presses: PressSet) -> ContactMixture:
    """Fit the mixture by expectation-maximisation to presses; DatasetError below two for each channel."""
    contacts, constants = even_contacts(presses, seed=0)
    design = np.insert(constants, 0, 1.0, axis=1)
    components = min(48, len(contacts) // (2 * CHANNELS))
    if not components:
        raise DatasetError(f"{len(contacts)} presses strong enough, expected {2 * CHANNELS} or more: make more")
    mixture = _fitted(contacts, design, _nearest(contacts, np.random.default_rng(0), components))
    for _ in range(_ROUNDS):
        mixture = _fitted(contacts, design, _given_constants(mixture, contacts, design))
    return mixture


# Contacts (n, 3, rows, cols) of a sensor, its true log-gains (channels,), and the constants (p,) of its pad.
Sensor = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]


def sensors_of(presses: PressSet, world: World) -> list[Sensor]:
    """Return the sensors that read the presses of a world, one for each pad, with chips of their own."""
    sensors: list[Sensor] = []
    spread, read_by = Nuisances().gain_spread, Nuisances().without("gain_spread")
    # Sets number their pads with gaps, in the order in which they were drawn.
    for number, pad_number in zip(range(world.chunks), np.unique(presses.pad), strict=True):
        pad = draw_pad(np.random.default_rng([world.seed, number]))
        chips = spread * np.random.default_rng([world.seed, 1, number]).standard_normal(USPA44.scan_shape)
        chips = 1 + chips.clip(-2 * spread, 2 * spread)
        # Log-gains of the chips, and of what seats and moments do under an even load; the mean of z's is 0.
        true = np.log(chips) + np.log(_even_z(GrippedPad(pad)) / _even_z(GrippedPad(replace(pad, seed=None))))
        true -= true[AXES.index("z")].mean()
        clean = presses.pick(presses.pad == pad_number).counts[:, 0] * chips.astype(np.float32)
        contacts = apply_nuisances(clean[None, :, None], read_by, [world.seed, number])[0, :, 0]
        sensors.append((contacts, true.ravel(), scaled_constants(pad)))
    return sensors


def _even_z(gripped: GrippedPad) -> NDArray[np.float64]:
    """Return z under an even load, (rows, cols)."""
    even = np.full((1, 1, gripped.size, gripped.size), 0.02, dtype=np.float32)
    return gripped.skin.frames(even)[0, 0, AXES.index("z")].astype(np.float64)


def calibrated(mixture: ContactMixture, sensors: Sequence[Sensor]) -> ContactModel:
    """Return the model with its mean error on sensors taken out, and with intervals that hold nine in ten values."""
    model = mixture.model()
    plain = [learned(contacts, model, 1) for contacts, _, _ in sensors]
    off = [np.log(learner.gains) - true for learner, (_, true, _) in zip(plain, sensors, strict=True)]
    model = replace(model, bias=_symmetric(np.mean(off, axis=0)))
    taught = [learned(contacts, model, 1) for contacts, _, _ in sensors]
    gains = [
        (np.log(learner.gains) - true) / learner.deviations
        for learner, (_, true, _) in zip(taught, sensors, strict=True)
    ]
    constants = [
        ((learner.constants - true) / learner.constant_deviations)[:-1][learner.determined[:-1]]
        for learner, (_, _, true) in zip(taught, sensors, strict=True)  # the cross-talk of a sensor is not available
    ]
    return replace(model, widening=_widening(gains), constant_widening=_widening(constants))


def _widening(ratios: Sequence[NDArray[np.floating]]) -> float:
    return float(np.quantile(np.abs(np.concatenate(ratios)), 0.9)) / LEVEL_90


def learned(counts: NDArray[np.floating], model: ContactModel, passes: int = 3) -> GainLearner:
    """Return the learner after several passes over contacts (n, 3, rows, cols), zeroed, each that differs once a pass.

    DatasetError if no contact is strong enough.
    """
    learner = GainLearner(model)
    for number in range(passes):
        if number:
            learner = GainLearner(model, look_from=learner)
        for contact in counts:
            learner.learn(contact)
        learner.solve()
    if not learner.contacts:
        raise DatasetError(
            f"none of {len(counts)} contacts is strong and unclipped: press so that z exceeds 200 counts"
        )
    return learner


def _symmetric(bias: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over mirrored and turned pads."""
    planes = bias.reshape(len(AXES), USPA44.rows, USPA44.cols)
    planes = (planes + planes[..., ::-1]) / 2
    planes = (planes + planes[:, ::-1]) / 2
    return ((planes + planes.swapaxes(1, 2)[[1, 0, 2]]) / 2).ravel()


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
    # Slopes over each constant are drawn to those of a middle pad, with the weight of so many presses.
    soft = np.diag([1e-6, *[2.0 * CHANNELS] * len(CONSTANTS)])
    means, covariances = [], []
    for weight in weights.T:
        used = np.flatnonzero(weight > 1e-4)
        part, columns, read = weight[used], design[used], contacts[used]
        mean = np.linalg.solve(columns.T @ (part[:, None] * columns) + soft, columns.T @ (part[:, None] * read))
        away = read - columns @ mean
        spread = away.T @ (part[:, None] * away) + 0.1 * pooled
        means.append(mean)
        # A hundredth of the mean z on each channel.
        covariances.append(spread / (part.sum() + 1) + 1e-4 * np.eye(CHANNELS))
    share = (weights.sum(axis=0) + 1) / (len(weights) + weights.shape[1])
    return ContactMixture(share, np.array(means), np.array(covariances))


def _given_constants(
    mixture: ContactMixture, contacts: NDArray[np.float64], design: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares (n, k) of each contact that the components have."""
    log_densities = []
    for mean, covariance in zip(mixture.means, mixture.covariances, strict=True):
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, (contacts - design @ mean).T)
        log_densities.append(-0.5 * (white**2).sum(axis=0) - np.log(np.diag(lower)).sum())
    return softmax(np.stack(log_densities, axis=1) + np.log(mixture.share), axis=1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m train.learning.contact_mixture", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("presses", type=Path, metavar="PRESSES.npz", help="of train.data.make_presses")
    parser.add_argument("out", type=Path, metavar="OUT.npz")
    options = parser.parse_args(arguments)
    with ended_by_errors("train.learning.contact_mixture"):
        check_writable(options.out)  # before minutes are spent on it
        mixture = fit_mixture(load_presses(options.presses))
        presses = make_presses(CALIBRATION, options.presses.with_name("calibration.npz"))
        write_model(options.out, mixture, calibrated(mixture, sensors_of(presses, CALIBRATION)))
    sys.stdout.write(f"{options.out}: {len(mixture.share)} components\n")


def write_model(path: Path, mixture: ContactMixture, model: ContactModel) -> None:
    """Write the model as edge.perception.gain_learning reads it, in half precision."""
    factors = np.linalg.inv(np.linalg.cholesky(mixture.covariances))
    arrays = {
        "share": mixture.share.astype(np.float32),
        "means": mixture.means.astype(np.float16),
        "factors": factors.astype(np.float16),
        "widening": np.float32(model.widening),
        "names": np.array([name for name, _, _ in model.constants]),
        "middles": np.array([middle for _, middle, _ in model.constants]),
        "halves": np.array([half for _, _, half in model.constants]),
        "constant_widening": np.float32(model.constant_widening),
        "bias": model.bias.astype(np.float32),
    }
    write_in_place(path, lambda draft: np.savez_compressed(draft, allow_pickle=False, **arrays), load_contact_model)


if __name__ == "__main__":
    main()
