"""Families of shapes: each gives heights wherever a pad looks, and turns, tilts and joins as a figure does."""

import numpy as np
import pytest
import trimesh

from train.errors import MeshError, SurfaceError
from train.families.family_shares import SHARES, draw_shape
from train.families.shapes import NOWHERE_MM
from train.physics.contact import BARE
from train.physics.gripped import SAMPLES, GrippedPad
from train.physics.pad_draws import NOMINAL
from train.surfaces.poses import turns


@pytest.fixture(scope="module")
def pad():
    return GrippedPad(NOMINAL)


def draw(pad, family, seed=0, taps=1):
    return draw_shape(np.random.default_rng(seed), family, pad, turns(np.random.default_rng(), taps))


def highest(pad, heights_mm):
    """Place of the highest part, x and y in [mm]."""
    row, col = np.unravel_index(heights_mm.argmax(), heights_mm.shape)
    return pad.places_mm[0][0, col], pad.places_mm[1][row, 0]


@pytest.mark.parametrize("family", SHARES)
def test_every_family_gives_finite_heights_that_reach_the_pad(pad, family):
    side = pad.size * SAMPLES
    for seed in range(6):
        tapped = draw(pad, family, seed, taps=2)
        assert tapped.heights_mm.shape == (2, side, side) and tapped.heights_mm.dtype == np.float32
        assert np.isfinite(tapped.heights_mm).all()
        assert (tapped.heights_mm.max(axis=(1, 2)) > -50).all(), "something lies under the pad"
        assert np.allclose(np.diff(tapped.angle_deg), -5)
        assert (tapped.cover == BARE) == (family not in ("soft", "glove"))
    again = draw(pad, family, 0, taps=2)
    assert np.array_equal(again.heights_mm, draw(pad, family, 0, taps=2).heights_mm)
    assert any(not np.array_equal(again.heights_mm, draw(pad, family, seed, taps=2).heights_mm) for seed in range(1, 9))


@pytest.mark.parametrize("family", ["glyph", "polygon", "relief", "block"])
def test_a_tap_sees_the_shape_from_its_pose(pad, family):
    """Heights from another pose are those of the newest tap at the places that the pose says."""
    poses = np.array([[0, 0, 0], [2.0, -1.0, 30.0], [-1.5, 2.5, -20.0]])
    tapped = draw_shape(np.random.default_rng(4), family, pad, poses)
    assert np.array_equal(tapped.poses, poses) and np.allclose(np.diff(tapped.angle_deg), np.diff(-poses[:, 2]))
    x_mm, y_mm = np.broadcast_arrays(*pad.places_mm)
    step_mm = x_mm[0, 1] - x_mm[0, 0]
    for (right, down, turn_deg), heights in zip(poses[1:], tapped.heights_mm[1:], strict=True):
        cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        col = np.rint((cosine * x_mm - sine * y_mm + right - x_mm[0, 0]) / step_mm).astype(int)
        row = np.rint((sine * x_mm + cosine * y_mm + down - y_mm[0, 0]) / step_mm).astype(int)
        inside = (np.minimum(row, col) >= 0) & (np.maximum(row, col) < len(heights))
        ours = tapped.heights_mm[0][row.clip(0, len(heights) - 1), col.clip(0, len(heights) - 1)]
        off = np.abs(np.maximum(ours, -3) - np.maximum(heights, -3))[inside]
        assert np.median(off) < 0.05 and (off < 0.3).mean() > 0.93


def test_a_tap_that_would_miss_the_shape_lands_nearer(pad):
    poses = np.array([[0, 0, 0], [100.0, 0, 10.0]])
    tapped = draw_shape(np.random.default_rng(1), "solid", pad, poses)
    assert 0 < tapped.poses[1, 0] < 100 and tapped.poses[1, 2] == 10
    assert tapped.heights_mm[1].max() > NOWHERE_MM / 2


def test_a_users_mesh_is_a_family(pad, tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=20.0).export(path)
    tapped = draw(pad, f"mesh:{path}", taps=2)
    assert tapped.cover == BARE and tapped.heights_mm.shape[0] == 2
    assert highest(pad, tapped.heights_mm[0]) != highest(pad, tapped.heights_mm[1])
    trimesh.creation.annulus(r_min=28.0, r_max=30.0, height=3.0).export(tmp_path / "ring.stl")
    with pytest.raises(SurfaceError, match=r"ring\.stl.* lies under the pad .*; tap a surface"):
        draw(pad, f"mesh:{tmp_path / 'ring.stl'}")
    with pytest.raises(MeshError, match="No such file"):
        draw(pad, f"mesh:{tmp_path / 'absent.stl'}")
