import json
import shutil
from dataclasses import replace

import pytest
import torch
from press_samples import make_press_set

from edge.evaluation.metrics import psnr_db
from train.data.frozen_presses import freeze_presses
from train.data.presses import SEED
from train.errors import CheckpointError, DatasetError
from train.fit import bundled, given_taps, main
from train.learning.checkpoint import Training, fit_network, infer, load_network
from train.learning.interval_fit import interval_coverage
from train.learning.training_loop import Recipe
from train.networks.named_networks import grown
from train.physics.pad_draws import KNOWN

SMALL = {"channels": 16, "blocks": 1, "known": KNOWN}
TRAINING = Training(
    "small", "compact-mtsr2", Recipe(steps=20, batch=16, learning_rate=5e-3, given=(0.5, 0.5)), options=SMALL
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
    assert kept["config"]["recipe"]["steps"] == 20
    assert kept["device"]
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


@pytest.mark.parametrize("damage", ["no weights", "no report", "other size", "hostile", "garbage"])
def test_what_is_no_checkpoint_is_refused_by_name(folder, tmp_path, damage, capsys):
    weights, report = torch.load(folder / "small.pt", weights_only=True), (folder / "small.json").read_text()
    path = tmp_path / "net.pt"
    if damage != "no report":
        path.with_suffix(".json").write_text(
            report.replace('"channels": 16', '"channels": 32') if damage == "other size" else report
        )
    if damage == "hostile":
        torch.save({"weight": Hostile()}, path)
    elif damage == "garbage":
        path.write_bytes(b"no weights at all")
    elif damage != "no weights":
        torch.save(weights, path)
    with pytest.raises(CheckpointError, match=r"net\.pt is no checkpoint of train\.fit with net\.json"):
        load_network(path)
    assert "it ran" not in capsys.readouterr().out


def test_a_share_of_the_weights_it_starts_from_is_kept(folder, data, validation, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    further = replace(TRAINING, name="further", start="small", recipe=replace(TRAINING.recipe, steps=5))
    plain = fit_network(further, data, validation, tmp_path)
    fully = torch.load(tmp_path / "further.pt", weights_only=True)
    report = fit_network(replace(further, keep=0.25), data, validation, tmp_path)
    first = grown(load_network(tmp_path / "small.pt")[0], further.network, 10, **SMALL).state_dict()
    mixed = torch.load(tmp_path / "further.pt", weights_only=True)
    for name, weight in mixed.items():
        if name != "deviation_scale":  # calibrated afterwards
            torch.testing.assert_close(weight, 0.25 * first[name] + 0.75 * fully[name])
    assert not torch.equal(mixed["leave.0.weight_free"], fully["leave.0.weight_free"])
    assert report["validation_psnr_db"] != plain["validation_psnr_db"]
    assert report["training_sha256"] != plain["training_sha256"] == replace(further, keep=0.0).sha256(data.sha256())


@pytest.mark.parametrize("taps", range(1, 8))
def test_windows_of_every_number_of_taps_are_drawn(taps):
    shares = given_taps(taps)
    assert len(shares) == taps and sum(shares) == pytest.approx(1) and min(shares) > 0


def test_the_bundled_networks_need_presses_of_seven_taps(data):
    assert [one.name for one in bundled(make_press_set(taps=7))] == ["stsr", "stsr-small", "mtsr"]
    with pytest.raises(DatasetError, match="at most 2 taps, the bundled networks take 7"):
        bundled(data)


def test_one_network_by_the_command(data, tmp_path, capsys):
    data.save(tmp_path / "data.npz")
    files = ["--data", str(tmp_path / "data.npz"), "--validation", str(tmp_path / "data.npz")]
    options = [*files, "--network", "compact-mtsr2", "--steps", "2"]
    main([str(tmp_path), *options, "--bf16"])
    assert capsys.readouterr().out.startswith("compact-mtsr2: validation ")
    assert load_network(tmp_path / "compact-mtsr2.pt")[1]["config"]["recipe"]["bf16"] is True


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--data", "absent.npz"], "no such file"),
        (["--network", "compact-mtsr4"], "no sequences of 4 taps"),
        (["--network", "fusion-mtsr4"], "no sequences of 3 taps"),
        (["--network", "compact-stsr", "--start-from", "absent"], "absent.pt"),
        (["--network", "compact-stsr", "--start-from", "absent", "--keep", "1"], "keep is 1"),
        (["--network", "compact-stsr", "--keep", "0.2"], "no weights to start from"),
    ],
)
def test_what_cannot_be_trained_is_said_in_one_line(data, tmp_path, options, told):
    data.save(tmp_path / "data.npz")
    given = [] if "--data" in options else ["--data", str(tmp_path / "data.npz")]
    given += ["--validation", str(tmp_path / "data.npz")]
    with pytest.raises(SystemExit, match=rf"^fit: .*{told}[^\n]*$"):
        main([str(tmp_path), *given, *options, "--steps", "1"])
