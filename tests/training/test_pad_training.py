"""A small network for a pad of 4 x 6 taxels: simulated, trained and exported; its bytes are read elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from edge import api
from export.to_onnx import export
from firmware_bridge.pad_geometry import USPA44, USPA46
from train.data.frozen_presses import freeze_presses
from train.data.world import World, solve_pad
from train.errors import DatasetError
from train.families.family_shares import tap
from train.learning.checkpoint import Training, fit_network
from train.learning.training_loop import Recipe
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import KNOWN, NOMINAL
from train.physics.taxel_response import on_pad
from train.surfaces.depth_image import Pose

SCALE = 4
OPTIONS = {"channels": 16, "blocks": 1, "group": "p2", "known": KNOWN}
TRAINING = Training("pad46", "compact-stsr", Recipe(steps=30, batch=12, learning_rate=8e-3), SCALE, options=OPTIONS)
WORLD = World(count=24, per_pad=24, families={"large square": 1.0, "C": 1.0}, spread=0.0, scale=SCALE, pad="uSPa46")


def test_a_network_of_another_pad_learns_and_says_of_which(tmp_path):
    presses = solve_pad(WORLD, 0)
    seen = freeze_presses(presses, 1).as_frozen_set()
    begun = replace(TRAINING, name="begun", recipe=replace(TRAINING.recipe, steps=6))
    first, last = (fit_network(one, presses, seen, tmp_path)["validation_psnr_db"] for one in (begun, TRAINING))
    assert last > first + 1
    export(tmp_path / "pad46.pt", tmp_path, seen)
    contract = api.load_model(tmp_path / "pad46.onnx").contract
    assert (
        (contract.sensor, contract.pattern_shape) == ("uSPa46", (16, 24)) == (USPA46.name, USPA46.pattern_shape(SCALE))
    )


def test_nothing_touches_beyond_a_rectangular_pad():
    pad = GrippedPad(replace(NOMINAL, model="uSPa46"))
    poses = (Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 180.0))
    taps = tap(pad, ["large square"] * 2, poses, 2.0)
    assert taps.unit_patterns.shape == (2, 80, 120) and taps.counts.shape[2:] == (3, 4, 6)
    once, turned = taps.counts[:, -1]
    signs = np.array([-1, -1, 1])[:, None, None]
    np.testing.assert_allclose(turned, signs * once[:, ::-1, ::-1], atol=0.02 * np.abs(once).max())
    cells = on_pad(USPA46, pad.size, pad.cell_mm)
    assert cells.shape == (60, 60) and cells.sum() == 40 * 60
    assert on_pad(USPA44, 42, 0.47).all()


def test_a_set_of_the_default_pad_keeps_its_name():
    assert "pad" not in World(count=1).facts() and WORLD.facts()["pad"] == "uSPa46"
    with pytest.raises(DatasetError, match="pad is 'uSPa4', expected one of uSPa44, uSPa46"):
        World(pad="uSPa4")
