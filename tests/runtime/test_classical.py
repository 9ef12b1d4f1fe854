"""Classical methods of super-resolution: closed forms, fits, and the file of fitted ones."""

import numpy as np
import pytest

from edge.errors import EdgeError
from edge.evaluation.classical_methods import bicubic, bilinear, fit_gain, fit_linear_map, fitted_methods


def test_bilinear_is_exact_on_a_slope_between_the_outer_taxels():
    slope = np.arange(4.0)[None, :].repeat(4, axis=0)
    up = bilinear(slope, 10)
    expected = (np.arange(40) + 0.5) / 10 - 0.5
    assert np.allclose(up[0, 5:35], expected[5:35])
    assert np.allclose(up[:, :5], 0.0) and np.allclose(up[:, 35:], 3.0)
    assert np.allclose(bilinear(slope.T, 10), up.T), "rows and columns are where they belong"
    taxels = np.random.default_rng(0).standard_normal((5, 4, 4))
    assert np.allclose(bilinear(taxels, 7)[3], bilinear(taxels[3], 7)) and bilinear(taxels, 7).shape == (5, 28, 28)


def test_bicubic_is_exact_on_a_parabola():
    def parabola(x):
        return 1 - 2 * x + 3 * x**2

    rows, cols = parabola(np.arange(6.0)), parabola(np.arange(7.0) / 2)
    up = bicubic(np.outer(rows, cols), 10)
    fine_rows, fine_cols = ((np.arange(10 * n) + 0.5) / 10 - 0.5 for n in (6, 7))
    expected = np.outer(parabola(fine_rows), parabola(fine_cols / 2))
    assert np.allclose(up[15:45, 15:55], expected[15:45, 15:55])
    assert not np.allclose(up[5:55, 5:65], expected[5:55, 5:65])


def test_bicubic_goes_through_the_taxels_and_no_further():
    taxels = np.random.default_rng(4).standard_normal((3, 4, 4))
    assert np.allclose(bicubic(taxels, 5)[:, 2::5, 2::5], taxels)
    assert np.allclose(bicubic(np.full((4, 4), 3.0), 10), 3.0)
    spike = np.zeros((8, 8))
    spike[0, 0] = 1.0
    up = bicubic(spike, 10)
    assert up[24, 4] != 0 and (up[25:] == 0).all()


def test_fits_find_what_made_the_data():
    rng = np.random.default_rng(1)
    readings, matrix = rng.standard_normal((300, 6)), rng.standard_normal((6, 9))
    assert np.allclose(fit_linear_map(readings, readings @ matrix, ridge=1e-12), matrix, atol=1e-5)
    assert fit_gain(readings, 2.5 * readings) == pytest.approx(2.5)


def test_methods_come_from_a_file_and_another_is_refused(tmp_path):
    path, rng = tmp_path / "classical.npz", np.random.default_rng(2)
    matrix = rng.standard_normal((48, 1600)).astype(np.float32)
    newest = rng.standard_normal((3, 3, 4, 4))
    np.savez(path, bilinear_gain=np.float32(0.5), bicubic_gain=np.float32(0.25), linear_map=matrix)
    methods = fitted_methods(path, 10)
    assert np.allclose(methods["bilinear"](newest), 0.5 * bilinear(newest[:, 2], 10))
    assert np.allclose(methods["bicubic"](newest), 0.25 * bicubic(newest[:, 2], 10))
    assert np.allclose(methods["linear map"](newest)[1].ravel(), newest[1].ravel() @ matrix)


def test_a_missing_or_foreign_file_is_refused(tmp_path):
    path = tmp_path / "other.npz"
    with pytest.raises(EdgeError, match=r"train\.freeze"):
        fitted_methods(tmp_path / "none.npz", 10)
    np.savez(path, something=1)
    with pytest.raises(EdgeError, match="bilinear_gain"):
        fitted_methods(path, 10)
