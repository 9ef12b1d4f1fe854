from typing import NamedTuple

import numpy as np
import pytest
import torch

from firmware_bridge.pad_geometry import USPA44
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import (
    Layer,
    inner_tangential,
    surface_tangential_compliance,
)
from train.physics.friction import FrictionSolver
from train.physics.magnets import Magnet
from train.physics.taxel_response import traction_response
from train.surfaces.depth_image import NOTHING_MM

SIZE, CELL_MM = 42, 0.47
AS = np.concatenate([[0.0], np.logspace(-9, 4, 120), [1e6, 1e12]])
"""q h, from even loads to overflow."""


def cells_mm(size=SIZE, cell_mm=CELL_MM):
    return (np.arange(size) - (size - 1) / 2) * cell_mm


def radius_mm(size=SIZE, cell_mm=CELL_MM, centre_mm=(0.0, 0.0)):
    along = cells_mm(size, cell_mm)
    return np.hypot(along[None, :] - centre_mm[0], along[:, None] - centre_mm[1])


def push(solver, pressure, slide_mm=(0.0, 0.0), twist_rad=0.0, friction=0.5, tolerance=1e-5):
    """One pose."""
    (traction,), (residual,) = solver.solve(
        pressure[None], np.array([slide_mm]), np.array([twist_rad]), np.array([friction]), tolerance=tolerance
    )
    assert residual < 1.01 * tolerance
    traction = traction.astype(float)
    area, along = solver.cell_mm**2, cells_mm(solver.size, solver.cell_mm)
    moment = (along * traction[1] - along[:, None] * traction[0]).sum() * area
    stick = (pressure > 0) & (np.hypot(*traction) < (1 - 1e-4) * friction * pressure)
    return Pushed(traction, stick, traction.sum(axis=(1, 2)) * area, moment)


class Pushed(NamedTuple):
    traction_mpa: np.ndarray
    stick: np.ndarray
    force_n: np.ndarray
    moment_nmm: float


THICK, FINE_MM = Layer(thickness_mm=60.0, poisson=0.3), 0.2


@pytest.fixture(scope="module")
def thick():
    return FrictionSolver(THICK, 36, FINE_MM, torch.float64)


class TestLayer:
    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49, 0.4999])
    @pytest.mark.parametrize("thickness_mm", [0.5, 4.5, 50.0])
    def test_closed_form_and_boundary_conditions_agree_at_every_wave(self, thickness_mm, poisson):
        layer = Layer(thickness_mm, 0.12, poisson)
        q = AS / thickness_mm
        along, across = surface_tangential_compliance(layer, q)
        top = inner_tangential(layer, q, thickness_mm)
        assert (np.diff(along[:-1]) < 1e-6 * along[0]).all()
        assert (along > 0).all()
        # Measured 7e-11 and 4e-16.
        assert np.allclose(top.along[:-1], along[:-1], rtol=1e-9)
        assert np.allclose(top.across, across, rtol=1e-12)
        for height_mm in (0.0, 0.5 * thickness_mm, 0.99 * thickness_mm):
            inside = inner_tangential(layer, q, height_mm)
            for part in (inside.along, inside.across, inside.sunk):
                assert np.isfinite(part).all()
                assert np.abs(part).max() <= along[0] * (1 + 1e-9)
            if height_mm == 0:
                assert np.allclose([inside.along, inside.across, inside.sunk], 0, atol=1e-9 * along[0])


class TestFriction:
    def test_a_stuck_disc_on_a_thick_layer_is_as_stiff_as_mindlins(self, thick):
        disc = (radius_mm(36, FINE_MM) <= 3.0).astype(float)
        result = push(thick, disc, (0.1, 0.0), friction=1e6, tolerance=1e-4)
        a_mm = np.sqrt(disc.sum() * FINE_MM**2 / np.pi)
        expected_n = 8 * a_mm * THICK.shear_modulus_mpa / (2 - THICK.poisson) * 0.1
        # Measured 1.4 % above: cells, and a layer 20 radii thick.
        assert result.force_n[0] == pytest.approx(expected_n, rel=0.03)
        assert abs(result.force_n[1]) < 1e-4 * expected_n
        assert result.stick.sum() == disc.sum()

    def test_the_law_of_friction_holds(self):
        rng = np.random.default_rng(2)
        depth = np.where(radius_mm(centre_mm=(-1.0, 3.0)) < 6, 0.0, NOTHING_MM).astype(np.float32)
        pressure = ContactSolver(Layer(), SIZE, CELL_MM).solve(depth[None], 0.2).pressure_mpa[0]
        solver = FrictionSolver(Layer(), SIZE, CELL_MM, torch.float64)
        sticking = 0
        for _ in range(5):
            slide, twist, friction = rng.normal(0, 0.1, 2), rng.normal(0, 0.02), rng.uniform(0.3, 0.8)
            result = push(solver, pressure, slide, twist, friction)
            traction, along = result.traction_mpa, cells_mm()
            size, limit = np.hypot(*traction), friction * pressure
            assert (size <= limit * (1 + 1e-5)).all()
            # What a cell slips, the surface less the pad: none where it sticks, along its traction where it slips.
            moved = np.stack(np.broadcast_arrays(slide[0] - twist * along[:, None], slide[1] + twist * along))
            slip = moved - solver.displacement_mm(traction[None])[0]
            scale = np.sqrt((moved**2).mean())
            assert np.abs(slip[:, result.stick]).max(initial=0.0) < 2e-3 * scale
            slipping = (pressure > 0) & ~result.stick
            across = slip[0] * traction[1] - slip[1] * traction[0]
            assert np.abs(across[slipping] / size[slipping]).max(initial=0.0) < 2e-3 * scale
            assert ((slip * traction).sum(axis=0)[slipping] / size[slipping]).min(initial=0.0) > -2e-3 * scale
            sticking += result.stick.sum()
            # The pad's work is symmetric: C is.
            other = rng.normal(size=(1, 2, SIZE, SIZE))
            there = (solver.displacement_mm(other)[0] * traction).sum()
            assert there == pytest.approx((solver.displacement_mm(traction[None])[0] * other[0]).sum(), rel=1e-3)
        assert 0 < sticking < 5 * (pressure > 0).sum()


class TestMagnets:
    RIGHT, BACK, DOWN, LEAN_X, LEAN_Y = range(5)

    def test_an_even_traction_shears_the_layer_evenly(self):
        layer = Layer(thickness_mm=3.0)
        magnet = Magnet(diameter_mm=1e-6)  # a needle leans with the material along it
        response = traction_response(USPA44, layer, 61, 0.47, magnet).reshape(16, 5, 2, -1).sum(axis=-1)
        middle = response[[5, 6, 9, 10]]
        # Measured 2 %: the pad of 29 mm ends.
        assert np.allclose(middle[:, self.RIGHT, 0], magnet.height_mm / layer.shear_modulus_mpa, rtol=0.03)
        assert np.allclose(middle[:, self.LEAN_X, 0], 1 / layer.shear_modulus_mpa, rtol=0.03)
        assert np.allclose(response[:, self.RIGHT, 0].reshape(4, 4), response[:, self.BACK, 1].reshape(4, 4).T)
