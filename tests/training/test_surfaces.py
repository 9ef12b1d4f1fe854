import numpy as np
import pytest
import shapely
import trimesh

from train.errors import SurfaceError
from train.surfaces.named_surfaces import (
    AREA_MM2,
    FIGURE_HEIGHT_MM,
    GLYPH_REACH_MM,
    LETTERS,
    PLATE_MM,
    POLYGON_REACH_MM,
    SURFACES,
    figure,
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
