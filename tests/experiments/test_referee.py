import numpy as np
import pytest

pytest.importorskip("felupe", reason="the FEM reference is an extra: pip install '.[fem]'")

from train.physics import fem_reference as referee
from train.physics.fem_reference import Mesh, press_or_recall

STEPS_MM = np.array([0.1, 0.2])
COARSE = Mesh(2, 1)


def test_a_verdict_is_kept_and_recalled_without_finite_elements(tmp_path, monkeypatch):
    first = press_or_recall("large circle", COARSE, STEPS_MM, tmp_path)
    assert first.patterns_mm.shape == (2, 40, 40)
    assert first.force_n[1] > 2 * first.force_n[0] > 0
    assert first.patterns_mm[:, 20, 20] == pytest.approx(STEPS_MM, rel=1e-3)

    def refuse(*_):
        raise AssertionError("worked out again")

    monkeypatch.setattr(referee, "FemPad", refuse)
    again = press_or_recall("large circle", COARSE, STEPS_MM, tmp_path)
    assert np.array_equal(again.patterns_mm, first.patterns_mm)
    assert np.array_equal(again.force_n, first.force_n)
    # A change of anything that the answer depends on asks again.
    for other in (("small circle", COARSE, STEPS_MM), ("large circle", Mesh(2, 2), STEPS_MM)):
        with pytest.raises(AssertionError, match="worked out again"):
            press_or_recall(*other, tmp_path)
    with pytest.raises(AssertionError, match="worked out again"):
        press_or_recall("large circle", COARSE, STEPS_MM / 2, tmp_path)
