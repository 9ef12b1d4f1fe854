import numpy as np
import pytest

from train.experiments.paper.fig7 import Method, _percent, _rms_mm

TRUTH = np.zeros((1, 2, 4, 4), dtype=np.float32)
TRUTH[0, :, 1:3, 1:3] = np.array([0.1, 0.2])[:, None, None]
TRUTH[0, :, 0, 0] = -0.05
INDENTATION_MM = np.array([0.1, 0.2])


def test_a_scaled_method_gets_the_best_single_factor():
    shape = np.maximum(TRUTH, 0) * 7
    assert _rms_mm(Method("m", shape, 0.0, scaled=True), TRUTH) == pytest.approx(0, abs=1e-7)
    bent = shape + np.random.default_rng(0).normal(size=shape.shape).astype(np.float32)
    method = Method("m", bent, 0.0, scaled=True)
    best = ((method.against(TRUTH) - TRUTH) ** 2).sum()
    for factor in (0.99, 1.01):
        assert ((factor * method.against(TRUTH) - TRUTH) ** 2).sum() > best


def test_heaps_count_only_where_they_are_asked_for():
    flat = Method("m", np.maximum(TRUTH, 0), 0.0)
    assert _rms_mm(flat, TRUTH).tolist() == [[0, 0]]
    assert _rms_mm(flat, TRUTH, heaps=True) == pytest.approx(np.full((1, 2), 0.05 / 4))


def test_errors_are_shares_of_each_steps_indentation():
    off = Method("m", np.where(TRUTH > 0, TRUTH * 1.1, 0).astype(np.float32), 0.0)
    assert _percent(off, TRUTH, INDENTATION_MM) == pytest.approx(np.full((1, 2), 10 * np.sqrt(4 / 16)), rel=1e-4)
