"""Surfaces by name, their depth under the pad, and taps on them, which see a shape from their poses."""

import numpy as np
import pytest
import trimesh

from train.errors import SurfaceError
from train.families.catalogue import draw_shape
from train.families.shapes import NOWHERE_MM
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import NOMINAL
from train.surfaces import named_surfaces
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, PLATE_MM, SURFACES, figure, relief, surface_mesh
from train.surfaces.poses import (
    HELD_OUT_RADIUS_MM,
    MAX_TAPS,
    PLACES_MM,
    REACH_MM,
    SCHEDULES,
    SURFACE_REACH_MM,
    random_poses,
)

SIZE, CELL_MM = 42, 0.47
WITH_A_HOLE = {"O", "P", "hollow circle", "hollow square", "hollow triangle"}


@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_is_closed_and_shown_with_its_area(name):
    mesh = surface_mesh(name)
    top_mm2 = mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()
    assert mesh.is_watertight and mesh.bounds.ravel() == pytest.approx([-10, -10, -3, 10, 10, 0])
    assert mesh.volume == pytest.approx(PLATE_MM**2 + FIGURE_HEIGHT_MM * top_mm2)
    assert mesh.euler_number == (2 if name in WITH_A_HOLE else 4)  # plate and figure, less two for the hole
    seen = depth_image(Relief(name, mesh), Pose(0.03, 0.02, 20), 200, 0.1)
    assert (seen < FIGURE_HEIGHT_MM / 2).sum() * 0.1**2 == pytest.approx(top_mm2, rel=0.01)
    assert set(np.unique(seen.round(5))) <= {0.0, FIGURE_HEIGHT_MM, NOTHING_MM}


def test_an_unknown_name_lists_the_kinds():
    for name in ("Q", "", "s", "glyph", "glyph:-1", "glyph:1.5", "polygon:²", "mesh:", "cone:3"):
        with pytest.raises(SurfaceError, match=r"small triangle.*glyph:SEED.*mesh:PATH"):
            surface_mesh(name)


@pytest.mark.parametrize("kind", ["glyph", "polygon"])
def test_random_figures_are_valid_and_coarse_enough_to_feel(kind):
    least_mm2, most_mm2 = named_surfaces.AREA_MM2
    reach_mm = named_surfaces.GLYPH_REACH_MM if kind == "glyph" else named_surfaces.POLYGON_REACH_MM
    drawn = [figure(f"{kind}:{seed}") for seed in range(100)]
    for seed, outline in enumerate(drawn):
        assert outline.is_valid and least_mm2 - 0.1 < outline.area < most_mm2 + 0.1, seed
        assert np.abs(outline.bounds).max() <= reach_mm + 1e-9, seed
        eroded = outline.buffer(-0.2, join_style="mitre").buffer(0.2, join_style="mitre")
        filled = outline.buffer(0.2, join_style="mitre").buffer(-0.2, join_style="mitre")
        assert max(outline.difference(eroded).area, filled.difference(outline).area) < 0.03 * outline.area, seed
    assert len({outline.wkb for outline in drawn}) == len(drawn)


@pytest.mark.parametrize("angle_deg", [0, 37, 90])
def test_a_slope_is_exact_at_every_pixel(angle_deg):
    corners = np.array([[-20, -20], [20, -20], [20, 20], [-20, 20]])
    points = np.column_stack([corners, corners @ (0.1, -0.03)])
    surface = Relief("slope", trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], process=False))
    depth = depth_image(surface, Pose(1.3, -2.1, angle_deg), SIZE, CELL_MM)
    along_mm = (np.arange(SIZE) - (SIZE - 1) / 2) * CELL_MM
    right, down = along_mm[None, :], along_mm[:, None]
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    height = 0.1 * (cosine * right + sine * down) - 0.03 * (sine * right - cosine * down)
    assert np.allclose(depth - depth.min(), height.max() - height, atol=1e-5)
    # First contact is at the footprint's corner, half a cell beyond the highest pixel.
    assert 0 <= depth.min() <= 0.13 * np.sqrt(2) * CELL_MM / 2


def test_a_letter_stands_upright_and_finer_things_are_not_felt():
    letter = depth_image(relief("F"), Pose(0, 0, 0), 41, 0.5) < FIGURE_HEIGHT_MM / 2
    assert letter[:20].sum() > letter[21:].sum() and letter[:, :20].sum() > letter[:, 21:].sum()
    slab, needle = trimesh.creation.box([20, 20, 1]), trimesh.creation.box([0.2, 0.2, 3])
    assert np.allclose(depth_image(Relief("needle", slab + needle), Pose(0, 0, 0), SIZE, CELL_MM), 0, atol=1e-6)


@pytest.fixture(scope="module")
def pad():
    return GrippedPad(NOMINAL)


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


def test_poses_stay_within_reach_and_away_from_held_out_places():
    for name, schedule in SCHEDULES.items():
        for seed in range(30):
            poses = schedule(np.random.default_rng(seed), MAX_TAPS)
            assert poses.shape == (MAX_TAPS, 3) and not poses[0].any(), name
            assert np.hypot(*poses[:, :2].T).max() <= REACH_MM + 1e-9, name
            assert schedule(np.random.default_rng(seed), 1).shape == (1, 3), name
    drawn = np.array(random_poses(np.random.default_rng(1), 3000))
    for place_mm in PLACES_MM.values():
        distance_mm = np.hypot(*(drawn[:, :2] - place_mm).T)
        assert HELD_OUT_RADIUS_MM < distance_mm.min() < HELD_OUT_RADIUS_MM + 0.1
    assert (np.abs(drawn[:, :2]).max(axis=0) > 0.97 * SURFACE_REACH_MM).all() and np.ptp(drawn[:, 2]) > 350
    assert np.abs(drawn[:, :2]).max() <= SURFACE_REACH_MM
