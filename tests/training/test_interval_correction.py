"""Calibration of deviations, and their correction by region: nothing before it is fitted, conformal after."""

import numpy as np
import pytest
import torch
from press_samples import make_press_set

from edge.inference.intervals import REGIONS, regions
from train.learning.interval_fit import (
    calibrate,
    fit_correction,
    half_width_mm,
    interval_coverage,
    readings_of_presses,
)
from train.networks.compact import LOG_RANGE, CompactNet
from train.networks.named_networks import build
from train.physics.pad_draws import KNOWN

LEVEL = 0.3


def make_net(taps=2) -> CompactNet:
    """Return first weights whose patterns are not all zeros."""
    torch.manual_seed(0)
    net = build("compact-stsr" if taps == 1 else f"fusion-mtsr{taps}", 10, channels=16, blocks=1, known=KNOWN).eval()
    assert isinstance(net, CompactNet)
    with torch.no_grad():
        net.leave[2].bias_free += 0.02
    return net


def windows():
    return torch.randn(4, 6, 4, 4, generator=torch.Generator().manual_seed(0))


def corrected(net, weights=0.3):
    correction = net.add_intervals()
    correction.contact_level.fill_(LEVEL)
    torch.nn.init.normal_(correction.leave.weight, 0, weights)
    correction.requires_grad_(requires_grad=False)
    return correction


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


def test_a_factor_makes_intervals_cover_what_they_state():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 0.5, (60, 40, 40))
    deviation = np.where(rng.random(truth.shape) < 0.5, 0.01, 0.04)
    pattern = truth + rng.laplace(0, deviation / np.sqrt(2))
    assert interval_coverage(truth, pattern, deviation) == pytest.approx(0.9, abs=0.005)
    factor = calibrate(truth, pattern, 7 * deviation)
    assert factor == pytest.approx(1 / 7, rel=0.02)
    assert interval_coverage(truth, pattern, factor * 7 * deviation) == pytest.approx(0.9, abs=1e-4)
    uniform = np.random.default_rng(1).uniform(-0.03, 0.03, truth.shape)
    factor = calibrate(truth, truth + uniform, deviation)
    covered = interval_coverage(truth, truth + uniform, factor * deviation)
    assert covered == pytest.approx(0.9, abs=1e-4), "whatever the density"
    with pytest.raises(ValueError, match="not above zero"):
        calibrate(truth, pattern, 0 * deviation)


def test_its_masks_are_the_regions_of_the_runtime():
    correction = corrected(make_net())
    across = np.arange(40)
    away = np.hypot(across[:, None] - [[[15]], [[2]], [[20]]], across - [[[15]], [[30]], [[20]]])
    patterns = np.maximum(0.3 - away / [[[30]], [[80]], [[8]]], 0).astype(np.float32)
    patterns[2] = 0
    given = torch.from_numpy(patterns)
    masks = correction.masks(given, given.amax(dim=(1, 2), keepdim=True)).numpy().astype(bool)
    region = np.select([~masks[:, 2], masks[:, 1], masks[:, 0]], [0, 1, 2], 3)
    np.testing.assert_array_equal(region, regions(patterns, LEVEL, correction.near))
    assert len(np.unique(region[0])) == len(REGIONS)


def test_factors_are_bounded_whatever_the_weights():
    net = make_net()
    corrected(net, weights=1e3)
    low, high = (np.exp(bound) for bound in LOG_RANGE)
    for scale in (1e-6, 1.0, 1e6):
        factor = net(scale * windows())[1] / make_net()(scale * windows())[1]
        assert torch.isfinite(factor).all() and low * 0.999 < factor.min() and factor.max() < high * 1.001
    learning, plain = net.train()(windows())[1], make_net().train()(windows())[1]
    assert torch.equal(learning, plain), "in use alone"


def test_a_fitted_correction_tells_windows_apart():
    presses = make_press_set(count=120, taps=1)
    net, again = make_net(taps=1), make_net(taps=1)
    for one in (net, again):
        with torch.enable_grad():
            fit_correction(one, presses, LEVEL, steps=300)
    assert torch.equal(net.intervals.leave.weight, again.intervals.leave.weight), "the same seed, the same weights"
    readings = readings_of_presses(presses, 1, times=1)[0]
    given = torch.from_numpy(readings.with_taps(1)), torch.from_numpy(readings.pads)
    (pattern, deviation, _), (_, plain, _) = net(*given), make_net(taps=1)(*given)
    off = np.abs(pattern.numpy() - readings.truth)
    held = [np.mean(off <= half_width_mm(of.numpy())).item() for of in (plain, deviation)]
    assert abs(held[1] - 0.9) < 0.07 < abs(held[0] - 0.9)
