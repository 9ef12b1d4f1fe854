"""Differences between sensors: faults of readings, and pads as the runtime states them to a network."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from edge_samples import make_pad_contract

from firmware_bridge.scans.pad_constants import PAD_RANGES
from firmware_bridge.scans.pad_constants import Pad as KnownPad
from train.physics.pad_draws import INPUTS, KNOWN, RANGES, Pad, constants, draw_pad, input_scale, known_numbers
from train.physics.sensor_noise import NAMES, Nuisances, apply_nuisances

NONE = Nuisances().without(*NAMES)
STRONG = Nuisances(
    hysteresis=0.5,
    cross_talk=0.3,
    gain_spread=0.2,
    thermal_drift_counts=3e4,
    earth_field_counts=2e4,
    noise_counts=1e4,
    saturation_counts=(1e5, 1e5, 3e5),
    dead_taxels=0.1,
)
"""Strong enough that another draw of any one is no rounding error."""
ACTING = tuple(name for name in NAMES if not name.startswith("pose"))
ANGLES_DEG = np.array([0.0, 5.0, 90.0])


def presses(n=5, taps=3, frames=8, counts=1e5):
    peak = np.random.default_rng(1).uniform(-counts, 3 * counts, (n, taps, 1, 3, 4, 4))
    return (peak * np.linspace(1 / frames, 1, frames)[:, None, None, None] ** 1.5).astype(np.float32)


@pytest.mark.parametrize("off", [None, *ACTING])
def test_each_acts_by_itself_and_in_its_turn(off):
    """All at once is one after the other, each run alone: so no draw depends on what else is on."""
    nuisances = STRONG.without(off) if off else STRONG
    together = apply_nuisances(presses(), nuisances, 7, angle_deg=ANGLES_DEG)
    in_turn = presses()
    for name in ACTING:
        alone = replace(NONE, **{name: getattr(nuisances, name)})
        in_turn = apply_nuisances(in_turn, alone, 7, angle_deg=ANGLES_DEG)
    assert np.abs(together - in_turn).max() <= 4
    changed = np.abs(together - apply_nuisances(presses(), STRONG, 7, angle_deg=ANGLES_DEG)).max()
    assert (changed > 100) == (off is not None)


def test_all_off_only_rounds_and_leaves_its_input_alone():
    clean = presses(counts=40.0)
    kept = clean.copy()
    assert np.array_equal(apply_nuisances(clean, NONE, 0), np.rint(clean))
    readings = apply_nuisances(clean, STRONG, 0)
    assert np.array_equal(clean, kept)
    assert readings.dtype == np.float32
    assert np.array_equal(readings, np.rint(readings))


@pytest.mark.parametrize("gains", [None, (1.0,) * 48])
def test_training_and_runtime_tell_a_network_the_same_of_a_pad(gains):
    """Pads drawn for training equal those that the runtime makes of a sensor's file."""
    takes = make_pad_contract(pad_inputs=tuple(input_scale()))
    assert takes.pad_width == KNOWN
    for number in range(20):
        pad = draw_pad(np.random.default_rng([7, number]))
        scaled = constants(pad)[None]
        told = known_numbers(scaled, np.ones(scaled.shape, dtype=bool), np.array([0.9 if gains else 0.0]))[0]
        known = KnownPad(**{name: getattr(pad, name) for name in INPUTS}, gains=gains)
        assert np.allclose(takes.pad_row(known), told, atol=1e-6)
        assert abs(scaled).max() <= 2
    some = KnownPad(thickness_mm=5.0)
    flags = np.array([[name == "thickness_mm" for name in INPUTS]])
    told = known_numbers(constants(Pad(thickness_mm=5.0))[None], flags, np.array([False]))[0]
    assert np.allclose(takes.pad_row(some), told, atol=1e-6)
    assert not takes.pad_row(None).any()


def test_a_sensor_file_can_hold_every_constant_that_is_drawn():
    assert set(INPUTS) <= set(PAD_RANGES) and set(INPUTS) <= set(RANGES)
    for name, centre, spread in input_scale():
        low, high = PAD_RANGES[name]
        assert low <= RANGES[name][0] < RANGES[name][1] <= high, name
        assert low <= centre <= high and 0 < spread < inf
