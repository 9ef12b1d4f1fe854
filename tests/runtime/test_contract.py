"""Contract of a model: what is refused, key by key, the last values that are taken, and pads outside the training."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from edge_samples import make_contract, make_pad_contract
from trust_samples import make_checked_contract, make_posed_trust, make_trusted_contract

from edge.api import USPA44, ModelError, Pad
from edge.inference.contract import CONTRACT_VERSION, Contract
from firmware_bridge.scans.pad_constants import PAD_RANGES

BROKEN_VALUES = {
    "made_for": {"poisson": [0.5, 0.4]},
    "version": 1,
    "taps": 0,
    "scale": "10",
    "tap_order": "oldest first",
    "angle_step_deg": None,
    "counts_per_unit": [1, 2],
    "output_unit": "",
    "output_full_scale": -1,
    "contact_level": 1.5,
    "sensor": 4,
    "rows": 4.0,
    "cols": -4,
    "pitch_mm": 0,
    "arithmetic": "int4",
    "interval_factor": 0,
    "confidence": {"1": {"doubt": [0.1], "error": [0.1], "gain": [0.1, 0.2]}},
    "training_sha256": None,
    "test_set_sha256": "",
    "test_error": [],
    "pad_inputs": [["thickness", 4.5, 1.0]],
    "takes_gains": 1,
    "traction_scale": 2.0,
    "trust": {"forward": {}},
    "interval_levels": [1.6, 1.6, 1.6, 1.6],
    "takes_poses": 1,
    "reach_mm": -1,
    "unposed_taps": 0,
}


def read(contract, **changes):
    """Return the contract that is read from the metadata of another one, some of whose keys have other texts."""
    metadata = contract.to_metadata() | {f"tactile.{key}": text for key, text in changes.items()}
    return Contract.from_metadata(metadata)


def test_what_is_written_is_read():
    for contract in (
        make_contract(scale=64, interval_levels={"50": [0.5, 0.6, 0.5, 0.4], "90": [1.6] * 4}, output_unit="m"),
        make_pad_contract(pad_inputs=tuple((name, high, 0.01) for name, (_, high) in PAD_RANGES.items())),
        make_checked_contract(make_posed_trust(1.0)),
        make_contract(made_for={"thickness_mm": [4.9, 5.1], "gains_certainty": [1.0, 1.0]}),
    ):
        assert read(contract) == contract
        assert (read(contract).read_trust() is None) == (contract.trust == {})


def test_a_constant_without_an_interval_is_exact():
    contract = make_pad_contract(pad_inputs=(("poisson", 0.45, 0.02),), takes_gains=False)
    assert contract.pad_row(None).tolist() == [0, 0]
    assert contract.pad_row(Pad(poisson=0.46)).tolist() == pytest.approx([0.5, 1])


def test_counts_become_units_of_the_network_over_the_gains():
    contract = make_contract(counts_per_unit=(100.0, 200.0, 400.0))
    window, gains = np.full((2, 3, 4, 4), 400, dtype=np.float32), np.full((3, 4, 4), 2, dtype=np.float32)
    for scaled, expected in ((contract.scale_window(window), 4), (contract.scale_window(window, gains), 2)):
        assert scaled.dtype == np.float32 and (scaled == np.array([1, 0.5, 0.25])[:, None, None] * expected).all()


@pytest.mark.parametrize("key", [one.name for one in fields(Contract)])
def test_a_key_that_is_missing_or_broken_is_named(key):
    metadata = make_contract().to_metadata()
    for text in ("{", json.dumps(BROKEN_VALUES[key])):
        with pytest.raises(ModelError, match=f"'{key}'"):
            Contract.from_metadata(metadata | {f"tactile.{key}": text})
    del metadata[f"tactile.{key}"]
    if key != "made_for":  # which models of before lack
        with pytest.raises(ModelError, match=f"'{key}' is missing"):
            Contract.from_metadata(metadata)


@pytest.mark.parametrize("version", [CONTRACT_VERSION - 1, CONTRACT_VERSION + 1])
def test_another_version_is_named_not_what_it_lacks(version):
    metadata = make_contract(version=version).to_metadata()
    del metadata["tactile.interval_factor"]
    expected = f"'version' is {version}, expected {CONTRACT_VERSION}: export the model again"
    with pytest.raises(ModelError, match=expected):
        Contract.from_metadata(metadata)


@pytest.mark.parametrize(
    ("key", "text", "match"),
    [
        ("pad_inputs", '[["thickness_mm", "4", 1]]', "a list of"),
        ("pad_inputs", "[4]", r"a list of \[name, centre, spread\]"),
        ("pad_inputs", '[[["thickness_mm"], 1, 1]]', "names of: thickness_mm, shear_modulus_mpa, poisson, in_plane"),
        ("pad_inputs", '[["thickness_mm", -4, 1]]', "centre as a pad may have it"),
        ("pad_inputs", '[["poisson", 0.4, 0.1], ["poisson", 0.4, 0.1]]', "no name twice"),
        ("traction_scale", "0", "a whole number from 1 to 256, or null"),
        ("test_error", '{"1": {"psnr_db": 30.1}, "4": 33.2}', "a map from taps to metrics"),
        *(
            ("made_for", text, "a map to two numbers, of names of: thickness_mm, .*, gains_certainty")
            for text in (
                *('{"colour": [0, 1]}', '{"poisson": [0.4]}'),
                *('{"poisson": ["0.4", 0.5]}', "[]", '{"poisson": 1}'),
            )
        ),
        ("tap_order", f'"{"x" * 98}"', "x', expected"),  # a hundred characters of it are shown
        ("tap_order", f'"{"x" * 99}"', r"x\.\.\., expected"),
    ],
)
def test_one_wrong_value_among_right_ones_is_refused(key, text, match):
    with pytest.raises(ModelError, match=rf"'{key}' is .*{match}"):
        read(make_pad_contract(), **{key: text})


SMALL = {"rows": "1", "cols": "1", "scale": "16"}
POSED = {"takes_poses": "true"}


@pytest.mark.parametrize(
    ("lawful", "one_more", "match"),
    [
        *(
            (SMALL | {key: str(most)}, {key: str(most + 1)}, f"1 to {most}")
            for key, most in {"taps": 64, "rows": 64, "cols": 64}.items()
        ),
        (SMALL | {"scale": "256"}, {"scale": "257"}, "1 to 256"),
        ({"rows": "64", "cols": "64", "scale": "16"}, {"scale": "17"}, "patterns of at most 1048576 pixels"),
        (SMALL | {"traction_scale": "256"}, {"traction_scale": "257"}, "1 to 256, or null"),
        ({"traction_scale": "147"}, {"traction_scale": "148"}, "tractions of at most 1048576 numbers"),
        ({"contact_level": "0.999"}, {"contact_level": "1"}, "a number below 1"),
        ({"pad_inputs": '[["poisson", 0, 1e-6]]'}, {"pad_inputs": '[["poisson", 0, 9e-7]]'}, "spread from 1e-06"),
        ({"pitch_mm": "1e-6"}, {"pitch_mm": "9e-7"}, "a positive number from 1e-06"),
        ({"counts_per_unit": "[1, 1, 1e-6]"}, {"counts_per_unit": "[1, 1, 9e-7]"}, "three positive numbers from"),
        (POSED | {"reach_mm": "1e-6"}, {"reach_mm": "0"}, "a number from 1e-06 for a model that takes poses"),
        (POSED | {"reach_mm": "1"}, {"reach_mm": "true"}, "a number from 1e-06 for a model that takes poses"),
        ({"output_unit": f'"{"m" * 100}"'}, {"output_unit": f'"{"m" * 101}"'}, "a printable text of 1 to 100"),
        ({"taps": "4".ljust(1 << 20)}, {"taps": "4".ljust((1 << 20) + 1)}, "1048577 characters, expected at most"),
    ],
)
def test_a_contract_is_taken_up_to_its_limits(lawful, one_more, match):
    read(make_contract(), **lawful)
    with pytest.raises(ModelError, match=match):
        read(make_contract(), **lawful | one_more)


def test_a_sensor_that_the_model_was_not_trained_for_is_refused():
    make_contract().check_sensor(USPA44)
    for key, name, value in (("sensor", "name", "other"), *((key, key, 5) for key in ("rows", "cols", "pitch_mm"))):
        with pytest.raises(ModelError, match=f"contract key '{key}' is"):
            make_contract().check_sensor(replace(USPA44, **{name: value}))


def test_a_pad_far_outside_the_training_is_told():
    """The sample was trained on pads of 4.5 mm, half a millimetre either way."""
    for pad, outside in (
        (None, False),
        (Pad(thickness_mm=5.25), False),
        (Pad(thickness_mm=5.3), True),
        (Pad(thickness_mm=3.7), True),
        (Pad(thickness_mm=5.3, intervals={"thickness_mm": (5.0, 5.6)}), False),
        (Pad(thickness_mm=7.0, intervals={"thickness_mm": (5.5, 8.5)}), True),
        (Pad(counts_per_newton=2000.0), True),
    ):
        assert make_pad_contract().is_outside(pad) is outside, pad


def test_any_other_pad_is_outside_for_a_model_of_one_sensor():
    of_gains = make_contract(made_for={"gains_certainty": [0.5, 1.0]})
    for pad, outside in (
        (None, True),
        (Pad(), True),
        (Pad(thickness_mm=4.9), False),
        (Pad(thickness_mm=4.89), True),
        (Pad(thickness_mm=5.11), True),
        (Pad(thickness_mm=5.2, intervals={"thickness_mm": (5.1, 5.3)}), False),
        (Pad(thickness_mm=5.0, intervals={"thickness_mm": (5.2, 5.4)}), True),
    ):
        assert make_contract(made_for={"thickness_mm": [4.9, 5.1]}).is_outside(pad) is outside, pad
        assert of_gains.is_outside(pad)
    assert not of_gains.is_outside(Pad(gains=(1.0,) * 48, gain_half_widths=(0.0,) * 48))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"cols": 6, "sensor": "uSPa46", "pitch_mm": 7.25}, "for 48 readings, the sensor has 72"),
        ({"takes_gains": False}, "for a model that takes gains"),
        ({"pad_inputs": (("thickness_mm", 4.5, 0.5),)}, ""),
    ],
)
def test_checks_of_another_pad_or_input_are_refused(changes, why):
    with pytest.raises(ModelError, match=rf"contract key 'trust' is damaged \(.*{why}.*export the model again"):
        read(make_trusted_contract(**changes))
