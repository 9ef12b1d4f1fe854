import json
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from dataset_samples import make_sequences

from train.data import dataset
from train.data.dataset import Sequences, join, load_sequences, quarter_turns, windows
from train.errors import DatasetError, TrainError
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import FRAMES

QUIET = Nuisances.none()
EVERY = np.arange(6)


def test_a_press_reaches_its_force_or_ends_before():
    made = make_sequences()
    force_n = made.force_n[..., -1] * np.linspace(0.02, 1.1, 24).reshape(6, 4)
    share = made.share_at_force(EVERY, force_n)
    for sequence, tap in np.ndindex(6, 4):
        curve = np.concatenate([[0], made.force_n[sequence, tap]])
        if force_n[sequence, tap] < curve[-1]:
            assert np.interp(share[sequence, tap] * FRAMES, np.arange(17), curve) == pytest.approx(
                force_n[sequence, tap]
            )
        else:
            assert share[sequence, tap] == 1
    assert (made.share_at_force(EVERY, 1e6) == 1).all()
    assert np.allclose(made.force_at(EVERY, share[:, :1])[:, 0], np.minimum(force_n, made.force_n[:, :, -1])[:, 0])
    # A press along d^1.5: the share goes with F^(2/3), as fine as 16 straight lines have it.
    half = made.share_at_force(EVERY, made.force_n[..., -1] / 2)
    assert np.allclose(half, 0.5 ** (2 / 3), atol=2e-3)


def test_frames_stored_come_back_and_between_them_lines_are_straight():
    made = make_sequences(maps=FRAMES)
    assert np.allclose(made.presses(EVERY, np.ones((6, 4))), made.counts, rtol=1e-5, atol=1e-3)
    half = made.presses(EVERY, np.full((6, 4), 0.5))
    assert np.allclose(half[:, :, -1], made.counts[:, :, 7], rtol=1e-5, atol=1e-3)
    assert np.allclose(half[:, :, 0], made.counts[:, :, 0] / 2, rtol=1e-5, atol=1e-3)
    assert made.presses(EVERY, np.ones((6, 4)), frames=5).shape == (6, 4, 5, 3, 4, 4)
    share = np.array([[0.0, 1 / 32, 0.3, 1.0]]).repeat(6, 0)
    assert np.allclose(made.indentation_at(EVERY, share), share * made.indentation_mm[:, 0, -1:], rtol=1e-5)
    drawn = made.patterns_at(EVERY, np.full(6, 2.5 / FRAMES))
    second, third = (made.unit_patterns[:, i] * made.indentation_mm[:, 0, i, None, None] for i in (1, 2))
    assert np.allclose(drawn, (second + third) / 2, atol=1e-6)
    assert (made.patterns_at(EVERY, np.zeros(6)) == 0).all()
    assert (made.touching_at(EVERY, np.full(6, 2 / FRAMES)) == made.touching[:, 1]).all()
    assert (made.touching_at(EVERY, np.zeros(6)) == made.touching[:, 0]).all()


def test_a_flat_surfaces_one_map_stands_for_all_frames():
    flat, share = make_sequences(), np.linspace(0, 1, 6)
    drawn = flat.patterns_at(EVERY, share)
    repeated = join([flat, make_sequences(maps=FRAMES)])
    assert repeated.unit_patterns.shape == (12, FRAMES, 80, 80)
    assert np.allclose(repeated.patterns_at(EVERY, share), drawn, atol=1e-6)
    assert (repeated.touching_at(EVERY, share) == flat.touching_at(EVERY, share)).all()
    assert np.allclose(drawn, flat.unit_patterns[:, 0] * flat.indentation_at(EVERY, share[:, None])[..., None])


def test_windows_are_the_newest_tap_on_its_way_and_the_others_at_their_ends():
    made = make_sequences()
    depth = np.linspace(0.1, 1.0, 6)
    force_n = np.full((6, 4), 1.5)
    readings, patterns = windows(made, EVERY, depth, force_n, QUIET, 0)
    share = made.share_at_force(EVERY, force_n)
    slope = made.counts[:, :, -1]
    assert np.allclose(readings[:, 1:], slope[:, 1:] * share[:, 1:, None, None, None], atol=0.51)
    assert np.allclose(readings[:, 0], slope[:, 0] * (share[:, 0] * depth)[:, None, None, None], atol=0.51)
    end_mm = made.indentation_mm[:, 0, -1]
    assert np.allclose(patterns.max(axis=(1, 2)), share[:, 0] * depth * end_mm, rtol=5e-3)
    assert readings.dtype == patterns.dtype == np.float32
    assert (readings == np.rint(readings)).all()
    swapped, _ = windows(made, EVERY[::-1], depth[::-1], force_n, QUIET, 0)
    assert (swapped[::-1] == readings).all()


def test_windows_are_seeded_and_turn_the_earths_field_with_the_pad():
    made = make_sequences()
    first, _ = windows(made, EVERY, 0.7, 2.0, Nuisances(), [3, 1])
    assert (first == windows(made, EVERY, 0.7, 2.0, Nuisances(), [3, 1])[0]).all()
    assert (first != windows(made, EVERY, 0.7, 2.0, Nuisances(), [3, 2])[0]).any()
    earth = Nuisances.only("earth_field_counts")
    turned = replace(made, poses=np.add(made.poses, (0, 0, 90)))
    added = [
        windows(one, EVERY, 1.0, 2.0, earth, 5)[0] - windows(one, EVERY, 1.0, 2.0, QUIET, 5)[0]
        for one in (made, turned)
    ]
    assert np.abs(added[1] - added[0])[:, :, :2].max() > 5
    assert np.abs(added[1] - added[0])[:, :, 2].max() <= 1  # z stands along the axis of the turn


def test_truth_is_resampled_once_and_keeps_its_mean():
    made = make_sequences(maps=FRAMES)
    coarse = made.at_scale(10)
    assert coarse.unit_patterns.shape == coarse.touching.shape == (6, FRAMES, 40, 40)
    assert coarse.scale == 10
    assert coarse.unit_patterns.dtype == np.float16
    blocks = made.unit_patterns.astype(np.float64).reshape(6, FRAMES, 40, 2, 40, 2).mean(axis=(3, 5))
    assert np.allclose(coarse.unit_patterns, blocks, atol=1e-3)
    share_touched = made.touching.reshape(6, FRAMES, 40, 2, 40, 2).mean(axis=(3, 5))
    assert (coarse.touching == (share_touched >= 0.5)).all()
    assert coarse.at_scale(10) is coarse
    assert windows(coarse, EVERY, 1.0, 1.0, QUIET, 0)[1].shape == (6, 40, 40)


def test_resampling_in_parts_is_resampling_all(monkeypatch):
    made = make_sequences(count=7)
    monkeypatch.setattr(dataset, "_RESAMPLED_AT_ONCE", 3)
    parts = made.at_scale(8)
    monkeypatch.undo()
    assert parts.sha256() == made.at_scale(8).sha256()


@pytest.mark.parametrize("maps", [1, FRAMES])
def test_a_file_gives_back_all_that_was_saved(tmp_path, maps):
    made = make_sequences(maps=maps)
    made.save(tmp_path / "taps.npz")
    loaded = load_sequences(tmp_path / "taps.npz")
    assert loaded.sha256() == made.sha256()
    assert loaded.config == made.config
    assert loaded.surfaces.tolist() == made.surfaces.tolist()
    assert (loaded.touching == made.touching).all()
    assert [path.name for path in tmp_path.iterdir()] == ["taps.npz"]


def test_a_width_that_fills_no_whole_byte_comes_back(tmp_path):
    made = make_sequences().at_scale(5)
    odd = Sequences(
        **{name: getattr(made, name) for name in dataset._AXES}
        | {"touching": made.touching[..., :19], "unit_patterns": made.unit_patterns[..., :19]}
    )
    odd.save(tmp_path / "odd.npz")
    assert (load_sequences(tmp_path / "odd.npz").touching == odd.touching).all()


def test_the_hash_sees_every_array_and_fact():
    made = make_sequences()
    seen = {made.sha256()}
    for name in dataset._AXES:
        changed = getattr(made, name).copy()
        changed.flat[-1] = "D" if name == "surfaces" else not changed.flat[-1] if name == "touching" else 7
        seen.add(
            Sequences(
                **{n: getattr(made, n) for n in dataset._AXES} | {name: changed}, seed=made.seed, config=made.config
            ).sha256()
        )
    values = {name: getattr(made, name) for name in dataset._AXES}
    seen.add(Sequences(**values, seed=1, config=made.config).sha256())
    seen.add(Sequences(**values, seed=0, scale=10, config=made.config).sha256())
    seen.add(Sequences(**values, seed=0, config={}).sha256())
    assert len(seen) == 1 + len(dataset._AXES) + 3


def rewrite(path, **changes):
    """The file with members changed, or left out where None."""
    with np.load(path) as file:
        members = dict(file) | changes
    np.savez(path, **{name: value for name, value in members.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"schema": None}, "is not a file of sequences: make one"),
        ({"schema": "something else"}, "is not a file of sequences: make one"),
        ({"version": 2}, "version 2, newer than 1: update"),
        ({"version": "one"}, "damaged"),
        ({"counts": None}, "counts"),
        ({"facts": "{"}, "damaged"),
        ({"facts": json.dumps({})}, "damaged: its sha256"),
        (
            {"force_n": np.zeros((6, 4, 15), np.float32)},
            r"force_n is float32 \(6, 4, 15\), expected float32 \(6, 4, 16\)",
        ),
        ({"force_n": np.zeros((6, 4, 16))}, "force_n is float64"),
        ({"poses": np.zeros((5, 4, 3))}, "expected float64"),
        ({"force_n": np.ones((6, 4, 16), np.float32)}, "damaged: its sha256"),
        (
            {"unit_patterns": np.zeros((6, 3, 80, 80), np.float16), "touching": np.zeros((6, 3, 80, 10), np.uint8)},
            "3 maps",
        ),
        ({"unit_patterns": np.float16(3)}, "unit_patterns"),
        ({"touching": np.zeros((6, 1, 80, 9))}, "damaged"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_is_named(tmp_path, changes, complaint):
    path = tmp_path / "taps.npz"
    make_sequences().save(path)
    rewrite(path, **changes)
    with pytest.raises(DatasetError, match=complaint) as raised:
        load_sequences(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert isinstance(raised.value, TrainError)


def test_files_of_other_kinds_are_refused(tmp_path):
    path = tmp_path / "taps.npz"
    make_sequences().save(path)
    whole = path.read_bytes()
    with pytest.raises(DatasetError, match="no such file"):
        load_sequences(tmp_path / "absent.npz")
    with pytest.raises(DatasetError, match="cannot be written"):
        make_sequences().save(tmp_path / "no folder" / "taps.npz")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for wrong in (b"", b"garbage", whole[: len(whole) // 2], bytes(flipped), pickle.dumps([1])):
        path.write_bytes(wrong)
        with pytest.raises(DatasetError, match=r"damaged|not a file of sequences"):
            load_sequences(path)
    np.save(path.with_suffix(".npy"), np.zeros(3))
    with pytest.raises(DatasetError, match="not a file of sequences"):
        load_sequences(path.with_suffix(".npy"))


def test_nothing_in_a_file_is_unpickled(tmp_path):
    path = tmp_path / "taps.npz"
    make_sequences().save(path)
    with np.load(path) as file:
        members = dict(file)
    np.savez(path, **members | {"surfaces": np.array([{"an": "object"}], dtype=object)})
    assert "surfaces.npy" in zipfile.ZipFile(path).namelist()
    with pytest.raises(DatasetError, match=r"surfaces\.npy holds object, expected plain arrays"):
        load_sequences(path)


def test_quarter_turns_turn_maps_and_shear_alike():
    along = np.arange(4) - 1.5
    x, y = np.meshgrid(along, along)  # y down the rows
    away = np.stack([x, y, np.hypot(x, y)])[None].astype(np.float32)  # shear points away from the middle
    patterns = np.random.default_rng(0).random((1, 8, 8), dtype=np.float32)
    for quarters in range(4):
        turned, maps = quarter_turns(away, patterns, quarters)
        assert np.allclose(turned, away)  # a picture with that symmetry stays as it is
        assert (maps == np.rot90(patterns, quarters, axes=(1, 2))).all()
    pushed = np.zeros((1, 3, 4, 4), np.float32)
    pushed[0, 0, 0, 3] = 1.0  # the top right taxel pushed to the right
    turned, _ = quarter_turns(pushed, patterns, 1)
    assert turned[0, 1, 0, 0] == -1  # anticlockwise: now the top left one, pushed up
    assert np.abs(turned).sum() == 1
    many = np.random.default_rng(1).random((2, 3, 3, 4, 4), dtype=np.float32)
    assert (quarter_turns(many, patterns, 4)[0] == many).all()
    assert (quarter_turns(quarter_turns(many, patterns, 1)[0], patterns, 3)[0] == many).all()
