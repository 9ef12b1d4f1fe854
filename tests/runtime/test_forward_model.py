"""Forward model of a contract: what explains readings, and what does not."""

from dataclasses import replace

import numpy as np
import pytest
from trust_samples import CONSTANTS, make_forward

from edge.inference.familiarity import contact_features, tap_features
from edge.inference.forward_model import GRID, KPA, condensed, features, forward_model

GAIN_ERROR = 0.075


def make_maps(seed=0, size=40):
    """Return a pattern in [mm] and a traction in [kPa], both even enough to be told apart by cells."""
    rng = np.random.default_rng(seed)
    pattern = np.kron(rng.uniform(0, 0.5, (8, 8)), np.ones((size // 8, size // 8))).astype(np.float32)
    traction = np.kron(rng.normal(0, 20, (3, 4, 4)), np.ones((1, 2, 2))).astype(np.float32)
    return pattern, traction


def readings_of(operator, pattern, traction):
    return (operator @ features(pattern, traction)).reshape(3, 4, 4).astype(np.float32)


@pytest.fixture
def forward():
    rng = np.random.default_rng(4)
    made = make_forward()
    made.operator[:] = rng.normal(0, 0.2, made.operator.shape)
    return made


class TestMismatch:
    def test_readings_that_the_operator_makes_leave_nothing(self, forward):
        for seed in range(5):
            values = np.random.default_rng(seed).uniform(-1, 1, CONSTANTS).astype(np.float32)
            operator = forward.of_pad(values)
            pattern, traction = make_maps(seed)
            tap = readings_of(operator, pattern, traction)
            assert forward.mismatch(operator, tap, pattern, traction, GAIN_ERROR) == pytest.approx(0, abs=1e-9)

    def test_another_pads_operator_leaves_something(self, forward):
        pattern, traction = make_maps()
        tap = readings_of(forward.of_pad(np.ones(CONSTANTS, dtype=np.float32)), pattern, traction)
        assert forward.mismatch(forward.of_pad(np.zeros(CONSTANTS, dtype=np.float32)), tap, pattern, traction, 0) > 0.1

    def test_it_grows_with_what_is_wrong(self, forward):
        operator = forward.of_pad(np.zeros(CONSTANTS, dtype=np.float32))
        pattern, traction = make_maps()
        tap = readings_of(operator, pattern, traction)
        another = make_maps(1)[0]
        shares = [
            forward.mismatch(operator, tap, (1 - wrong) * pattern + wrong * another, traction, GAIN_ERROR)
            for wrong in (0, 0.1, 0.2, 0.4, 0.8)
        ]
        assert shares == sorted(shares) and shares[1] > 0.001 and shares[-1] > 0.1

    def test_no_pattern_at_all_leaves_everything(self, forward):
        operator = forward.of_pad(np.zeros(CONSTANTS, dtype=np.float32))
        pattern, traction = make_maps()
        tap = readings_of(operator, pattern, traction)
        assert forward.mismatch(operator, tap, 0 * pattern, 0 * traction, GAIN_ERROR) == pytest.approx(1)

    def test_it_does_not_depend_on_the_force_where_noise_is_small(self, forward):
        operator = forward.of_pad(np.zeros(CONSTANTS, dtype=np.float32))
        pattern, traction = make_maps()
        tap = readings_of(operator, pattern, traction)
        wrong = make_maps(1)[0]
        forward.noise[:] = 1e-4
        light, firm = (
            forward.mismatch(operator, force * tap, force * wrong, force * traction, GAIN_ERROR)
            for force in (np.float32(1), np.float32(10))
        )
        assert light == pytest.approx(firm, rel=1e-3) and firm > 0.05

    def test_readings_that_are_less_certain_count_less(self, forward):
        operator = forward.of_pad(np.zeros(CONSTANTS, dtype=np.float32))
        pattern, traction = make_maps()
        tap = readings_of(operator, pattern, traction)
        tap[0] += 1.0
        sure = forward.mismatch(operator, tap, pattern, traction, 0)
        unsure = replace(forward, model_error=forward.model_error * np.float32([80, 1, 1]))
        assert unsure.mismatch(operator, tap, pattern, traction, 0) < 0.1 * sure


class TestFeatures:
    def test_they_are_means_of_cells(self):
        pattern, traction = make_maps()
        found = features(pattern, traction)
        assert found.shape == (GRID**2 * 3,) and found.dtype == np.float32
        assert found[: GRID**2] == pytest.approx(pattern[::5, ::5].ravel(), rel=1e-5)
        assert found[GRID**2 :] == pytest.approx(traction[:2].ravel() / KPA, rel=1e-5)
        assert condensed(found[None])[0, GRID**2 :] == pytest.approx(traction[:2, ::2, ::2].ravel() / KPA, rel=1e-5)

    @pytest.mark.parametrize("size", [12, 20, 36, 40, 64])
    def test_a_pattern_of_any_scale_keeps_its_mean(self, size):
        pattern = np.random.default_rng(0).uniform(0, 1, (size, size)).astype(np.float32)
        traction = np.zeros((3, GRID, GRID), dtype=np.float32)
        assert features(pattern, traction)[: GRID**2].mean() == pytest.approx(pattern.mean(), rel=1e-4)

    def test_those_of_a_contact_do_not_depend_on_its_force_but_for_one(self):
        tap = np.random.default_rng(0).uniform(0.5, 3, (3, 4, 4)).astype(np.float32)
        pad = np.ones(5, dtype=np.float32)
        (light,), (firm,) = contact_features(tap, pad), contact_features(20 * tap, pad)
        assert light[:48] == pytest.approx(firm[:48], rel=0.03)
        assert firm[48] - light[48] == pytest.approx(np.log(20), abs=0.03)
        assert (light[49:] == pad).all() and (firm[49:] == pad).all()

    def test_a_large_reading_beside_none_is_bounded(self):
        tap = np.zeros((3, 4, 4), dtype=np.float32)
        tap[0, 0, 0] = 1e6
        assert np.abs(contact_features(tap, np.zeros(5, dtype=np.float32))[0, :48]).max() <= 12

    def test_those_of_a_pair_are_of_shapes_and_steps(self):
        rng = np.random.default_rng(0)
        one, other = rng.uniform(1, 3, (2, 3, 4, 4)).astype(np.float32)
        (found,) = tap_features(np.stack([one, other]), (3,))
        assert found.shape == (100,) and found[98:].tolist() == [3, 9]
        assert tap_features(np.stack([one, one]))[0, 48:96] == pytest.approx(0, abs=1e-6)
        assert tap_features(np.stack([one, 10 * other]), (3,))[0, :96] == pytest.approx(found[:96], abs=0.05)
        earlier, one_more = tap_features(np.stack([one, other, one]))
        assert earlier[98:].tolist() == [1, 1] and one_more[98:].tolist() == [2, 4]


class TestJson:
    def test_it_comes_back(self):
        one = make_forward()
        again = forward_model(one.to_json(), CONSTANTS)
        for name in ("operator", "noise", "model_error"):
            assert np.array_equal(getattr(again, name), getattr(one, name))
