"""Refusals of a contract for one key alone, and the last values that are taken."""

from dataclasses import replace

import pytest
from edge_samples import make_contract, make_pad_contract

from edge.errors import ModelError
from edge.inference.contract import Contract
from firmware_bridge.pad_geometry import USPA44


@pytest.mark.parametrize(
    ("key", "text", "match"),
    [
        ("pad_inputs", '[["thickness_mm", "4", 1]]', "a list of"),
        ("test_error", '{"1": {"psnr_db": 30.1}, "4": 33.2}', "a map from taps to metrics"),
    ],
)
def test_one_wrong_value_among_right_ones_is_refused(key, text, match):
    metadata = make_pad_contract().to_metadata()
    Contract.from_metadata(metadata)
    with pytest.raises(ModelError, match=match):
        Contract.from_metadata(metadata | {f"tactile.{key}": text})


@pytest.mark.parametrize("change", [{"name": "other"}, {"rows": 5}, {"cols": 5}, {"pitch_mm": 4.8}])
def test_a_sensor_that_the_model_was_not_trained_for_is_refused(change):
    make_contract().check_sensor(USPA44)
    with pytest.raises(ModelError, match=f"contract key '{next(iter(change)).replace('name', 'sensor')}' is"):
        make_contract().check_sensor(replace(USPA44, **change))


@pytest.mark.parametrize(
    ("lawful", "one_more", "match"),
    [
        ({"rows": "64", "cols": "64", "scale": "16"}, {"scale": "17"}, "patterns of at most 1048576 pixels"),
        ({"contact_level": "0.999"}, {"contact_level": "1"}, "a number below 1"),
        (
            {"taps": "4".ljust(1 << 20)},
            {"taps": "4".ljust((1 << 20) + 1)},
            "1048577 characters, expected at most 1048576",
        ),
    ],
)
def test_a_contract_is_taken_up_to_its_limits(lawful, one_more, match):
    metadata = make_contract().to_metadata() | {f"tactile.{key}": text for key, text in lawful.items()}
    Contract.from_metadata(metadata)
    with pytest.raises(ModelError, match=match):
        Contract.from_metadata(metadata | {f"tactile.{key}": text for key, text in one_more.items()})


@pytest.mark.parametrize(("letters", "shown"), [(98, "x', expected"), (99, "x..., expected")])
def test_a_hundred_characters_of_a_wrong_value_are_shown(letters, shown):
    with pytest.raises(ModelError) as refused:
        Contract.from_metadata(make_contract().to_metadata() | {"tactile.tap_order": f'"{"x" * letters}"'})
    assert shown in str(refused.value)
