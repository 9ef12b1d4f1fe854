"""Training of checks: faults that are played, the fit of forward model and networks, their file, and their limits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from edge_samples import write_model
from press_samples import make_press_set
from trust_samples import make_trusted_contract

from edge.inference.trust import small_network
from train import trust
from train.data.press_batches import network_input, stated_poses
from train.errors import CheckpointError, DatasetError
from train.learning.checks import (
    SPOILINGS,
    contact_check,
    drawn_readings,
    features_of,
    fit_classifier,
    in_contact,
    magnet_field,
    moved,
    pair_features,
    spoiled,
    strong_taps,
    tap_check,
)
from train.networks.compact import CompactNet
from train.networks.symmetric import symmetries
from train.physics.pad_draws import INPUTS, input_scale
from train.trust import fit_forward_model, fit_trust, load_trust

SHORTEN = 1000


def readings(count=40, seed=0):
    counts = np.random.default_rng(seed).normal(0, 300, (count, 3, 4, 4)).astype(np.float32)
    counts[:, 2] = np.abs(counts[:, 2]) * 5 + 200
    return counts


@pytest.fixture(scope="module")
def presses():
    return make_press_set(count=60, taps=4)


@pytest.fixture(scope="module")
def path(presses, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trust")
    presses.save(folder / "presses.npz")
    trust.main([str(folder / "trust.json"), "--data", str(folder / "presses.npz"), "--shorten", str(SHORTEN)])
    return folder / "trust.json"


class TestWrongReadings:
    @pytest.mark.parametrize("spoil", SPOILINGS)
    def test_a_fault_changes_readings_and_leaves_those_it_was_given(self, spoil):
        counts = readings()
        kept = counts.copy()
        wrong = spoil(np.random.default_rng(1), counts)
        assert np.array_equal(counts, kept) and not np.shares_memory(wrong, counts)
        assert wrong.shape == counts.shape and np.isfinite(wrong).all()
        assert (wrong != counts).any(axis=(1, 2, 3)).mean() > 0.5
        assert np.array_equal(spoil(np.random.default_rng(1), counts), wrong)

    def test_every_reading_gets_a_fault(self):
        counts = readings(90)
        kept = counts.copy()
        wrong = spoiled(np.random.default_rng(0), counts)
        assert np.array_equal(counts, kept) and not np.shares_memory(wrong, counts)
        changed = (wrong != counts).any(axis=(1, 2, 3))
        axes_turned = changed & (np.abs(wrong) == np.abs(counts)).all(axis=(1, 2, 3))
        assert changed.mean() > 0.9 and axes_turned.sum() == 90 / len(SPOILINGS)

    def test_a_far_magnet_has_no_curl_on_the_pad(self):
        """Without currents, x changes along y as y does along x."""
        field = magnet_field(np.random.default_rng(0), 200).astype(np.float64)
        x_down = np.gradient(field[:, 0], axis=1)[:, 1:-1, 1:-1]
        y_right = np.gradient(field[:, 1], axis=2)[:, 1:-1, 1:-1]
        assert np.median(np.abs(x_down - y_right)) < 0.06 * np.median(np.abs(x_down))


class TestMoved:
    def test_it_agrees_with_a_network_that_has_these_symmetries(self):
        """A pattern of moved readings is the moved pattern, or else places and axes were not moved alike."""
        torch.manual_seed(0)
        net = CompactNet(1, 4, channels=16, blocks=1, group="p4m").eval()
        counts = readings(64)
        found = moved(np.random.default_rng(2), counts)
        with torch.no_grad():
            plain, after = (net(network_input(one[:, None]))[0].numpy() for one in (counts, found))
        moves = symmetries("p4m")
        agrees = np.array(
            [[np.allclose(a, move(p), atol=1e-4) for move in moves] for a, p in zip(after, plain, strict=True)]
        )
        assert agrees.any(axis=1).all() and agrees.any(axis=0).all()
        assert np.abs(plain[0] - plain[0].T).max() > 0.01  # moves can be told apart


class TestClassifier:
    def test_it_learns_what_is_not_linear(self):
        rng = np.random.default_rng(0)
        points = rng.uniform(-2, 2, (4000, 3)).astype(np.float32) * (1, 10, 100) + (0, 5, -300)
        inside = ((points - (0, 5, -300)) / (1, 10, 100))[:, :2] ** 2 @ (1, 1) < 1.5
        points = points.astype(np.float32)
        network = fit_classifier(points[inside], points[~inside], (24,), 1500, seed=0, weight_decay=3e-3)
        found = np.array(network(points)) > 0
        assert (found == ~inside).mean() > 0.95 and network.inputs == 3


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
        again = fit_trust(presses, seed=1, shorten=SHORTEN)
        assert again == fitted

    @pytest.mark.parametrize(
        "damage",
        [
            lambda one: json.dumps({**one, "contact": []}),
            lambda one: json.dumps({name: value for name, value in one.items() if name != "tap"}),
            lambda one: json.dumps({**one, "forward": {}}),
            lambda one: "{",
            lambda one: None,
        ],
    )
    def test_none_and_a_damaged_one_are_named(self, path, presses, tmp_path, damage):
        if (content := damage(json.loads(path.read_text()))) is not None:
            (tmp_path / "bad.json").write_text(content)
        with pytest.raises(CheckpointError, match=r"bad\.json: .*make it with 'python -m train.trust"):
            load_trust(tmp_path / "bad.json", presses)

    def test_presses_of_one_tap_cannot_tell_taps_apart(self):
        with pytest.raises(DatasetError, match="no sequences of several taps"):
            fit_trust(make_press_set(taps=1), seed=1, shorten=SHORTEN)

    def test_the_command_ends_in_a_line_without_its_data(self, tmp_path):
        with pytest.raises(SystemExit, match=r"trust: .*none\.npz"):
            trust.main([str(tmp_path / "trust.json"), "--data", str(tmp_path / "none.npz")])
        assert not (tmp_path / "trust.json").exists()


class TestLimits:
    @pytest.mark.parametrize("share", [0.02, 0.2])
    def test_contacts_exceed_theirs_by_the_share(self, path, presses, share):
        network = small_network(json.loads(path.read_text())["contact"])
        check = contact_check(network, presses, share, seed=5)
        counts, pads = drawn_readings(presses, 5)
        met = in_contact(counts)
        scores = np.array(network(features_of(counts[met], pads[met])))
        assert len(scores) > 10 and share - 2 / len(scores) <= (scores > check.limit).mean() <= share

    @pytest.mark.parametrize("share", [0.02, 0.2])
    def test_taps_exceed_theirs_by_the_share(self, path, presses, share):
        network = small_network(json.loads(path.read_text())["tap"])
        check = tap_check(network, presses, share, seed=5)
        readings, poses = strong_taps(presses, 5)
        pairs = [
            pair_features(
                readings[:, [0, earlier]],
                stated_poses(np.random.default_rng(8), poses[:, [0, earlier]], (0.2, 1.0)),
            )
            for earlier in range(1, presses.taps)
        ]
        scores = np.array(network(np.concatenate(pairs)))
        assert len(scores) and (scores > check.limit).mean() == pytest.approx(share, abs=0.03)
