from math import pi, sin, sqrt

import numpy as np
import pytest
import shapely
import trimesh

from train.errors import SurfaceError
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, PLATE_MM, PLATES, REACH_MM, SURFACES, is_flat, surface_mesh
from train.surfaces.paper_figures import figure

WITH_A_HOLE = {"O", "P", "hollow circle", "hollow square", "hollow triangle"}
ROUND = [1.0, 1.5, 4.0, 10.0, 100.0, 1000.0]


def top_mm2(mesh):
    return mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()


def points_on_faces(mesh, reach_mm=REACH_MM):
    """Corners and inner points of all triangles that face up and lie within reach."""
    corners = mesh.triangles[(mesh.face_normals[:, 2] > 1e-3) & (mesh.triangles[:, :, 2].max(axis=1) > -reach_mm)]
    shares = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4
    points = np.einsum("sc,tcd->tsd", shares, corners).reshape(-1, 3)
    return points[points[:, 2] > -reach_mm]


def test_two_plates_hold_nine_letters_and_three_shapes_in_three_forms():
    assert [len(plate) for plate in PLATES] == [9, 9]
    assert len(set(SURFACES)) == 18
    assert PLATES[0] + PLATES[1] == SURFACES
    assert "".join(PLATES[0]) == "CFILOPSTU"
    assert PLATES[1][::3] == ("hollow circle", "hollow square", "hollow triangle")


@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_is_closed_and_fits_its_plate(name):
    mesh = surface_mesh(name)
    assert mesh.is_watertight
    assert mesh.bounds.ravel() == pytest.approx([-10, -10, -3, 10, 10, 0])
    assert mesh.volume == pytest.approx(PLATE_MM**2 + FIGURE_HEIGHT_MM * top_mm2(mesh))
    assert mesh.euler_number == (2 if name in WITH_A_HOLE else 4)  # plate and figure, less two for the hole
    assert is_flat(mesh)


def test_shapes_have_the_areas_of_their_circumscribed_circles():
    def regular(corners, radius_mm):
        return corners / 2 * radius_mm**2 * sin(2 * pi / corners)

    assert top_mm2(surface_mesh("large circle")) == pytest.approx(regular(96, 7))
    assert top_mm2(surface_mesh("small square")) == pytest.approx(2 * 3.5**2)
    assert top_mm2(surface_mesh("large triangle")) == pytest.approx(3 * sqrt(3) / 4 * 7**2)
    inner = ((3.5 - 2.5) / 3.5) ** 2  # the triangle's inscribed circle has half the radius, the wall leaves 1 mm of it
    assert top_mm2(surface_mesh("hollow triangle")) == pytest.approx(regular(3, 7) * (1 - inner))


def test_letters_are_strokes_of_three_millimetres():
    assert top_mm2(surface_mesh("T")) == pytest.approx(11 * 3 + 12 * 3)
    corner = (pi / 4 - 1) * 1.5**2  # round outside, overlapping inside
    assert top_mm2(surface_mesh("L")) == pytest.approx((12 + 8 + 2 * 1.5) * 3 + corner, rel=1e-3)


def test_letters_stand_upright():
    centre = shapely.centroid(figure("F"))
    assert centre.x < -0.5 and centre.y > 0.5
    centre = shapely.centroid(figure("L"))
    assert centre.x < -0.5 and centre.y < -0.5


@pytest.mark.parametrize(
    "name",
    ["Q", "", "s", "glyph", "glyph:", "glyph:-1", "glyph:1.5", "polygon:x", "polygon:²", "mesh", "mesh:", "cone:3"],
)
def test_an_unknown_name_lists_the_kinds(name):
    with pytest.raises(SurfaceError, match=r"small triangle.*glyph:SEED.*sphere:RADIUS_MM.*mesh:PATH"):
        surface_mesh(name)


@pytest.mark.parametrize("name", ["sphere:", "sphere:round", "sphere:nan", "sphere:0.9", "cylinder:-5", "cylinder:inf"])
def test_an_impossible_radius_names_the_possible(name):
    with pytest.raises(ValueError, match="a radius of 1 to 1000 mm"):
        surface_mesh(name)


@pytest.mark.parametrize("radius_mm", ROUND)
def test_a_dome_is_a_sphere_to_a_micrometre(radius_mm):
    mesh = surface_mesh(f"sphere:{radius_mm}")
    assert mesh.is_watertight and mesh.volume > 0 and not is_flat(mesh)
    x, y, z = points_on_faces(mesh).T
    error_mm = np.sqrt(radius_mm**2 - x**2 - y**2) - radius_mm - z
    assert z.max() == 0
    assert error_mm.min() > -1e-9 and error_mm.max() < 1e-3
    assert np.hypot(x, y).max() == pytest.approx(min(sqrt(2 * radius_mm * REACH_MM - REACH_MM**2), 20), rel=0.1)


@pytest.mark.parametrize("radius_mm", ROUND)
def test_a_lying_cylinder_is_one_to_a_micrometre_all_along_y(radius_mm):
    mesh = surface_mesh(f"cylinder:{radius_mm}")
    assert mesh.is_watertight and mesh.volume > 0 and not is_flat(mesh)
    x, y, z = points_on_faces(mesh).T
    error_mm = np.sqrt(radius_mm**2 - x**2) - radius_mm - z
    assert z.max() == 0
    assert error_mm.min() > -1e-9 and error_mm.max() < 1e-3
    assert [y.min(), y.max()] == [-20, 20]
    top = mesh.vertices[mesh.vertices[:, 2] == 0]
    assert top[:, 0] == pytest.approx([0, 0])


@pytest.mark.parametrize("name", ["sphere:1", "sphere:1.5", "sphere:60", "cylinder:1", "cylinder:60"])
def test_round_surfaces_lie_on_a_plate_that_holds_them(name):
    mesh = surface_mesh(name)
    body, plate = mesh.split()
    assert body.bounds[0, 2] == plate.bounds[1, 2] == -FIGURE_HEIGHT_MM
    assert (body.bounds[:, :2] >= plate.bounds[0, :2] - 1e-9).all()
    assert (body.bounds[:, :2] <= plate.bounds[1, :2] + 1e-9).all()


def block(*bodies):
    """Boxes (width, height, x of the middle, z of the top) side by side, 10 mm deep."""
    meshes = []
    for width, height, x, top in bodies:
        box = trimesh.creation.box([width, 10, height])
        meshes.append(box.apply_translation([x, 0, top - height / 2]))
    return trimesh.util.concatenate(meshes)


def frustum(slope_deep_mm, start_mm=0.0):
    """A truncated pyramid: walls upright down to `start_mm`, then 45 degrees for `slope_deep_mm`."""
    upper = trimesh.creation.box([10, 10, start_mm]).apply_translation([0, 0, -start_mm / 2]) if start_mm else None
    corners = [
        (x * s, y * s, z) for s, z in ((5, 0), (5 + slope_deep_mm, -slope_deep_mm)) for x in (-1, 1) for y in (-1, 1)
    ]
    lower = trimesh.convex.convex_hull(np.array(corners)).apply_translation([0, 0, -start_mm])
    return lower if upper is None else upper + lower


def test_flat_is_one_plane_within_reach():
    assert is_flat(block((10, 2, 0, 0)))
    assert is_flat(block((10, 2, 0, 0), (5, 2, 20, 0)))
    assert is_flat(block((10, 2, 0, 0), (5, 2, 20, -0.6)))
    assert not is_flat(block((10, 2, 0, 0), (5, 2, 20, -0.4)))
    assert not is_flat(frustum(2.0))
    assert is_flat(frustum(2.0, start_mm=0.6))
    assert not is_flat(frustum(2.0, start_mm=0.4))
    assert not is_flat(trimesh.creation.icosphere(radius=5))


def test_flat_is_relative_to_the_top_and_forgives_a_files_rounding():
    raised = block((10, 2, 0, 7.0), (5, 2, 20, 7.0 - 1e-5))
    assert is_flat(raised)
    assert not is_flat(frustum(2.0).apply_translation([0, 0, 7]))
    tilted = block((10, 2, 0, 0)).apply_transform(trimesh.transformations.rotation_matrix(1e-5, [1, 0, 0]))
    assert is_flat(tilted)
    tilted.apply_transform(trimesh.transformations.rotation_matrix(1e-2, [1, 0, 0]))
    assert not is_flat(tilted)


def test_a_users_file_is_a_surface_like_any_other(tmp_path):
    path = tmp_path / "a:part.stl"
    trimesh.creation.box([6, 4, 2]).export(path)
    mesh = surface_mesh(f"mesh:{path}")
    assert mesh.bounds.ravel() == pytest.approx([-3, -2, -2, 3, 2, 0])
    assert is_flat(mesh)
