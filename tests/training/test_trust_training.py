"""Training of checks: the fit of forward model and networks, their file, and their limits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import write_model
from press_samples import make_press_set
from trust_samples import make_trusted_contract

from edge.inference.trust_model import small_network
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose
from train import trust
from train.data.press_batches import stated_poses
from train.data.presses import PressSet
from train.errors import CheckpointError
from train.learning.checks import (
    contact_check,
    drawn_readings,
    features_of,
    fit_tap_network,
    in_contact,
    pair_features,
    relative,
    strong_taps,
    tap_check,
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


def test_a_linear_world_is_found_again(presses):
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


def test_it_comes_back(path, presses, tmp_path):
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
def test_none_and_a_damaged_one_are_named(path, presses, tmp_path, damage):
    if (content := damage(json.loads(path.read_text()))) is not None:
        (tmp_path / "bad.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"bad\.json: .*make it with 'python -m train.trust"):
        load_trust(tmp_path / "bad.json", presses)


def test_what_cannot_be_fitted_ends_in_a_line(tmp_path):
    make_press_set(taps=1).save(tmp_path / "one.npz")
    for name, told in (("none.npz", r"none\.npz"), ("one.npz", "no sequences of several taps")):
        with pytest.raises(SystemExit, match=rf"trust: .*{told}"):
            trust.main([str(tmp_path / "trust.json"), "--data", str(tmp_path / name)])
    assert not (tmp_path / "trust.json").exists()


TAPS = 4
WIDE_MM = 4.0
FALSE_ALARMS = 0.05
FLAT = np.array([0.0, 0.0, 1.0])[:, None, None]


def bumps(count: int, seed: int) -> PressSet:
    """Return sequences of taps at any poses over bumps, newest first."""
    rng = np.random.default_rng([seed, 1])
    made = make_press_set(count, TAPS, seed)
    poses = np.concatenate([rng.uniform(-3, 3, (count, TAPS, 2)), rng.uniform(-45, 45, (count, TAPS, 1))], axis=2)
    poses[:, 0] = 0
    along = (np.arange(4) - 1.5) * USPA44.pitch_mm
    turn = np.radians(poses[..., 2])[..., None, None]
    x = poses[..., 0, None, None] + np.cos(turn) * along - np.sin(turn) * along[:, None]
    y = poses[..., 1, None, None] + np.sin(turn) * along + np.cos(turn) * along[:, None]
    bump = rng.uniform(-5, 5, (2, count, 1, 1, 1))
    z = 3000 * np.exp(-((x - bump[0]) ** 2 + (y - bump[1]) ** 2) / (2 * WIDE_MM**2))
    return replace(made, counts=(z[:, :, None] * FLAT).astype(np.float32), poses=poses.astype(np.float32))


def test_relative_poses_are_those_that_a_pad_is_seen_at():
    rng = np.random.default_rng(3)
    newest, earlier = (np.stack([*rng.uniform(-5, 5, (2, 20)), rng.uniform(-200, 200, 20)], axis=1) for _ in "ab")
    seen = [PadPose(*one.tolist()).seen_from(PadPose(*new.tolist())) for new, one in zip(newest, earlier, strict=True)]
    assert relative(newest, earlier) == pytest.approx(
        np.array([(one.x_mm, one.y_mm, one.turn_deg) for one in seen]), abs=1e-4
    )


@pytest.fixture(scope="module")
def network():
    return fit_tap_network(bumps(300, 0), seed=0, steps=300)


def shares_caught(network, presses, spoil):
    """Return the share of earlier taps that a check at a share of false alarms catches, after `spoil` of a pair."""
    check = tap_check(network, bumps(300, 1), FALSE_ALARMS, seed=2)
    rng = np.random.default_rng(5)
    readings, poses = strong_taps(presses, 5)
    pose = poses[:, 1]
    stated = stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1), (0.2, 1.0))
    pair, stated = spoil(readings[:, :2], stated)
    return float((np.array(network(pair_features(pair, stated))) > check.limit).mean())


def test_right_taps_are_seldom_dropped_and_wrong_ones_mostly(network):
    presses = bumps(300, 9)

    def off(pair, stated):
        return pair, stated + np.array([[0] * 5, [5.0, 0, 0, 0, 0]], np.float32)

    def foreign(pair, stated):
        return np.stack([pair[:, 0], pair[::-1, 1]], 1), stated

    assert shares_caught(network, presses, lambda *right: right) < 2 * FALSE_ALARMS
    assert shares_caught(network, presses, off) > 0.5 and shares_caught(network, presses, foreign) > 0.5


def test_contacts_exceed_their_limit_by_the_share(path, presses):
    share, network = 0.2, small_network(json.loads(path.read_text())["contact"])
    check = contact_check(network, presses, share, seed=5)
    counts, pads = drawn_readings(presses, 5)
    met = in_contact(counts)
    scores = np.array(network(features_of(counts[met], pads[met])))
    assert len(scores) > 10 and share - 2 / len(scores) <= (scores > check.limit).mean() <= share
