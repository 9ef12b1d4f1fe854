"""Checks in a model's contract: read as they were written, refused in one line where they are damaged."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from edge_samples import make_pad_contract, write_model
from trust_samples import CONSTANTS, make_trust, make_trusted_contract

from edge.errors import ModelError
from edge.inference.contract import CONTRACT_VERSION, Contract
from edge.inference.onnx_session import ModelSession
from edge.inference.small_network import packed
from edge.inference.trust import trust_of


def changed(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    """Return the sample's checks as JSON after a change."""
    value = json.loads(json.dumps(make_trust().to_json()))
    change(value)
    return value


def put(*path: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that puts the last of a path at the place that the others name."""
    *road, last, new = path

    def change(value: Any) -> None:
        for step in road:
            value = value[step]
        value[last] = new

    return change


DAMAGE = {
    "a part is missing": lambda value: value.pop("tap"),
    "a part is too many": put("more", 1),
    "no forward model": put("forward", None),
    "a key of the forward model is missing": lambda value: value["forward"].pop("noise"),
    "an operator for other constants": put("forward", "operator", packed(np.ones((2 + CONSTANTS, 48, 96)))),
    "an operator of other features": put("forward", "operator", packed(np.ones((1 + CONSTANTS, 48, 95)))),
    "an operator without a shape": put("forward", "operator", {"shape": [], "f2": "AAA="}),
    "an endless shape": put("forward", "noise", "shape", [math.inf]),
    "bytes cut short": put("forward", "noise", "f2", "AAAA"),
    "noise below 0": put("forward", "noise", packed(np.array([1.0, 1.0, -1.0]))),
    "more in the forward model": put("forward", "more", 1.0),
    "a contact limit that is no number": put("contact", "limit", math.nan),
    "a contact network without layers": put("contact", "layers", []),
    "a contact network of a tap's features": lambda value: value.update(contact=value["tap"]),
    "a tap network of a contact's features": lambda value: value.update(tap=value["contact"]),
    "a list": lambda value: value.clear() or value.update(list=1),
}


class TestTrust:
    def test_it_comes_back(self):
        made = make_trust()
        again = trust_of(json.loads(json.dumps(made.to_json())), CONSTANTS)
        assert again is not None
        row = np.linspace(-1, 1, 100, dtype=np.float32)
        assert again.tap.network(row[None]) == made.tap.network(row[None]) and again.tap.limit == made.tap.limit
        assert again.contact.network(row[None, :54]) == made.contact.network(row[None, :54])
        assert np.array_equal(again.forward.operator, made.forward.operator)

    def test_nothing_is_no_checks(self):
        assert trust_of({}, CONSTANTS) is None

    @pytest.mark.parametrize("value", [None, [], 3, "text"])
    def test_what_is_no_map_is_refused(self, value):
        with pytest.raises(ValueError, match="expected forward, contact, tap"):
            trust_of(value, CONSTANTS)

    @pytest.mark.parametrize("damage", DAMAGE)
    def test_damage_is_refused(self, damage):
        with pytest.raises(ValueError, match=r"\w"):
            trust_of(changed(DAMAGE[damage]), CONSTANTS)


class TestContract:
    def test_a_model_file_keeps_its_checks(self, tmp_path):
        model = ModelSession(write_model(tmp_path / "checks.onnx", make_trusted_contract()))
        trust = model.contract.read_trust()
        assert trust is not None and trust.contact.limit == pytest.approx(5.0)

    @pytest.mark.parametrize("damage", DAMAGE)
    def test_damage_is_told_in_a_line_that_names_the_key(self, damage):
        contract = replace(make_trusted_contract(), trust=changed(DAMAGE[damage]))
        with pytest.raises(ModelError, match="contract key 'trust' is damaged") as told:
            Contract.from_metadata(contract.to_metadata())
        assert "\n" not in str(told.value) and "export the model again" in str(told.value)

    @pytest.mark.parametrize(
        "changes",
        [
            {"cols": 6, "sensor": "uSPa46", "pitch_mm": 7.25},
            {"takes_gains": False},
            {"pad_inputs": ()},
            {"pad_inputs": (("thickness_mm", 4.5, 0.5),)},
        ],
    )
    def test_checks_of_another_pad_or_input_are_refused(self, changes):
        with pytest.raises(ModelError, match="contract key 'trust'"):
            Contract.from_metadata(make_trusted_contract(**changes).to_metadata())

    def test_a_model_must_have_the_key(self):
        metadata = make_pad_contract(version=CONTRACT_VERSION).to_metadata()
        assert Contract.from_metadata(metadata).read_trust() is None
        del metadata["tactile.trust"]
        with pytest.raises(ModelError, match="'trust' is missing"):
            Contract.from_metadata(metadata)
