import numpy as np
import pytest

from edge.classical import bilinear, fit_gain, fit_linear_map, fitted_methods
from edge.errors import EdgeError


def test_bilinear_keeps_a_constant():
    assert np.allclose(bilinear(np.full((4, 4), 3.0), 10), 3.0)


def test_bilinear_is_exact_on_a_slope_between_the_outer_taxels():
    slope = np.arange(4.0)[None, :].repeat(4, axis=0)
    up = bilinear(slope, 10)
    expected = (np.arange(40) + 0.5) / 10 - 0.5
    assert np.allclose(up[0, 5:35], expected[5:35])
    assert np.allclose(up[:, :5], 0.0)
    assert np.allclose(up[:, 35:], 3.0)


def test_bilinear_puts_rows_and_columns_where_they_belong():
    taxels = np.zeros((4, 4))
    taxels[1, 3] = 1.0
    row, col = np.unravel_index(bilinear(taxels, 10).argmax(), (40, 40))
    assert 10 <= row < 20
    assert 30 <= col < 40


def test_bilinear_works_on_a_batch_and_other_scales():
    taxels = np.random.default_rng(0).standard_normal((5, 4, 4))
    assert np.allclose(bilinear(taxels, 7)[3], bilinear(taxels[3], 7))
    assert bilinear(taxels, 7).shape == (5, 28, 28)


def test_fits_find_what_made_the_data():
    rng = np.random.default_rng(1)
    readings, matrix = rng.standard_normal((300, 6)), rng.standard_normal((6, 9))
    assert np.allclose(fit_linear_map(readings, readings @ matrix, ridge=1e-12), matrix, atol=1e-5)
    assert fit_gain(readings, 2.5 * readings) == pytest.approx(2.5)


def test_methods_come_from_a_file(tmp_path):
    path = tmp_path / "classical.npz"
    rng = np.random.default_rng(2)
    matrix = rng.standard_normal((48, 1600)).astype(np.float32)
    np.savez(path, bilinear_gain=np.float32(0.5), linear_map=matrix)
    newest = rng.standard_normal((3, 3, 4, 4))
    methods = fitted_methods(path, 10)
    assert np.allclose(methods["bilinear"](newest), 0.5 * bilinear(newest[:, 2], 10))
    assert np.allclose(methods["linear map"](newest)[1].ravel(), newest[1].ravel() @ matrix)


def test_a_missing_or_foreign_file_is_refused(tmp_path):
    with pytest.raises(EdgeError, match=r"train\.freeze"):
        fitted_methods(tmp_path / "none.npz", 10)
    np.savez(tmp_path / "other.npz", something=1)
    with pytest.raises(EdgeError, match="bilinear_gain"):
        fitted_methods(tmp_path / "other.npz", 10)
