import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from press_samples import make_press_set

from edge.evaluation.metrics import psnr_db
from train.data.frozen_presses import freeze_presses
from train.data.press_batches import Batch
from train.data.presses import SEED
from train.errors import CheckpointError
from train.fit import main
from train.learning.checkpoint import Training, fit_network, infer, load_network
from train.learning.interval_fit import interval_coverage
from train.learning.training_loop import DivergedError, Recipe, learning_rate_share, train
from train.networks.blocks import PatternNet, RelativeError
from train.networks.published import SrganObjective
from train.physics.pad_draws import KNOWN

SMALL = {"channels": 16, "blocks": 1, "known": KNOWN}
TRAINING = Training(
    "small", "fusion-mtsr2", Recipe(steps=20, batch=16, learning_rate=5e-3, given=(0.5, 0.5)), options=SMALL
)


@pytest.fixture(scope="module")
def data():
    return make_press_set(48, taps=2, seed=5)


@pytest.fixture(scope="module")
def validation():
    return freeze_presses(make_press_set(24, taps=2, seed=6), SEED).as_frozen_set()


@pytest.fixture(scope="module")
def folder(data, validation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    fit_network(TRAINING, data, validation, folder)
    return folder


def test_a_run_is_repeatable_and_leaves_its_configuration(folder, data, validation, tmp_path):
    report = fit_network(TRAINING, data, validation, tmp_path)
    first, second = (torch.load(path / "small.pt", weights_only=True) for path in (folder, tmp_path))
    assert all(torch.equal(first[key], second[key]) for key in first)
    kept = json.loads((folder / "small.json").read_text())
    assert kept["training_sha256"] == report["training_sha256"] == TRAINING.sha256(data.sha256())
    assert kept["config"]["recipe"]["steps"] == 20 and [*kept["course"]] == [str(step) for step in range(1, 21)]
    assert not (folder / "small.resume").exists()


def test_a_checkpoint_states_its_validation_figures(folder, validation):
    net, report = load_network(folder / "small.pt")
    patterns, deviations = infer(net, validation.windows(2))
    truth = validation.patterns()
    assert psnr_db(patterns, truth, validation.full_scale_mm).mean() == pytest.approx(report["validation_psnr_db"])
    covered = [interval_coverage(truth, patterns, deviations), report["validation_coverage"]]
    assert covered == pytest.approx([0.9, 0.9], abs=1e-3)


def test_a_network_trained_alike_is_not_trained_again(folder, data, validation, tmp_path):
    for suffix in (".pt", ".json"):
        (tmp_path / f"small{suffix}").write_bytes((folder / f"small{suffix}").read_bytes())
    first = (tmp_path / "small.pt").stat().st_mtime_ns
    fit_network(TRAINING, data, validation, tmp_path)
    assert (tmp_path / "small.pt").stat().st_mtime_ns == first
    fit_network(TRAINING, data, replace(validation, full_scale_mm=1.0), tmp_path)  # its deviations are set on that
    assert (tmp_path / "small.pt").stat().st_mtime_ns > first
    assert (tmp_path / "small.pt.bak").read_bytes() == (folder / "small.pt").read_bytes()
    assert (tmp_path / "small.json.bak").read_bytes() == (folder / "small.json").read_bytes()
    (tmp_path / "small.json").unlink()
    fit_network(TRAINING, data, validation, tmp_path)
    names = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert names == {"small.pt", "small.json", "small.pt.bak", "small.json.bak"}


class Hostile:
    def __reduce__(self):
        return (print, ("it ran",))


@pytest.mark.parametrize("damage", ["no report", "other size", "hostile", "garbage"])
def test_what_is_no_checkpoint_is_refused_by_name(folder, tmp_path, damage, capsys):
    path, report = tmp_path / "net.pt", (folder / "small.json").read_text()
    path.write_bytes(b"no weights at all" if damage == "garbage" else (folder / "small.pt").read_bytes())
    if damage == "hostile":
        torch.save({"weight": Hostile()}, path)
    if damage != "no report":
        report = report.replace('"channels": 16', '"channels": 32') if damage == "other size" else report
        path.with_suffix(".json").write_text(report)
    with pytest.raises(CheckpointError, match=r"net\.pt is no checkpoint of train\.fit with net\.json"):
        load_network(path)
    graph = tmp_path / "net.onnx"
    graph.write_bytes(b"\xff\xff\xff")
    with pytest.raises(CheckpointError, match=r"net\.onnx is no model to start from"):
        load_network(graph)
    assert "it ran" not in capsys.readouterr().out


def test_a_training_begins_with_the_weights_of_another(folder, data, validation, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    recipe = replace(TRAINING.recipe, steps=1, learning_rate=1e-9)
    fit_network(replace(TRAINING, name="further", start="small", recipe=recipe), data, validation, tmp_path)
    first, further = (torch.load(tmp_path / f"{name}.pt", weights_only=True) for name in ("small", "further"))
    assert all(torch.allclose(first[name], further[name]) for name in first if name != "deviation_scale")


def test_one_network_by_the_command(data, tmp_path, capsys):
    data.save(tmp_path / "data.npz")
    files = ["--data", str(tmp_path / "data.npz"), "--validation", str(tmp_path / "data.npz")]
    options = [*files, "--network", "fusion-mtsr2", "--steps", "2"]
    main([str(tmp_path), *options])
    assert capsys.readouterr().out.startswith("fusion-mtsr2: validation ")
    assert load_network(tmp_path / "fusion-mtsr2.pt")[1]["config"]["recipe"]["bf16"] is True


FUSION = ["--network", "fusion-mtsr2"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--data", "absent.npz"], "no such file"),
        ([], "at most 2 taps, the bundled networks take 7"),
        (["--network", "mtsr4"], "no sequences of 4 taps"),
        (["--network", "fusion-mtsr4"], "no sequences of 3 taps"),
        (["--network", "compact-stsr", "--start-from", "absent"], "absent.pt"),
        (
            [*FUSION, "--validation", "single.npz"],
            "the validation set .*has 48 sequences of 1 taps that are only turned, .*; expected some of 2 taps, at x10",
        ),
        ([*FUSION, "--validation", "moved.npz"], "the validation set .*has 0 sequences of 2 taps that are only turned"),
        (
            [*FUSION, "--validation", "coarse.npz"],
            "the validation set .*at x2 of 4 x 4 taxels; expected some of 2 taps, at x10 of 4 x 4",
        ),
        ([*FUSION, "--data", "data.npz", "coarse.npz"], "the presses are at x10 of 4 x 4 taxels and x2 of 4 x 4"),
    ],
)
def test_what_cannot_be_trained_is_said_in_one_line(data, tmp_path, monkeypatch, options, told):
    monkeypatch.chdir(tmp_path)
    data.save(tmp_path / "data.npz")
    coarse = {name: getattr(data, name)[:, ::5, ::5] for name in ("patterns", "touching")}
    replace(data, **coarse).save(tmp_path / "coarse.npz")
    data.with_taps(1).save(tmp_path / "single.npz")
    replace(data, poses=data.poses + 1).save(tmp_path / "moved.npz")
    with pytest.raises(SystemExit, match=rf"^fit: [^\n]*{told}[^\n]*$"):
        main([".", "--data", "data.npz", "--validation", "data.npz", "--steps", "1", *options])


def test_a_full_disk_is_one_line(data, tmp_path):
    """A file can be 64 kB long at most, as where the disk is full: torch itself would end with a traceback."""
    data.save(tmp_path / "data.npz")
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536))"
    words = ["--data", "data.npz", "--validation", "data.npz", "--network", "small-stsr", "--steps", "1"]
    command = [sys.executable, "-B", "-c", f"{full}; from train.fit import main; main()", "mine", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    told = "fit: mine/small-stsr.pt cannot be written: File too large; make room, and the same command continues\n"
    assert (done.returncode, done.stderr) == (1, told)


RECIPE = Recipe(steps=12, batch=4, learning_rate=1e-2)


class Map(PatternNet):
    """The least network: a linear map."""

    def __init__(self):
        super().__init__()
        self.taps, self.scale = 1, 1
        self.matrix = torch.nn.Linear(48, 16)

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


def test_the_rate_rises_for_a_tenth_and_falls_to_nothing():
    for wrong in ({"steps": 0}, {"batch": 0}, {"learning_rate": -1.0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} is .*, expected more than 0"):
            replace(RECIPE, **wrong)
    shares = [learning_rate_share(progress) for progress in np.linspace(0, 1, 101)]
    assert shares[0] == pytest.approx(1 / 25) and max(shares) == pytest.approx(shares[10]) == pytest.approx(1)
    assert np.all(np.diff(shares[:11]) > 0) and np.all(np.diff(shares[10:]) < 0) and shares[-1] < 1e-4


@pytest.mark.parametrize("killed_at", [1, 7, 11])
def test_a_run_that_was_killed_goes_on_as_if_it_were_not(tmp_path, killed_at):
    """With the objective that has weights and draws of its own."""
    seen = []

    def until_killed(number):
        if number == killed_at:
            raise InterruptedError
        return batches(number)

    def recorded(number):
        seen.append(number)
        return batches(number)

    whole = new_net()
    train(whole, SrganObjective(seed=3), batches, RECIPE, tmp_path / "whole.resume")
    with pytest.raises(InterruptedError):
        train(new_net(), SrganObjective(seed=3), until_killed, RECIPE, tmp_path / "net.resume", keep_every_s=-1.0)
    torch.manual_seed(99)
    resumed = Map()
    _, course = train(resumed, SrganObjective(seed=8), recorded, RECIPE, tmp_path / "net.resume")
    assert seen == list(range(killed_at, 12)) and [*course] == list(range(1, 13))
    assert torch.equal(weights(whole), weights(resumed))


@pytest.mark.parametrize(("steps", "identity"), [(13, "these data"), (12, "others")])
def test_a_run_of_another_recipe_is_not_continued(tmp_path, steps, identity):
    net, objective, path = new_net(), RelativeError(), tmp_path / "net.resume"
    train(net, objective, batches, RECIPE, path, identity="these data", keep_every_s=-1.0)
    with pytest.raises(CheckpointError, match="delete it"):
        train(net, objective, batches, replace(RECIPE, steps=steps), path, identity=identity)


def test_a_loss_that_is_no_number_ends_the_run_before_its_step(tmp_path):
    net = new_net()
    before = weights(net)

    def poisoned(number):
        batch = batches(number)
        return replace(batch, window=batch.window * torch.nan)

    with pytest.raises(DivergedError, match="step 0: lower the learning rate"):
        train(net, RelativeError(), poisoned, RECIPE, tmp_path / "net.resume")
    assert torch.equal(before, weights(net))
