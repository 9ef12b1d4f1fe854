from math import pi, sin, sqrt

import pytest
import shapely
import trimesh

from train.errors import SurfaceError
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, PLATE_MM, PLATES, SURFACES, surface_mesh
from train.surfaces.random_figures import figure

WITH_A_HOLE = {"O", "P", "hollow circle", "hollow square", "hollow triangle"}


def top_mm2(mesh):
    return mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()


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
    with pytest.raises(SurfaceError, match=r"small triangle.*glyph:SEED.*mesh:PATH"):
        surface_mesh(name)


def test_a_users_file_is_a_surface_like_any_other(tmp_path):
    path = tmp_path / "a:part.stl"
    trimesh.creation.box([6, 4, 2]).export(path)
    mesh = surface_mesh(f"mesh:{path}")
    assert mesh.bounds.ravel() == pytest.approx([-3, -2, -2, 3, 2, 0])
