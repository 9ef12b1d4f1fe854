"""A small network for a pad of 4 x 6 taxels: simulated, trained, exported, and fed with bytes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edge import api
from edge.evaluation.test_set import FrozenSet
from export.to_onnx import export
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.pad_geometry import USPA44, USPA46
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.zeroing.baseline import Baseline
from train.data.frozen_presses import freeze_presses
from train.data.paper_taps import tap
from train.data.presses import PressSet, join_presses
from train.data.world import World, solve_pad
from train.errors import DatasetError
from train.learning.checkpoint import Training, fit_network
from train.learning.training_loop import Recipe
from train.networks.compact import CompactNet
from train.networks.symmetric import symmetries
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import KNOWN, NOMINAL
from train.physics.taxel_response import on_pad
from train.surfaces.depth_image import Pose

SCALE = 4
SURFACES = ("small square", "large square", "small circle", "C", "L")
REST_COUNTS = np.array([16_000, 16_400, 38_600])[:, None, None]
REST_SCANS = 20
CONTACT_COUNTS = 2000
TRAINING = Training(
    "pad46",
    "compact-stsr",
    Recipe(steps=60, batch=16, learning_rate=8e-3),
    scale=SCALE,
    options={"channels": 16, "blocks": 1, "group": "p2", "known": KNOWN},
)


def presses(count: int, seed: int) -> PressSet:
    families = dict.fromkeys(SURFACES, 1.0)
    nominal = {"per_pad": count, "spread": 0.0, "begun": 0.0, "scale": SCALE, "pad": "uSPa46"}
    world = World(count=count, families=families, seed=seed, **nominal)
    return join_presses([solve_pad(world, number) for number in range(world.chunks)])


@pytest.fixture(scope="module")
def unseen() -> FrozenSet:
    """Presses at other poses than those trained on, without noise."""
    return freeze_presses(presses(12, seed=9), 1).as_frozen_set()


@pytest.fixture(scope="module")
def model(unseen, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pad46")
    torch.set_num_threads(1)
    fit_network(TRAINING, presses(40, seed=3), unseen, folder)
    export(folder / "pad46.pt", folder, unseen)
    return folder / "pad46.onnx"


def test_bytes_of_24_taxels_become_a_pattern_that_beats_a_flat_guess(model, unseen, tmp_path):
    rest = np.broadcast_to(REST_COUNTS, USPA46.scan_shape)
    last = [int(np.flatnonzero(unseen.tap == tap)[-1]) for tap in range(len(unseen.surface))]
    last = [frame for frame in last if unseen.newest[frame, 2].sum() > CONTACT_COUNTS]
    gap = np.zeros((REST_SCANS, *USPA46.scan_shape), dtype=int)
    parts = [gap, *(part for frame in last for part in (np.repeat(unseen.newest[frame][None], 15, axis=0), gap))]
    counts = rest + np.concatenate(parts)
    counts += np.random.default_rng(0).integers(-2, 3, counts.shape)  # bit for bit alike it would be taken for frozen
    recording = Recording(tmp_path / "none.npz", (Track("4", counts.astype(np.int32), None),), 50.0)
    baselines = {"4": Baseline.of("4", rest, 1.7e9, 100, "file")}
    loaded = api.load_model(model)
    made: dict[int, np.ndarray] = {}
    assert len(last) > 5
    with (
        Emulator([recording]) as emulator,
        api.open_source(f"slcan:{emulator.port}", id_map="uSPa46", give_up_s=0) as source,
    ):
        runtime = api.open_runtime(loaded, source, baselines=baselines, follow_drift=False)
        try:
            for result in api.Stream(source, runtime):
                if result.pattern is not None:
                    made[(result.scan.number - REST_SCANS) // (REST_SCANS + 15)] = result.pattern
        except api.LinkLostError:
            pass
    assert set(made) == set(range(len(last)))
    truth = unseen.patterns()[last]
    patterns = np.array([made[tap] for tap in sorted(made)])
    assert patterns.shape == truth.shape == (len(last), *USPA46.pattern_shape(SCALE)) == (len(last), 16, 24)
    flat = np.broadcast_to(truth.mean(axis=(1, 2), keepdims=True), truth.shape)  # even with the right mean
    error, guess = (float(np.sqrt(np.square(one - truth).mean())) for one in (patterns, flat))
    assert error < 0.6 * guess, f"{error:.4f} mm, a flat guess {guess:.4f} mm"


def test_a_model_of_one_pad_is_refused_by_the_other(model):
    with api.open_source("demo") as source, pytest.raises(api.ModelError) as refused:
        api.open_runtime(model, source)
    assert "uSPa46 of 4 x 6 taxels, the sensor is a uSPa44 of 4 x 4" in str(refused.value)


def test_nothing_touches_beyond_the_pad_and_a_half_turn_is_a_half_turn():
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


def test_a_network_with_half_turns_keeps_them_on_a_pad_that_is_not_square():
    torch.manual_seed(0)
    net = CompactNet(1, SCALE, channels=16, blocks=1, group="p2").eval()
    window = torch.randn(3, 3, 4, 6)
    turned = window.flip(2, 3) * torch.tensor([-1.0, -1.0, 1.0])[:, None, None]
    for before, after, signs in zip(
        net(window), net(turned), (1, 1, torch.tensor([-1.0, -1.0, 1.0])[:, None, None]), strict=True
    ):
        torch.testing.assert_close(after, before.flip(-2, -1) * signs, atol=1e-5, rtol=1e-4)
    assert len(symmetries("p2")) == 2


def test_a_set_of_the_default_pad_keeps_its_name():
    assert "pad" not in World(count=1).facts() and World(count=1, pad="uSPa46").facts()["pad"] == "uSPa46"
    with pytest.raises(DatasetError, match="pad is 'uSPa4', expected one of uSPa44, uSPa46"):
        World(pad="uSPa4")
