"""What of a contract is refused by one key alone."""

from dataclasses import replace

import pytest
from edge_samples import make_contract, make_pad_contract

from edge.errors import ModelError
from edge.inference.contract import Contract
from firmware_bridge.geometry import USPA44


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
