"""The report on intervals, from a quick run of a model that has them."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_contract, write_model
from experiment_samples import quick_bench
from interval_samples import export_with_intervals

from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from train.errors import TrainError
from train.experiments.sensor import interval_coverage
from train.experiments.sensor.interval_coverage import Held
from train.experiments.support.gratings import save_grating
from train.surfaces.named_surfaces import is_flat, surface_mesh


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    models = tmp_path_factory.mktemp("models")
    export_with_intervals(models)
    (models / "one-int8.onnx").rename(models / f"{DEFAULT_MODEL}.onnx")
    bench = replace(quick_bench(tmp_path_factory), models=models)
    return interval_coverage.run(bench, tmp_path_factory.mktemp("reports"))


def rows_of(page, part=""):
    with page.with_name(f"interval-coverage{part}.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_page_has_every_level_region_set_and_half(page):
    assert "quick run" in page.read_text() and page.with_suffix(".png").stat().st_size > 10_000
    levels = rows_of(page)
    assert {(row["taps"], row["level %"]) for row in levels} >= {("1", "50.0"), ("2", "95.0")}
    assert all(row["inside"].count("..") == 1 for row in levels)
    assert {row["set"] for row in rows_of(page, "-unlike")} >= {"unseen glyphs", "grating-20 mm", "wide, 1 dead taxels"}
    assert len(rows_of(page, f"-families-{DEFAULT_MODEL}")) > 10 and rows_of(page, "-risk")
    assert rows_of(page, "-expected")[-1]["family"] == "all"


def test_a_model_without_levels_is_refused(tmp_path):
    model = ModelSession(write_model(tmp_path / "sure.onnx", make_contract(interval_factor=1.6)))
    windows, truth = np.zeros((1, 4, 3, 4, 4), np.float32), np.zeros((1, 40, 40), np.float32)
    with pytest.raises(TrainError, match="'sure' has no levels of intervals: export it"):
        interval_coverage.hold(model, windows, [None], truth, np.zeros(1, int), 1)


def held_of(error_mm, deviation_mm=0.1, region=None):
    """Return windows of 2 x 2 pixels with these errors; half widths are the deviations."""
    error = np.asarray(error_mm, dtype=np.float32)
    count = len(error)
    return Held(
        pattern=np.ones((count, 2, 2), dtype=np.float32),
        deviation=np.full((count, 2, 2), deviation_mm, dtype=np.float32),
        truth=1 + error,
        region=np.zeros((count, 2, 2), dtype=np.int8) if region is None else region,
        expected_mm=np.arange(count, dtype=np.float64),
        group=np.arange(count),
        levels={"50": [0.5] * 4, "90": [1.0] * 4},
    )


def test_coverage_is_of_the_pixels_of_a_region():
    region = np.array([[[0, 0], [1, 1]]] * 2, dtype=np.int8)
    held = held_of([[[0.06, 0.2], [0.06, 0.06]], [[0.06, 0.06], [0.2, 0.2]]], region=region)
    assert held.coverage(0)[0] == 75 and held.coverage(1)[0] == 50
    low, high = held.coverage(1)[1:]
    assert (low, high) == (0, 100), "of two pads, one has all and the other no pixel"
    assert held.coverage(0, "50")[0] == 0


def test_the_trusted_half_is_that_of_the_least_expected_error():
    errors = np.array([1.0, 2.0, 3.0, 4.0])
    assert interval_coverage._half(errors, np.array([4.0, 3.0, 2.0, 1.0])) == pytest.approx(np.sqrt((9 + 16) / 2))
    assert interval_coverage._half(errors, errors) == pytest.approx(np.sqrt((1 + 4) / 2))
    assert interval_coverage._risk(errors, errors)[-1] == pytest.approx(np.sqrt(30 / 4))


def test_a_grating_is_a_surface_of_bars_half_a_wavelength_wide(tmp_path):
    path = tmp_path / "new" / "grating-5.stl"
    save_grating(path, 5.0)
    mesh = surface_mesh(f"mesh:{path}")
    assert is_flat(mesh) and mesh.is_watertight
    bars = sorted(mesh.split(), key=lambda bar: bar.bounds[0, 0])
    np.testing.assert_allclose([bar.extents[0] for bar in bars], 2.5, atol=1e-4)
    np.testing.assert_allclose(np.diff([bar.centroid[0] for bar in bars]), 5.0, atol=1e-4)
    assert mesh.extents[0] > 50
