"""Worlds of pads and shapes: each pad by itself, the same bytes after a kill, and one line for what cannot be made."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from edge_samples import ROOT

from edge import api
from export.to_onnx import export
from firmware_bridge.pad_geometry import USPA44, USPA46
from train.data.frozen_presses import freeze_presses
from train.data.make_presses import main, make_presses
from train.data.presses import load_presses
from train.data.world import INDENTATION_MM, LEAST_FORCE_N, World, solve_pad
from train.errors import DatasetError, ended_by_errors
from train.families.catalogue import SHARES, tap
from train.learning.checkpoint import Training, fit_network
from train.learning.training_loop import Recipe
from train.physics.gripped import MOST_FORCE_N, GrippedPad
from train.physics.pad_draws import INPUTS, KNOWN, NOMINAL
from train.physics.taxel_response import on_pad
from train.surfaces.depth_image import Pose
from train.surfaces.poses import REACH_MM

SMALL = World(count=11, taps=2, per_pad=4, seed=5)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The small world made in one go on one core, and its file."""
    path = tmp_path_factory.mktemp("whole") / "small.npz"
    make_presses(SMALL, path)
    return path


def test_what_is_made_is_what_was_asked_for(small):
    made = load_presses(small)
    assert 0 < len(made) <= 11 and made.taps == 2
    assert len(set(made.pad.tolist())) == SMALL.chunks == 3 and set(made.family.tolist()) <= set(SHARES)
    assert made.config == SMALL.facts() and made.config["inputs"] == list(INPUTS)
    assert (made.force_n[:, 2] > LEAST_FORCE_N).all() and (made.force_n[:, 2] <= MOST_FORCE_N).all()
    assert (made.indentation_mm <= INDENTATION_MM[1]).all()
    assert made.touching.any(axis=(1, 2)).all() and np.isfinite(made.counts).all()
    assert np.allclose(made.angle_deg[:, 1] - made.angle_deg[:, 0], -made.poses[:, 1, 2], atol=1e-3)
    assert not made.poses[:, 0].any() and np.hypot(*made.poses[:, 1, :2].T).max() <= REACH_MM
    for pad in np.unique(made.pad):
        assert len(np.unique(made.constants[made.pad == pad], axis=0)) == 1
    assert len(np.unique(made.constants, axis=0)) == len(np.unique(made.pad))
    assert not small.with_name("small.npz.parts").exists()


def part_of(path, number, presses):
    """Write what a run leaves that was cut short."""
    replace(presses, config=SMALL.facts()).save(path.with_name(f"{path.name}.parts") / f"{number:06d}.npz")


def test_a_run_that_was_cut_short_goes_on_to_the_same_bytes(small, tmp_path):
    """Of which this process made a part."""
    part_of(tmp_path / "small.npz", 1, solve_pad(SMALL, 1))
    make_presses(SMALL, tmp_path / "small.npz")
    assert (tmp_path / "small.npz").read_bytes() == small.read_bytes()
    assert not (tmp_path / "small.npz.parts").exists()
    nothing = solve_pad(SMALL, 0).pick(np.zeros(0, dtype=int))
    for number in range(SMALL.chunks):
        part_of(tmp_path / "none.npz", number, nothing)
    with pytest.raises(DatasetError, match=r"came out lighter than 0\.1 N: ask for more"):
        make_presses(SMALL, tmp_path / "none.npz")


def test_what_was_made_otherwise_is_not_overwritten(small, tmp_path):
    before = small.read_bytes()
    with pytest.raises(DatasetError, match="made with other settings: delete it, or write to another file"):
        make_presses(replace(SMALL, seed=6), small)
    assert small.read_bytes() == before
    part_of(tmp_path / "other.npz", 0, load_presses(small))
    with pytest.raises(DatasetError, match=r"npz\.parts holds parts that were made with other settings: delete it"):
        make_presses(replace(SMALL, count=5, seed=6), tmp_path / "other.npz")
    assert len([*(tmp_path / "other.npz.parts").iterdir()]) == 1, "before the others are made"


def test_a_narrow_mesh_is_pressed_as_often_as_asked(tmp_path, capsys):
    """A finger as thin as a sheet whose top slopes: most places that are drawn touch it beside the pattern."""
    outline = shapely.Polygon(np.array([(0, 0), (44, 0), (44, 10), (0, 20)]) / 25.4)
    trimesh.creation.extrude_polygon(outline, 0.5 / 25.4).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    ).export(tmp_path / "finger.stl")
    options = ["--families", "none", "--mesh", str(tmp_path / "finger.stl"), "--unit-mm", "25.4", "--count", "12"]
    main([str(tmp_path / "finger.npz"), *options])
    size, made = capsys.readouterr().out.splitlines()
    assert size == "finger.stl: 44 x 0.5 x 20 mm, by --unit-mm 25.4"
    assert ": 12 sequences, " in made
    presses = load_presses(tmp_path / "finger.npz")
    assert len(presses) == 12 and set(presses.pad.tolist()) == {0}
    assert (presses.force_n[:, 2] > LEAST_FORCE_N).all() and presses.touching.any(axis=(1, 2)).all()


def test_the_command_says_what_it_made_and_what_is_left_out(tmp_path, capsys):
    path = tmp_path / "out" / "few.npz"
    main([str(path), "--families", "wire,soft", "--count", "30", "--spread", "0", "--seed", "4"])
    first, last = capsys.readouterr().out.splitlines()
    made = load_presses(path)
    assert set(made.family.tolist()) == {"wire", "soft"} and len(made) < 30
    assert re.fullmatch(rf"{path}: {len(made)} sequences, \d+ presses/s, sha256 {made.sha256()}", first)
    assert last == f"{30 - len(made)} of 30 presses left out: lighter than 0.1 N, or off the pattern"


def test_ctrl_c_within_a_write_is_no_error_of_the_file(capsys):
    with pytest.raises(SystemExit, match="130"), ended_by_errors("program"):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise ValueError("an archive that is cut off cannot be closed")  # noqa: B904, as zipfile does
    assert capsys.readouterr().err == "program: interrupted; the same command continues\n"


def test_ctrl_c_ends_in_one_line_that_says_how_to_go_on(tmp_path):
    path = tmp_path / "cut.npz"
    command = ["train.data.make_presses", str(path), "--families", "flat", "--count", "9000", "--per-pad", "1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    run = subprocess.Popen([sys.executable, "-m", *command], cwd=ROOT, start_new_session=True, **pipes)
    parts = path.with_name(path.name + ".parts")
    while len(list(parts.glob("*.npz"))) < 8:  # by then both workers have begun
        assert run.poll() is None, run.stderr.read().decode()
        time.sleep(0.01)
    os.killpg(run.pid, signal.SIGINT)  # a terminal sends it to the workers too
    out, complaint = run.communicate()
    assert complaint.decode() == "train.data.make_presses: interrupted; the same command continues\n"
    assert run.returncode == 130 and not out and any(parts.glob("*.npz"))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--count", "0"], "count is 0, expected 1 or more"),
        (["--taps", "8"], "taps is 8, expected 1 to 7"),
        (["--seed", "-1"], "seed is -1"),
        (["--spread", "nan"], "spread is nan"),
        (["--families", "dome,sphere"], "no family 'sphere': expected some of paper, "),
        (["--families", "none"], "no family named: expected some of"),
        (["--pad", "uSPa4"], "pad is 'uSPa4', expected one of uSPa44, uSPa46"),
        (["--schedule", "spiral"], "no schedule .spiral.: expected one of turns, half-pitch"),
        (["--mesh", "absent.stl"], "cannot be read: No such file"),
        (["--families", "none", "--mesh", "ring.stl"], r"ring\.stl' lies under the pad"),
    ],
)
def test_what_cannot_be_made_is_said_in_one_line(tmp_path, monkeypatch, options, told):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.annulus(r_min=28.0, r_max=30.0, height=3.0).export("ring.stl")
    with pytest.raises(SystemExit, match=rf"^train\.data\.make_presses: .*{told}[^\n]*$"):
        main(["out.npz", "--count", "2", *options])


SCALE, OPTIONS = 4, {"channels": 16, "blocks": 1, "group": "p2", "known": KNOWN}
TRAINING = Training("pad46", "compact-stsr", Recipe(steps=30, batch=12, learning_rate=8e-3), SCALE, options=OPTIONS)
PAD46 = World(count=24, per_pad=24, families={"large square": 1.0, "C": 1.0}, spread=0.0, scale=SCALE, pad="uSPa46")


def test_a_network_of_another_pad_learns_and_says_of_which(tmp_path):
    presses = solve_pad(PAD46, 0)
    seen = freeze_presses(presses, 1).as_frozen_set()
    begun = replace(TRAINING, name="begun", recipe=replace(TRAINING.recipe, steps=6))
    first, last = (fit_network(one, presses, seen, tmp_path)["validation_psnr_db"] for one in (begun, TRAINING))
    assert last > first + 1
    export(tmp_path / "pad46.pt", tmp_path, seen)
    contract = api.load_model(tmp_path / "pad46.onnx").contract
    assert (contract.sensor, contract.pattern_shape) == ("uSPa46", (16, 24))
    assert PAD46.facts()["pad"] == "uSPa46" and "pad" not in World(count=1).facts(), "the name of the default set stays"


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
