import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.sensor import calibration
from train.experiments.support.band_limit import edge_distance_mm, kept_back, let_through, save_grating
from train.surfaces.named_surfaces import is_flat, surface_mesh

PIXEL_MM = 0.47


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return calibration.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_distance_to_a_straight_edge_is_that_of_pixel_centres():
    touched = np.zeros((1, 40, 40), bool)
    touched[:, :, :20] = True
    expected = (np.arange(40) - 19.5) * PIXEL_MM
    np.testing.assert_allclose(edge_distance_mm(touched, 10), np.broadcast_to(expected, (1, 40, 40)), atol=1e-9)


@pytest.mark.parametrize("all_over", [True, False])
def test_a_contact_without_an_edge_is_infinitely_far_from_it(all_over):
    assert np.isposinf(edge_distance_mm(np.full((2, 8, 8), all_over), 2)).all()


def test_long_waves_pass_the_layer_and_short_ones_do_not():
    assert let_through(1e5) == pytest.approx(1, abs=1e-3)
    assert let_through(1.0) < 1e-3
    assert (np.diff(let_through(np.linspace(1, 10, 50))) > 0).all()


def test_an_even_press_is_kept_from_nobody():
    np.testing.assert_allclose(kept_back(np.full((2, 40, 40), 0.3), 10), 0, atol=1e-12)


@pytest.mark.parametrize("halves", [1, 4, 12])
def test_of_a_wave_the_layer_keeps_back_what_it_does_not_let_through(halves):
    """A cosine of whole half waves across the window is the same wave beyond its mirrors."""
    wave = np.broadcast_to(np.cos(np.pi * halves * (np.arange(40) + 0.5) / 40), (1, 40, 40))
    kept = (1 - let_through(2 * 40 * PIXEL_MM / halves)) * wave
    np.testing.assert_allclose(kept_back(wave, 10), kept, atol=1e-9)
    np.testing.assert_allclose(kept_back(wave.swapaxes(1, 2), 10), kept.swapaxes(1, 2), atol=1e-9)


def test_a_grating_is_a_surface_of_bars_half_a_wavelength_wide(tmp_path):
    path = tmp_path / "new" / "grating-5.stl"
    save_grating(path, 5.0)
    mesh = surface_mesh(f"mesh:{path}")
    assert is_flat(mesh) and mesh.is_watertight
    bars = sorted(mesh.split(), key=lambda bar: bar.bounds[0, 0])
    np.testing.assert_allclose([bar.extents[0] for bar in bars], 2.5, atol=1e-4)
    np.testing.assert_allclose(np.diff([bar.centroid[0] for bar in bars]), 5.0, atol=1e-4)
    assert mesh.extents[0] > 50


def test_correlation_is_that_of_numpy_and_nothing_for_even_maps():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 3, 50))
    expected = [np.corrcoef(one, other)[0, 1] for one, other in zip(a, b, strict=True)]
    np.testing.assert_allclose(calibration.correlation(a, b), expected)
    np.testing.assert_allclose(calibration.correlation(a, 2 - 3 * a), -1)
    assert calibration.correlation(a, np.ones_like(a)).tolist() == [0, 0, 0]


def test_the_report_judges_every_bundled_network_in_every_way(page):
    rows = rows_of(page.with_suffix(".csv"))
    assert [(row["network"], row["on"]) for row in rows] == [
        (name, tested) for name in ("stsr", "mtsr2", "mtsr4") for tested in ("test", "unseen glyphs")
    ]
    assert {"covered %", "width %", "10 %", "99 %", "parameters", "MMAC", "run time ms"} <= set(rows[0])
    levels = [f"{100 * level:g} %" for level in calibration.LEVELS if level != 0.9]
    for row in rows:
        assert (np.diff([float(row[level]) for level in levels]) >= 0).all()
    for part in ("correlation", "distance", "gratings", "surfaces"):
        assert {row["network"] for row in rows_of(page.with_name(f"calibration-{part}.csv"))} == set(calibration.NAMES)
    assert page.with_suffix(".png").stat().st_size > 10_000


def test_pixels_by_distance_make_up_the_whole(page):
    shares = {}
    for row in rows_of(page.with_name("calibration-distance.csv")):
        key = row["network"], row["on"]
        shares[key] = shares.get(key, 0) + float(row["pixels %"])
    assert list(shares.values()) == pytest.approx([100] * 6, abs=0.5)


def test_the_verdict_follows_the_figures(page):
    covered = {
        row["network"]: float(row["covered %"].split()[0])
        for row in rows_of(page.with_suffix(".csv"))
        if row["on"] == "test"
    }
    inside = all(88 <= percent <= 92 for percent in covered.values())
    assert ("all within it" in page.read_text()) == inside
