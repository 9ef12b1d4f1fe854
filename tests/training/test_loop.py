import json
import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from edge_samples import ROOT

from train.data.press_batches import Batch
from train.errors import CheckpointError
from train.learning.training_loop import DivergedError, Recipe, drawn_ahead, learning_rate_share, train
from train.networks.blocks import PatternNet, RelativeError

RECIPE = Recipe(steps=12, batch=4, learning_rate=1e-2)


class Map(PatternNet):
    """The least network: a linear map with something random in training."""

    def __init__(self):
        super().__init__()
        self.taps, self.scale = 1, 1
        self.matrix = torch.nn.Linear(48, 16)
        self.dropout = torch.nn.Dropout(0.0)

    def forward(self, window):
        return self.matrix(window.flatten(1)).view(-1, 4, 4)


def new_net():
    torch.manual_seed(0)
    return Map()


def batches(number):
    rng = np.random.default_rng(number)
    window = torch.from_numpy(rng.standard_normal((4, 3, 4, 4)).astype(np.float32))
    return Batch(window, window[:, 2] * 0.1 + 1)


def weights(net):
    return torch.cat([value.flatten() for value in net.state_dict().values()])


def trained(tmp_path, recipe=RECIPE, **options):
    net = new_net()
    train(net, RelativeError(), batches, recipe, tmp_path / "net.resume", **options)
    return net


def test_the_rate_rises_for_a_tenth_and_falls_to_nothing():
    shares = [learning_rate_share(progress) for progress in np.linspace(0, 1, 101)]
    assert shares[0] == pytest.approx(1 / 25) and max(shares) == pytest.approx(shares[10]) == pytest.approx(1)
    assert np.all(np.diff(shares[:11]) > 0) and np.all(np.diff(shares[10:]) < 0) and shares[-1] < 1e-4


def test_training_lowers_the_loss(tmp_path):
    net = trained(tmp_path, replace(RECIPE, steps=200))
    batch = batches(999)
    assert RelativeError().loss(net, batch) < 0.3 * RelativeError().loss(new_net(), batch)
    assert not net.training


@pytest.mark.parametrize("killed_at", [1, 7, 11])
def test_a_run_that_was_killed_goes_on_as_if_it_were_not(tmp_path, killed_at):
    whole, seen = trained(tmp_path), []

    def until_killed(number):
        if number == killed_at:
            raise InterruptedError
        return batches(number)

    def recorded(number):
        seen.append(number)
        return batches(number)

    with pytest.raises(InterruptedError):
        train(new_net(), RelativeError(), until_killed, RECIPE, tmp_path / "net.resume", keep_every_s=-1.0)
    torch.manual_seed(99)
    resumed = Map()
    train(resumed, RelativeError(), recorded, RECIPE, tmp_path / "net.resume")
    assert seen == list(range(killed_at, 12))
    assert torch.equal(weights(whole), weights(resumed))


@pytest.mark.parametrize(("steps", "identity"), [(13, "these data"), (12, "others")])
def test_a_run_of_another_recipe_is_not_continued(tmp_path, steps, identity):
    trained(tmp_path, identity="these data", keep_every_s=-1.0)
    with pytest.raises(CheckpointError, match="delete it"):
        trained(tmp_path, replace(RECIPE, steps=steps), identity=identity)


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"batch": 0}, {"learning_rate": -1.0}])
def test_recipes_that_cannot_be_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} is .*, expected more than 0"):
        replace(RECIPE, **wrong)


def test_a_loss_that_is_no_number_ends_the_run_before_its_step(tmp_path):
    net = new_net()
    before = weights(net)

    def poisoned(number):
        batch = batches(number)
        return replace(batch, window=batch.window * torch.nan)

    with pytest.raises(DivergedError, match="step 0: lower the learning rate"):
        train(net, RelativeError(), poisoned, RECIPE, tmp_path / "net.resume")
    assert torch.equal(before, weights(net))


def test_figures_go_to_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    trained(tmp_path, replace(RECIPE, steps=100), log_folder=tmp_path / "logs")
    events = accumulator.EventAccumulator(str(tmp_path / "logs")).Reload()
    assert [event.step for event in events.Scalars("loss")] == [50, 100]


WORKER = """
import os, sys, json, torch
from dataclasses import replace
sys.path[:0] = ["tests/training", "tests/support"]
from pathlib import Path
from test_loop import batches, new_net, weights, RECIPE
from train.learning.training_loop import leave_group, rank_and_world, train
from train.networks.blocks import RelativeError
net, used = new_net(), []
def recorded(number):
    used.append(number)
    return batches(number)
train(net, RelativeError(), recorded, RECIPE, Path(sys.argv[1]) / "net.resume")
try:
    train(new_net(), RelativeError(), batches, replace(RECIPE, batch=5), Path(sys.argv[1]) / "odd.resume")
except ValueError as error:
    refused = str(error)
rank, world = rank_and_world()
cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
told = json.dumps([rank, world, used, weights(net).tolist(), cores, refused])
Path(f"{sys.argv[1]}/rank{rank}.json").write_text(told)
leave_group()
"""


@pytest.mark.night
def test_two_processes_share_every_batch_and_end_where_one_does(tmp_path):
    (tmp_path / "worker.py").write_text(WORKER)
    command = ["torch.distributed.run", "--nproc-per-node", "2", "--master-port", "0", "--rdzv-backend", "c10d"]
    command += ["--rdzv-endpoint", "localhost:0", str(tmp_path / "worker.py"), str(tmp_path)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    first, second = (json.loads((tmp_path / f"rank{rank}.json").read_text()) for rank in range(2))
    assert (first[0], second[0], first[1]) == (0, 1, 2)
    assert first[2] == second[2] == list(range(12))
    assert first[3] == second[3] and "5 windows is shared by 2 processes" in first[5]
    assert first[3] == pytest.approx(weights(trained(tmp_path)).tolist(), abs=1e-5)
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1 and not torch.cuda.is_available():
        assert first[4] and second[4] and not set(first[4]) & set(second[4]), "two processes on one core wait for it"


def test_the_next_is_drawn_while_one_is_used():
    drawn = [threading.Event() for _ in range(3)]

    def batch(number):
        drawn[number].set()
        return number

    batches = drawn_ahead(batch, 0, 3)
    assert next(batches) == 0
    assert drawn[1].wait(20) and not drawn[2].is_set()
    batches.close()
    assert not drawn[2].is_set()
