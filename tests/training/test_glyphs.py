import numpy as np
import pytest
import shapely

from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, PLATE_MM, surface_mesh
from train.surfaces.random_figures import AREA_MM2, GLYPH_REACH_MM, POLYGON_REACH_MM, glyph, polygon

SEEDS = range(250)
KINDS = {"glyph": (glyph, GLYPH_REACH_MM), "polygon": (polygon, POLYGON_REACH_MM)}

# Area, and centre x and y, of the first seeds.
GLYPHS_MM = [
    (74.12, -0.66, -0.59),
    (40.48, -1.81, -0.75),
    (123.62, 0.77, 0.35),
    (18.24, 1.78, 3.45),
    (54.26, 2.23, -0.18),
    (25.18, 3.05, -0.04),
    (83.39, 0.54, -0.76),
    (69.65, -0.20, -1.17),
]
POLYGONS_MM = [
    (37.08, -2.03, 1.72),
    (34.96, 2.28, -1.97),
    (19.06, 1.28, 2.38),
    (13.52, 0.81, -2.37),
    (106.77, 0.08, 1.14),
    (36.36, 2.04, -0.08),
    (76.46, 1.09, 2.05),
    (35.83, -0.71, -0.67),
]


@pytest.fixture(scope="module")
def drawn():
    return {kind: [draw(seed) for seed in SEEDS] for kind, (draw, _) in KINDS.items()}


def holes(outline):
    return sum(len(island.interiors) for island in shapely.get_parts(outline))


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_valid_and_within_bounds(drawn, kind):
    reach_mm = KINDS[kind][1]
    for seed, outline in zip(SEEDS, drawn[kind], strict=True):
        assert outline.is_valid, seed
        assert AREA_MM2[0] - 0.1 < outline.area < AREA_MM2[1] + 0.1, seed
        assert np.abs(outline.bounds).max() <= reach_mm + 1e-9, seed


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_raised_as_closed_bodies(drawn, kind):
    for seed in SEEDS[::4]:
        outline, mesh = drawn[kind][seed], surface_mesh(f"{kind}:{seed}")
        assert mesh.is_watertight, seed
        assert mesh.volume == pytest.approx(PLATE_MM**2 + FIGURE_HEIGHT_MM * outline.area), seed
        tops = mesh.triangles[(mesh.triangles[:, :, 2] == 0).all(axis=1)]
        assert shapely.contains_xy(outline, *tops.mean(axis=1)[:, :2].T).all(), seed
        assert [*tops.min(axis=(0, 1))[:2], *tops.max(axis=(0, 1))[:2]] == pytest.approx(outline.bounds), seed


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_gives_one_figure_in_whole_micrometres(drawn, kind):
    for seed in SEEDS[::25]:
        outline = KINDS[kind][0](seed)
        assert outline.equals_exact(drawn[kind][seed])
        corners_um = shapely.get_coordinates(outline) * 1000
        assert np.abs(corners_um - corners_um.round()).max() < 1e-6


def test_seeds_and_kinds_differ(drawn):
    outlines = [outline for kind in KINDS for outline in drawn[kind]]
    assert len({outline.wkb for outline in outlines}) == len(outlines)


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_mean_the_same_figures_as_when_models_were_trained(drawn, kind):
    # Other versions of the libraries may place a round corner's points elsewhere, but not change the figure.
    known = GLYPHS_MM if kind == "glyph" else POLYGONS_MM
    for seed, (area_mm2, x_mm, y_mm) in enumerate(known):
        centre = drawn[kind][seed].centroid
        assert [drawn[kind][seed].area, centre.x, centre.y] == pytest.approx([area_mm2, x_mm, y_mm], abs=0.05)


def test_glyphs_are_as_various_as_letters(drawn):
    glyphs = drawn["glyph"]
    assert 0.2 < np.mean([holes(outline) > 0 for outline in glyphs]) < 0.6
    assert 0.08 < np.mean([len(shapely.get_parts(outline)) > 1 for outline in glyphs]) < 0.4
    area_mm2 = np.array([outline.area for outline in glyphs])
    assert np.quantile(area_mm2, 0.1) < 35 and np.quantile(area_mm2, 0.9) > 90


def test_polygons_have_corners_from_three_up_holes_and_company(drawn):
    polygons = drawn["polygon"]
    lone = [outline for outline in polygons if len(shapely.get_parts(outline)) == 1 and not holes(outline)]
    corners = np.array([len(shapely.get_coordinates(outline)) - 1 for outline in lone])
    assert set(range(3, 9)) <= set(corners.tolist())
    assert (corners > 20).any()  # ellipses
    assert 0.1 < np.mean([holes(outline) > 0 for outline in polygons]) < 0.4
    assert 0.05 < np.mean([len(shapely.get_parts(outline)) > 1 for outline in polygons]) < 0.3
    area_mm2 = np.array([outline.area for outline in polygons])
    assert np.quantile(area_mm2, 0.1) < 20 and np.quantile(area_mm2, 0.9) > 80


@pytest.mark.parametrize("kind", KINDS)
def test_figures_lie_off_centre_on_every_side(drawn, kind):
    centres = np.array([(outline.centroid.x, outline.centroid.y) for outline in drawn[kind]])
    assert np.abs(centres.mean(axis=0)).max() < 0.6
    assert (centres.std(axis=0) > 1.2).all()


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_finer_than_a_tap_could_show(drawn, kind):
    for seed, outline in zip(SEEDS, drawn[kind], strict=True):
        eroded = outline.buffer(-0.2, join_style="mitre").buffer(0.2, join_style="mitre")
        grown = outline.buffer(0.2, join_style="mitre").buffer(-0.2, join_style="mitre")
        assert outline.difference(eroded).area < 0.03 * outline.area, seed
        assert grown.difference(outline).area < 0.03 * outline.area, seed


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_kept_apart_from_itself(drawn, kind):
    for seed, outline in zip(SEEDS, drawn[kind], strict=True):
        rings = shapely.get_rings(shapely.get_parts(outline))
        corners = np.concatenate([shapely.get_coordinates(ring)[1:] for ring in rings])
        assert len(np.unique(corners, axis=0)) == len(corners), seed


def test_an_outline_that_simplifying_makes_cross_itself_is_drawn_again():
    assert glyph(2_002_433).is_valid
