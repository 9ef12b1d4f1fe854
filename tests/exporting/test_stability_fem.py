import numpy as np
import pytest

pytest.importorskip("felupe", reason="the FEM reference is an extra: pip install '.[fem]'")

from export.stability import finite_elements
from train.physics.elastic_layer import Layer
from train.physics.fem_reference import FemPad, NoEquilibriumError


@pytest.fixture(scope="module")
def quick():
    return {(case.case, case.severity, case.what): case for case in finite_elements.cases(quick=True)}


def test_every_case_holds(quick):
    cases = quick
    assert [key for key, case in cases.items() if not case.holds] == []
    assert {case.part for case in cases.values()} == {finite_elements.PART}
    assert all(case.run_ms is None or case.run_ms > 0 for case in cases.values())


def test_displacement_alone_locks_where_the_mixed_formulation_does_not(quick):
    cases = quick
    ratios = [
        cases["locking", f"K/G {bulk:g}", "force by displacement alone, to the mixed one"].value
        for bulk in finite_elements.BULKS
    ]
    assert (np.diff(ratios) > 0).all()
    # Ten times the bulk modulus: all but nothing to the one, nearly ten times the force to the other.
    assert cases["locking", "K/G 1000 to 10000", "change of the force, mixed"].value < 0.01
    assert ratios[-1] / ratios[-2] > 5
    assert ratios[0] < 1.3


def test_a_finer_mesh_locks_less_and_changes_the_mixed_force_far_less():
    layer, steps_mm = Layer(poisson=0.4999), np.array([0.1])

    def force_n(scale, cells_high, mixed):
        pad = FemPad(scale, cells_high, layer, mixed=mixed)
        return pad.press(np.zeros((pad.size, pad.size)), steps_mm).force_n[0]

    coarse, fine = (force_n(*mesh, True) for mesh in ((2, 2), (4, 4)))
    locked_coarse, locked_fine = (force_n(*mesh, False) for mesh in ((2, 2), (4, 4)))
    assert coarse < 1.1 * fine
    assert locked_coarse > 2 * locked_fine > 20 * fine


def test_what_goes_too_far_ends_in_an_error_that_tells_where(quick):
    cases = quick
    leap = cases["compression to 40%", "K/G 100, one leap", "refused"]
    assert leap.guard.startswith("NoEquilibriumError: step 1 of 1, indentation 2.7 mm")
    stepped = cases["compression to 40%", "K/G 100, steps of 5%", "thickness left, share"]
    assert "NoEquilibriumError" in stepped.guard
    assert 0.4 < stepped.value < 0.8
    layer = Layer(poisson=finite_elements.REFERENCE_POISSON)
    pad = FemPad(2, 2, layer)
    with pytest.raises(NoEquilibriumError, match="other steps"):
        pad.press(np.zeros((pad.size, pad.size)), np.array([0.6 * layer.thickness_mm]))


def test_softer_rubber_goes_all_the_way_on_the_quick_mesh(quick):
    cases = quick
    for step in ("5%", "10%"):
        case = cases["compression to 40%", f"K/G 10, steps of {step}", "thickness left, share"]
        assert not case.guard
        assert case.value == pytest.approx(0.4)


def test_a_solver_that_gets_nowhere_is_broken(monkeypatch):
    def nowhere(self, depth_mm, steps_mm):
        raise NoEquilibriumError("step 1", 0.0)

    monkeypatch.setattr(FemPad, "press", nowhere)
    for poisson, step in ((0.45, 0.05), (finite_elements.REFERENCE_POISSON, 0.1)):
        assert not finite_elements._compress(finite_elements.Mesh(2, 2), poisson, step, 0.4).holds
