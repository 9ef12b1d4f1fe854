"""Map of a slide: the outline's error of maps whose error is known, and the report itself."""

import csv

import numpy as np
import pytest
import shapely
from experiment_samples import quick_bench
from map_samples import pixels_mm

from edge.mapping.object_map import ObjectMap
from train.experiments.sensor import object_map
from train.experiments.support.outline import naive_map, outline_error
from train.physics.slides import scaled, slide
from train.surfaces.paper_figures import figure

SQUARE = shapely.box(-15, -15, 15, 15)


def level_of(shape):
    x_mm, y_mm = pixels_mm(ObjectMap().grid)
    inside = shapely.contains_xy(shape, x_mm.ravel(), y_mm.ravel())
    distance = shapely.distance(shapely.points(x_mm.ravel(), y_mm.ravel()), shape.boundary)
    return (0.5 + np.where(inside, distance, -distance)).clip(0, 1).reshape(x_mm.shape)


def test_the_error_of_an_outline_is_its_distance_both_ways():
    assert outline_error(level_of(SQUARE), 4.0, SQUARE).rms_mm < 0.05
    wide = outline_error(level_of(SQUARE.buffer(0.7, join_style="mitre")), 4.0, SQUARE)
    assert wide.rms_mm == pytest.approx(0.7, abs=0.06) and wide.outside_mm == pytest.approx(0.7, abs=0.06)
    island = level_of(shapely.union(SQUARE, shapely.box(22, -1, 24, 1)))
    assert outline_error(island, 4.0, SQUARE).rms_mm > 1, "a false island counts by its distance"
    missing = level_of(SQUARE.difference(shapely.box(5, -16, 16, 16)))
    assert outline_error(missing, 4.0, SQUARE).rms_mm > 2, "so does a part that is missing"
    half = np.where(pixels_mm(ObjectMap().grid)[0] < 0, level_of(SQUARE), np.nan)
    covered = outline_error(half, 4.0, SQUARE)
    assert covered.rms_mm < 0.05 and 0.4 < covered.covered < 0.5
    assert outline_error(np.full((240, 240), np.nan), 4.0, SQUARE).rms_mm == float("inf")


def test_a_figure_is_scaled_and_thinned():
    for stroke_mm in (None, 4.0):
        left, low, right, high = scaled(figure("P"), stroke_mm).bounds
        assert max(right - left, high - low) == pytest.approx(50)
        assert (left + right, low + high) == pytest.approx((0, 0), abs=1e-6)
    bowl = scaled(figure("P"))
    assert bowl.contains(shapely.Point(-13, 20)) and not bowl.contains(shapely.Point(10, 20)), "y points down"


def test_a_slide_reads_the_figure_where_it_lies():
    made = slide(scaled(figure("I"), 4.0), 3, spread=0.0, lanes_mm=(0.0,))
    strength = made.counts[:, 2].sum(axis=(1, 2))
    touched = np.flatnonzero(strength > 3000)
    assert len(made.poses) == len(made.counts) == 300 and len(touched) > 20
    assert abs(made.places[touched, 0]).max() < 14, "only near the stroke in the middle"
    assert not made.outline.is_empty and naive_map([None] * 300, made.poses, ObjectMap().grid).shape == (240, 240)


def test_the_report_compares_the_map_with_a_plain_mean(tmp_path_factory):
    page = object_map.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    text = page.read_text()
    assert "quick run" in text and "plain mean" in text and page.with_suffix(".png").stat().st_size > 10_000
    with page.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["pad"] for row in rows} == {"nominal", "drawn", "drawn, constants known"}
    assert all(float(row["outline_mm"]) < 3 for row in rows)
