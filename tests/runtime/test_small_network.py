"""Small networks of a contract: what they compute, and that no damaged one is taken."""

import base64
import math
from itertools import pairwise

import numpy as np
import pytest

from edge.inference.familiarity import Check, check_of
from edge.inference.small_network import (
    MOST_INPUTS,
    MOST_LAYERS,
    MOST_UNITS,
    SmallNetwork,
    packed,
    small_network,
    unpacked,
)


def layers(*widths, seed=0):
    rng = np.random.default_rng(seed)
    return [(rng.standard_normal((after, before)), rng.standard_normal(after)) for before, after in pairwise(widths)]


class TestSmallNetwork:
    def test_it_has_a_rectifier_between_layers_and_none_at_the_end(self):
        (first, one), (second, two) = made = layers(5, 7, 1)
        two -= 7
        network = SmallNetwork(made)
        rows = np.random.default_rng(1).standard_normal((20, 5)).astype(np.float32)
        by_hand = np.maximum(rows @ first.T + one, 0) @ second[0] + two[0]
        assert network(rows) == pytest.approx(by_hand, abs=1e-4)
        assert by_hand.min() < 0 < by_hand.max() and network.inputs == 5

    def test_it_leaves_its_features_alone(self):
        features = np.ones((1, 5), dtype=np.float32)
        SmallNetwork(layers(5, 7, 1))(features)
        assert (features == 1).all()

    def test_it_is_the_same_after_json_within_half_precision(self):
        network = SmallNetwork(layers(5, 7, 3, 1))
        again = small_network(network.to_json())
        row = np.linspace(-1, 1, 5, dtype=np.float32)
        assert again(row) == pytest.approx(network(row), rel=0.01)
        assert small_network(again.to_json())(row) == again(row)

    @pytest.mark.parametrize(
        ("made", "said"),
        [
            ([], "0 layers"),
            (layers(*[2] * (MOST_LAYERS + 1), 1), "layers"),
            (layers(MOST_INPUTS + 1, 1), "inputs"),
            (layers(4, MOST_UNITS + 1, 1), "a layer of"),
            ([*layers(4, 3), *layers(4, 1)], "after 3 units"),
            (layers(4, 2), "2 outputs"),
            ([(np.ones((1, 4)), np.ones(2))], "a layer of"),
            ([(np.full((1, 4), np.nan), np.ones(1))], "not finite"),
            ([(np.ones((1, 4)), np.full(1, np.inf))], "not finite"),
        ],
    )
    def test_layers_that_are_none_are_refused(self, made, said):
        with pytest.raises(ValueError, match=said):
            SmallNetwork(made)


class TestPacked:
    def test_numbers_come_back_in_half_precision(self):
        values = np.array([[1.0, -2.5], [1 / 3, 60_000.0]])
        assert unpacked(packed(values)) == pytest.approx(values, rel=1e-3)
        assert unpacked(packed(values)).dtype == np.float32

    @pytest.mark.parametrize(
        "change",
        [
            {"shape": [2, 3]},
            {"shape": [0, 4]},
            {"shape": [-2, -2]},
            {"shape": [1 << 17, 1]},
            {"shape": ["two", 2]},
            {"shape": 4},
            {"shape": None},
            {"shape": [math.inf]},
            {"shape": [math.nan]},
            {"f2": "AAAA"},
            {"f2": "no base64!"},
            {"f2": "\u00e4"},
            {"f2": 7},
            {"f2": base64.b64encode(np.array([1, 2, 3, np.nan], dtype="<f2").tobytes()).decode()},
            {"f2": base64.b64encode(np.array([1, 2, 3, np.inf], dtype="<f2").tobytes()).decode()},
        ],
    )
    def test_what_is_damaged_is_refused(self, change):
        good = packed(np.ones((2, 2)))
        assert unpacked(good).shape == (2, 2)
        with pytest.raises(ValueError, match=r"\w"):
            unpacked(good | change)

    def test_a_length_that_does_not_fit_is_told(self):
        with pytest.raises(ValueError, match="8 bytes for an array of"):
            unpacked(packed(np.ones((2, 2))) | {"shape": [2, 3]})

    @pytest.mark.parametrize("value", [None, [], "text", 3, {}, {"shape": [1]}, {"f2": ""}])
    def test_what_is_no_array_is_refused(self, value):
        with pytest.raises(ValueError, match=r"\w"):
            unpacked(value)


class TestCheck:
    @pytest.mark.parametrize("limit", [None, "3", True, 3, math.nan, math.inf])
    def test_a_limit_that_is_no_number_is_refused(self, limit):
        good = Check(SmallNetwork(layers(4, 1)), 1.5).to_json()
        assert check_of(good).limit == 1.5
        with pytest.raises(ValueError, match="limit"):
            check_of(good | {"limit": limit})

    @pytest.mark.parametrize("value", [None, [], {}, {"limit": 1.0}, {"layers": [], "limit": 1.0, "more": 1}])
    def test_what_is_no_check_is_refused(self, value):
        with pytest.raises(ValueError, match="expected layers and a limit"):
            check_of(value)

    @pytest.mark.parametrize("value", [None, 3, "text", {}, [3], [{}], [{"weights": packed(np.ones((1, 1)))}]])
    def test_layers_that_are_no_list_are_refused(self, value):
        with pytest.raises(ValueError, match="layers"):
            small_network(value)
