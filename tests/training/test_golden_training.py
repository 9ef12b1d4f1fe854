"""Presses, readings and batches are those that models were trained on: any change of the simulated world shows here.

python tests/training/test_golden_training.py writes them again, where a change is meant.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from train.data.press_batches import PosedBatches, PressBatches, read_presses, stated_poses
from train.data.presses import join_presses
from train.data.world import World, solve_pad
from train.experiments.trust_checks import FAULTS
from train.families.catalogue import SHARES
from train.learning.checks import moved, spoiled
from train.physics.sensor_noise import Nuisances
from train.physics.tpsf import resample

GOLDEN = Path(__file__).with_name("golden_training.npz")
WORLD = World(count=42, per_pad=14, taps=2, families=dict.fromkeys(SHARES, 1.0), seed=5)
FLAT = {"flat": 3.0, "dome": 1.0}
BEGUN = replace(WORLD, count=12, per_pad=12, schedule="turns", begun=1.0, families=FLAT, spread=0.0)
STRONG = Nuisances(dead_taxels=0.1, saturation_counts=(1000.0, 1200.0, 5000.0))
WITHIN = 3e-4  # mean difference over the largest value: processors round differently, at a contact's edge by a pixel


def made():
    """Two presses of every family on three pads, their readings, and three batches of them."""
    presses = join_presses([solve_pad(WORLD, number) for number in range(WORLD.chunks)])
    arrays = {name: getattr(presses, name) for name in ("constants", "counts", "poses", "angle_deg", "force_n")}
    arrays |= {name: getattr(presses, name) for name in ("twist_nmm", "indentation_mm")}
    arrays["patterns"] = resample(presses.patterns, 10, 2)
    arrays["touching"] = presses.touching.mean(axis=(1, 2))
    arrays["traction_kpa"] = resample(presses.traction_kpa.reshape(-1, 8, 8), 2, 1)
    arrays["readings"] = read_presses(presses.with_taps(3), STRONG, 7)
    arrays["spoiled"] = spoiled(np.random.default_rng(4), arrays["readings"][:, 0])
    arrays["moved"] = moved(np.random.default_rng(4), arrays["readings"][:, 0])
    one_sensor = arrays["readings"][:5, 0]
    arrays["faults"] = np.stack([fault(np.random.default_rng(1), one_sensor) for fault in FAULTS.values()])
    arrays["stated"] = stated_poses(np.random.default_rng(4), presses.poses, (0.2, 1.0))
    for name, batch in (
        ("turned", PressBatches(presses, (0.4, 0.6), 16, seed=3)(2)),
        ("mirrored", PressBatches(presses, (1.0,), 16, seed=3)(2)),
        ("posed", PosedBatches(presses, (0.4, 0.6), 16, seed=3)(1)),
    ):
        arrays |= {f"{name} window": batch.window.numpy(), f"{name} pad": batch.pad.numpy()}
        if batch.poses is not None:
            arrays[f"{name} poses"] = batch.poses.numpy()
    begun = solve_pad(BEGUN, 0)
    return arrays | {"begun": begun.counts, "begun constants": begun.constants, "domes": begun.family == "dome"}


def test_the_world_is_the_one_that_models_were_trained_on():
    golden = dict(np.load(GOLDEN))
    arrays = made()
    assert set(arrays) == set(golden)
    for name, expected in golden.items():
        assert arrays[name].shape == expected.shape, name
        found = arrays[name].astype(np.float32)
        assert np.abs(found - expected).mean() <= WITHIN * np.abs(expected).max(), name


if __name__ == "__main__":
    arrays = {name: array.astype(np.float32) for name, array in made().items()}
    np.savez_compressed(GOLDEN, allow_pickle=False, **arrays)
