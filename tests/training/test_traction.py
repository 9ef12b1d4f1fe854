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
from train.physics.pad_draws import Pad
from train.physics.taxel_response import Skin, traction_response
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

    def test_a_stuck_disc_turns_as_hard_as_reissners(self, thick):
        disc = (radius_mm(36, FINE_MM) <= 3.0).astype(float)
        result = push(thick, disc, twist_rad=0.05, friction=1e6, tolerance=1e-4)
        a_mm = np.sqrt(disc.sum() * FINE_MM**2 / np.pi)
        expected_nmm = 16 / 3 * THICK.shear_modulus_mpa * a_mm**3 * 0.05
        # Measured 2.3 % below: a disc of square cells.
        assert result.moment_nmm == pytest.approx(expected_nmm, rel=0.03)
        assert np.abs(result.force_n).max() < 1e-4 * expected_nmm

    @pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
    def test_a_sphere_slips_around_a_circle_as_cattaneo_and_mindlin_have_it(self, thick, share):
        size, cell_mm, a_mm, friction = 36, FINE_MM, 3.0, 0.4
        pressure = 0.05 * np.sqrt(np.maximum(1 - (radius_mm(size, cell_mm) / a_mm) ** 2, 0))
        load_n = pressure.sum() * cell_mm**2
        shear, nu = THICK.shear_modulus_mpa, THICK.poisson
        slide_mm = 3 * friction * load_n * (2 - nu) / (16 * shear * a_mm) * (1 - (1 - share) ** (2 / 3))
        result = push(thick, pressure, (slide_mm, 0.0), friction=friction, tolerance=1e-4)
        c_mm = np.sqrt(result.stick.sum() * cell_mm**2 / np.pi)
        # Measured 1.1 to 2.2 % and .001 to .014.
        assert result.force_n[0] == pytest.approx(share * friction * load_n, rel=0.03)
        assert c_mm / a_mm == pytest.approx((1 - share) ** (1 / 3), abs=0.03)

    def test_sliding_bears_mu_p_everywhere_against_the_slip(self):
        pressure = 0.1 * (radius_mm(centre_mm=(2.0, 1.0)) < 5.0)
        result = push(FrictionSolver(Layer(), SIZE, CELL_MM), pressure, (30.0, 40.0), friction=0.7, tolerance=1e-3)
        assert not result.stick.any()
        size = np.hypot(*result.traction_mpa)
        assert np.allclose(size, 0.7 * pressure, rtol=1e-4)
        direction = result.traction_mpa[:, pressure > 0].T / size[pressure > 0][:, None]
        assert np.abs(direction - [0.6, 0.8]).max() < 0.05

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

    def test_a_batch_in_boxes_is_each_pose_on_the_whole_pad_and_the_residual_tells_the_error(self):
        rng = np.random.default_rng(0)
        pressure = np.stack(
            [0.1 * (radius_mm(centre_mm=rng.uniform(-7, 7, 2)) < rng.uniform(0.4, 8)) for _ in range(12)]
        )
        pressure[3] = 0.0
        slide, twist, friction = rng.normal(0, 0.2, (12, 2)), rng.normal(0, 0.02, 12), rng.uniform(0.2, 1, 12)
        friction[4] = 0.0
        fast_mpa, residual = FrictionSolver(Layer(), SIZE, CELL_MM).solve(pressure, slide, twist, friction)
        exact = FrictionSolver(Layer(), SIZE, CELL_MM, torch.float64)
        assert residual.max() < 1e-3
        assert not fast_mpa[3:5].any()
        for pose in set(range(12)) - {3, 4}:
            whole = np.maximum(pressure[pose], 1e-9)  # in contact everywhere, so that its box is the whole pad
            one = push(exact, whole, slide[pose], twist[pose], friction[pose])
            force_n = fast_mpa[pose].sum(axis=(1, 2)) * CELL_MM**2
            # Measured 0.2 % at most.
            assert np.linalg.norm(one.force_n - force_n) < 0.01 * np.linalg.norm(one.force_n)


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

    def test_the_sums_are_those_of_whole_complex_waves(self):
        layer, magnet, size, cell_mm = Layer(), Magnet(), 20, 1.0
        response = traction_response(USPA44, layer, size, cell_mm, magnet).reshape(16, 5, 2, size, size)
        q_x = 2 * np.pi * np.fft.fftfreq(4 * size, cell_mm)[None, :]
        q_y = 2 * np.pi * np.fft.fftfreq(4 * size, cell_mm)[:, None]
        q = np.hypot(q_x, q_y)
        fields = [inner_tangential(layer, q, magnet.height_mm + shift) for shift in (-1e-3, 0.0, 1e-3)]
        waves = np.stack([q_x + 0 * q, q_y + 0 * q]) / np.where(q > 0, q, 1)
        inside = [
            field.across * np.eye(2)[:, :, None, None] + (field.along - field.across) * waves[:, None] * waves
            for field in fields
        ]
        down = 1j * fields[1].sunk * waves
        slope_down = 1j * np.stack([q_x + 0 * q, q_y + 0 * q])[:, None] * down
        shape = (0.25 - 1) / (0.25 + 1)
        lean = (1 + shape) / 2 * (inside[2] - inside[0]) / 2e-3 + (1 - shape) / 2 * slope_down
        transfers = np.concatenate([inside[1], down[None], lean])
        for taxel in (0, 6):
            x_mm, y_mm = USPA44.taxel_centres_mm()[taxel]
            wave_x = np.exp(1j * q_x.T * (x_mm - cells_mm(size, cell_mm)))
            wave_y = np.exp(1j * q_y * (y_mm - cells_mm(size, cell_mm)))
            expected = (wave_y.T @ transfers @ wave_x).real / (4 * size) ** 2
            # They differ in the one highest wave of both axes, whose phase no grid shows.
            assert np.allclose(response[taxel], expected, atol=1e-5 * np.abs(expected).max())

    def test_readings_follow_the_traction_and_are_as_before_without(self):
        skin = Skin(Pad(), SIZE, CELL_MM)
        pressure = np.full((1, 1, SIZE, SIZE), 0.01, dtype=np.float32)
        alone = skin.frames(pressure)
        right = np.zeros((1, 1, 2, SIZE, SIZE), dtype=np.float32)
        assert np.array_equal(skin.frames(pressure, right), alone)
        right[:, :, 0] = 0.005
        changed = (skin.frames(pressure, right) - alone)[0, 0]
        assert (changed[0] > 50).all()
        assert np.abs(changed[1]).max() < 0.2 * changed[0].min()
        back = right[:, :, ::-1].copy()
        turned = (skin.frames(pressure, back) - alone)[0, 0]
        assert np.allclose(turned[1], changed[0].T, atol=0.05)
