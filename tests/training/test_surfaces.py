"""Surfaces by name, and their depth under the pad."""

import numpy as np
import pytest
import trimesh

from train.errors import SurfaceError
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.named_surfaces import (
    AREA_MM2,
    FIGURE_HEIGHT_MM,
    GLYPH_REACH_MM,
    PLATE_MM,
    POLYGON_REACH_MM,
    SURFACES,
    figure,
    relief,
    surface_mesh,
)

SIZE, CELL_MM = 42, 0.47
CENTRE = Pose(0, 0, 0)
ALONG_MM = (np.arange(SIZE) - (SIZE - 1) / 2) * CELL_MM
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


@pytest.mark.parametrize("name", ["Q", "", "s", "glyph", "glyph:-1", "glyph:1.5", "polygon:²", "mesh:", "cone:3"])
def test_an_unknown_name_lists_the_kinds(name):
    with pytest.raises(SurfaceError, match=r"small triangle.*glyph:SEED.*mesh:PATH"):
        surface_mesh(name)


@pytest.mark.parametrize(("kind", "reach_mm"), [("glyph", GLYPH_REACH_MM), ("polygon", POLYGON_REACH_MM)])
def test_random_figures_are_valid_and_coarse_enough_to_feel(kind, reach_mm):
    drawn = [figure(f"{kind}:{seed}") for seed in range(100)]
    for seed, outline in enumerate(drawn):
        assert outline.is_valid and AREA_MM2[0] - 0.1 < outline.area < AREA_MM2[1] + 0.1, seed
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
    right, down = ALONG_MM[None, :], ALONG_MM[:, None]
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    height = 0.1 * (cosine * right + sine * down) - 0.03 * (sine * right - cosine * down)
    assert np.allclose(depth - depth.min(), height.max() - height, atol=1e-5)
    # First contact is at the footprint's corner, half a cell beyond the highest pixel.
    assert 0 <= depth.min() <= 0.13 * np.sqrt(2) * CELL_MM / 2


def test_a_dome_is_as_deep_as_a_sphere_wherever_it_stands():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=8.0).apply_translation([0, 0, -8.0])
    for x_mm, y_mm in np.random.default_rng(3).uniform(-1, 1, (4, 2)):
        depth = depth_image(Relief("ball", ball), Pose(x_mm, y_mm, 0.0), SIZE, CELL_MM)
        square = (x_mm + ALONG_MM) ** 2 + (y_mm - ALONG_MM[:, None]) ** 2
        expected = 8 - np.sqrt(np.maximum(64 - square, 0))
        assert np.abs(depth - expected)[expected < 1].max() < 2e-3  # facets


def test_what_is_finer_than_a_cell_is_not_felt():
    slab, needle = trimesh.creation.box([20, 20, 1]), trimesh.creation.box([0.2, 0.2, 3])
    assert np.allclose(depth_image(Relief("needle", slab + needle), CENTRE, SIZE, CELL_MM), 0, atol=1e-6)


def test_a_pose_beside_the_surface_is_refused_by_name():
    with pytest.raises(ValueError, match=r"surface 'I' lies under the pad at Pose\(x_mm=50"):
        depth_image(relief("I"), Pose(50, 0, 0), SIZE, CELL_MM)


def test_a_letter_stands_upright_as_seen_through_the_pad():
    letter = depth_image(relief("F"), CENTRE, 41, 0.5) < FIGURE_HEIGHT_MM / 2
    assert letter[:20].sum() > letter[21:].sum() and letter[:, :20].sum() > letter[:, 21:].sum()
