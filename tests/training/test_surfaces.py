"""Surfaces by name, and their depth under the pad."""

import numpy as np
import pytest
import shapely
import trimesh
from scipy.spatial import Delaunay

from train.errors import SurfaceError
from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.named_surfaces import (
    AREA_MM2,
    FIGURE_HEIGHT_MM,
    GLYPH_REACH_MM,
    LETTERS,
    PLATE_MM,
    POLYGON_REACH_MM,
    SURFACES,
    figure,
    relief,
    surface_mesh,
)

WITH_A_HOLE = {"O", "P", "hollow circle", "hollow square", "hollow triangle"}


def top_mm2(mesh):
    return mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()


def test_there_are_nine_letters_and_three_shapes_in_three_forms():
    assert len(set(SURFACES)) == 18
    assert "".join(LETTERS) == "".join(SURFACES[:9]) == "CFILOPSTU"
    assert SURFACES[9::3] == ("hollow circle", "hollow square", "hollow triangle")


@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_is_closed_and_fits_its_plate(name):
    mesh = surface_mesh(name)
    assert mesh.is_watertight
    assert mesh.bounds.ravel() == pytest.approx([-10, -10, -3, 10, 10, 0])
    assert mesh.volume == pytest.approx(PLATE_MM**2 + FIGURE_HEIGHT_MM * top_mm2(mesh))
    assert mesh.euler_number == (2 if name in WITH_A_HOLE else 4)  # plate and figure, less two for the hole


@pytest.mark.parametrize(
    "name",
    ["Q", "", "s", "glyph", "glyph:", "glyph:-1", "glyph:1.5", "polygon:²", "mesh", "mesh:", "cone:3"],
)
def test_an_unknown_name_lists_the_kinds(name):
    with pytest.raises(SurfaceError, match=r"small triangle.*glyph:SEED.*mesh:PATH"):
        surface_mesh(name)


def test_a_users_file_is_a_surface_like_any_other(tmp_path):
    path = tmp_path / "a:part.stl"
    trimesh.creation.box([6, 4, 2]).export(path)
    mesh = surface_mesh(f"mesh:{path}")
    assert mesh.bounds.ravel() == pytest.approx([-3, -2, -2, 3, 2, 0])


SEEDS = range(100)
REACH_MM = {"glyph": GLYPH_REACH_MM, "polygon": POLYGON_REACH_MM}


@pytest.fixture(scope="module")
def drawn():
    return {kind: [figure(f"{kind}:{seed}") for seed in SEEDS] for kind in REACH_MM}


@pytest.mark.parametrize("kind", REACH_MM)
def test_every_random_figure_is_valid_within_bounds_and_coarse_enough_to_feel(drawn, kind):
    for seed, outline in zip(SEEDS, drawn[kind], strict=True):
        assert outline.is_valid, seed
        assert AREA_MM2[0] - 0.1 < outline.area < AREA_MM2[1] + 0.1, seed
        assert np.abs(outline.bounds).max() <= REACH_MM[kind] + 1e-9, seed
        eroded = outline.buffer(-0.2, join_style="mitre").buffer(0.2, join_style="mitre")
        grown = outline.buffer(0.2, join_style="mitre").buffer(-0.2, join_style="mitre")
        assert outline.difference(eroded).area < 0.03 * outline.area, seed
        assert grown.difference(outline).area < 0.03 * outline.area, seed


@pytest.mark.parametrize("kind", REACH_MM)
def test_a_figure_has_its_corners_on_whole_micrometres_and_each_seed_has_another(drawn, kind):
    corners_um = shapely.get_coordinates(drawn[kind]) * 1000
    assert np.abs(corners_um - corners_um.round()).max() < 1e-6
    assert len({outline.wkb for outline in drawn[kind]}) == len(SEEDS)


SIZE, CELL_MM = 42, 0.47
CENTRE = Pose(0, 0, 0)


def along_mm(size=SIZE, cell_mm=CELL_MM):
    return (np.arange(size) - (size - 1) / 2) * cell_mm


def ball(radius_mm):
    """A fine ball whose top is the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=radius_mm)
    return Relief("ball", mesh.apply_translation([0, 0, -radius_mm]))


def field(height, x_mm, y_mm):
    """A mesh of the function `height` over scattered points."""
    faces = Delaunay(np.stack([x_mm, y_mm], axis=1)).simplices
    return trimesh.Trimesh(np.stack([x_mm, y_mm, height(x_mm, y_mm)], axis=1), faces, process=False)


def scattered(half_mm, count, seed=0):
    rng = np.random.default_rng(seed)
    corners = half_mm * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    return np.concatenate([corners, rng.uniform(-half_mm, half_mm, (count, 2))]).T


def image(name, pose, size=41):
    return depth_image(relief(name), pose, size, 0.5) < FIGURE_HEIGHT_MM / 2


@pytest.mark.parametrize("angle_deg", [0, 37, 90])
def test_a_slope_is_exact_at_every_pixel(angle_deg):
    surface = Relief("slope", field(lambda x, y: 0.1 * x - 0.03 * y, *scattered(20, 500)))
    pose = Pose(1.3, -2.1, angle_deg)
    depth = depth_image(surface, pose, SIZE, CELL_MM)
    right, down = along_mm()[None, :], along_mm()[:, None]
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    height = 0.1 * (cosine * right + sine * down) - 0.03 * (sine * right - cosine * down)
    assert np.allclose(depth - depth.min(), height.max() - height, atol=1e-5)
    # First contact is at the footprint's corner, half a cell beyond the highest pixel.
    assert 0 <= depth.min() <= 0.13 * np.sqrt(2) * CELL_MM / 2


def test_a_dome_is_as_deep_as_a_sphere_wherever_it_stands():
    rng = np.random.default_rng(3)
    poses = [Pose(*rng.uniform(-1, 1, 2), rng.uniform(0, 360)) for _ in range(8)]
    dome = ball(8.0)
    for pose in poses:
        depth = depth_image(dome, pose, SIZE, CELL_MM)
        cosine, sine = np.cos(np.radians(pose.angle_deg)), np.sin(np.radians(pose.angle_deg))
        x_mm = pose.x_mm + cosine * along_mm()[None, :] + sine * along_mm()[:, None]
        y_mm = pose.y_mm + sine * along_mm()[None, :] - cosine * along_mm()[:, None]
        expected = 8 - np.sqrt(np.maximum(64 - x_mm**2 - y_mm**2, 0))
        cap = expected < 1
        assert np.abs(depth - expected)[cap].max() < 2e-3  # facets


def test_what_is_finer_than_a_cell_is_not_felt():
    slab = trimesh.creation.box([20, 20, 1])
    needle = trimesh.creation.box([0.2, 0.2, 3])
    seen = depth_image(Relief("needle", slab + needle), CENTRE, SIZE, CELL_MM)
    assert np.allclose(seen, 0, atol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
def test_the_image_shows_the_figures_area(name):
    mesh = surface_mesh(name)
    top = mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()
    seen = depth_image(Relief(name, mesh), Pose(0.03, 0.02, 20), 200, 0.1)
    assert (seen < FIGURE_HEIGHT_MM / 2).sum() * 0.1**2 == pytest.approx(top, rel=0.01)
    assert set(np.unique(seen.round(5))) <= {0.0, FIGURE_HEIGHT_MM, NOTHING_MM}


def test_a_pose_beside_the_surface_is_refused_by_name():
    with pytest.raises(ValueError, match=r"surface 'I' lies under the pad at Pose\(x_mm=50"):
        depth_image(relief("I"), Pose(50, 0, 0), SIZE, CELL_MM)


def test_a_letter_stands_upright_as_seen_through_the_pad():
    letter = image("F", CENTRE)
    assert letter[:20].sum() > letter[21:].sum()
    assert letter[:, :20].sum() > letter[:, 21:].sum()
