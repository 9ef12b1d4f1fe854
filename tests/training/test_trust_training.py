"""Training of checks: the fit of forward model and networks, their file, and their limits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import write_model
from press_samples import make_press_set
from trust_samples import make_trusted_contract

from edge.inference.trust import small_network
from train import trust
from train.errors import CheckpointError
from train.learning.checks import (
    contact_check,
    drawn_readings,
    features_of,
    in_contact,
)
from train.physics.pad_draws import INPUTS, input_scale
from train.trust import fit_forward_model, fit_trust, load_trust

STEPS = (40, 20)


@pytest.fixture(scope="module")
def presses():
    return make_press_set(count=60, taps=4)


@pytest.fixture(scope="module")
def path(presses, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trust")
    (folder / "trust.json").write_text(json.dumps(fit_trust(presses, 1, *STEPS)))
    return folder / "trust.json"


class TestForward:
    def test_a_linear_world_is_found_again(self, presses):
        """Readings that are a linear map of pattern and drag leave nothing."""
        rng = np.random.default_rng(0)
        many = make_press_set(count=600, taps=1)
        patterns = rng.uniform(0, 0.5, (600, 8, 8)).repeat(5, axis=1).repeat(5, axis=2)
        drag = rng.normal(0, 20, (600, 3, 4, 4)).repeat(2, axis=2).repeat(2, axis=3)
        many = replace(many, patterns=patterns.astype(np.float16), traction_kpa=drag.astype(np.float16))
        cells = np.concatenate(
            [many.patterns[:, ::5, ::5].reshape(600, -1), many.traction_kpa[:, :2, ::2, ::2].reshape(600, -1) / 30],
            axis=1,
        )
        counts = (cells.astype(np.float32) @ rng.normal(0, 200, (cells.shape[1], 48))).reshape(600, 1, 3, 4, 4)
        found = fit_forward_model(replace(many, counts=counts.astype(np.float32)))
        assert found.model_error.max() < 0.05
        assert found.operator.shape == (1 + len(INPUTS), 48, 96)


class TestFile:
    def test_it_comes_back(self, path, presses, tmp_path):
        fitted = json.loads(path.read_text())
        assert set(fitted) == {"forward", "contact", "tap", "data_sha256"}
        assert fitted["data_sha256"] == presses.sha256()
        loaded = load_trust(path, presses)
        assert loaded.contact.network.to_json() == fitted["contact"] and loaded.forward.to_json() == fitted["forward"]
        model = write_model(
            tmp_path / "checks.onnx", make_trusted_contract(trust=loaded.to_json(), pad_inputs=tuple(input_scale()))
        )
        assert load_trust(model).to_json() == loaded.to_json()
        with pytest.raises(CheckpointError, match="its limits are set by presses: give --validation"):
            load_trust(path)
        assert fit_trust(presses, 1, *STEPS) == fitted

    @pytest.mark.parametrize(
        "damage",
        [
            lambda one: json.dumps({**one, "contact": []}),
            lambda one: json.dumps({name: value for name, value in one.items() if name != "tap"}),
            lambda one: "{",
            lambda one: None,
        ],
    )
    def test_none_and_a_damaged_one_are_named(self, path, presses, tmp_path, damage):
        if (content := damage(json.loads(path.read_text()))) is not None:
            (tmp_path / "bad.json").write_text(content)
        with pytest.raises(CheckpointError, match=r"bad\.json: .*make it with 'python -m train.trust"):
            load_trust(tmp_path / "bad.json", presses)

    def test_what_cannot_be_fitted_ends_in_a_line(self, tmp_path):
        make_press_set(taps=1).save(tmp_path / "one.npz")
        for name, told in (("none.npz", r"none\.npz"), ("one.npz", "no sequences of several taps")):
            with pytest.raises(SystemExit, match=rf"trust: .*{told}"):
                trust.main([str(tmp_path / "trust.json"), "--data", str(tmp_path / name)])
        assert not (tmp_path / "trust.json").exists()


class TestLimits:
    def test_contacts_exceed_theirs_by_the_share(self, path, presses):
        share = 0.2
        network = small_network(json.loads(path.read_text())["contact"])
        check = contact_check(network, presses, share, seed=5)
        counts, pads = drawn_readings(presses, 5)
        met = in_contact(counts)
        scores = np.array(network(features_of(counts[met], pads[met])))
        assert len(scores) > 10 and share - 2 / len(scores) <= (scores > check.limit).mean() <= share
