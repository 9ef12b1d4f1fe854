"""Pads: drawn within their ranges, the same for one seed, and passed to a network as by the runtime."""

from math import inf

import numpy as np
import pytest
from edge_samples import make_pad_contract

from firmware_bridge.scans.pad_constants import PAD_RANGES
from firmware_bridge.scans.pad_constants import Pad as KnownPad
from train.physics.pad_draws import INPUTS, KNOWN, NOMINAL, RANGES, Pad, constants, draw_pad, input_scale, known_numbers

DRAWN = [draw_pad(np.random.default_rng([7, number])) for number in range(300)]


def test_every_constant_is_drawn_over_its_whole_range():
    for name, (low, high) in RANGES.items():
        values = np.array([getattr(pad, name) for pad in DRAWN])
        assert low <= values.min() and values.max() <= high, name
        assert values.min() < low + 0.05 * (high - low) and values.max() > high - 0.05 * (high - low), name
        assert low <= getattr(NOMINAL, name) <= high, name
    assert max(pad.uneven_mm for pad in DRAWN) <= 0.015
    assert len({pad.seed for pad in DRAWN}) == len(DRAWN)


@pytest.mark.parametrize("gains", [None, (1.0,) * 48])
def test_training_and_runtime_tell_a_network_the_same_of_a_pad(gains):
    """Pads drawn for training equal those that the runtime makes of a sensor's file."""
    takes = make_pad_contract(pad_inputs=tuple(input_scale()))
    assert takes.pad_width == KNOWN
    for pad in DRAWN[:20]:
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
