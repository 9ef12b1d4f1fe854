"""The elastic pad against closed forms, finite elements and itself: layer, contact, friction, magnets, and presses."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from firmware_bridge.pad_geometry import USPA44
from train.errors import SurfaceError
from train.families.catalogue import heights_of
from train.families.shapes import NOWHERE_MM
from train.physics.contact import BARE, ContactSolver, FrictionSolver
from train.physics.elastic_layer import (
    Layer,
    inner_displacement,
    inner_tangential,
    surface_compliance,
    surface_tangential_compliance,
)
from train.physics.gripped import (
    FINE_SCALE,
    FRAMES,
    MAX_INDENTATION_MM,
    MOST_FORCE_N,
    SCALE,
    TRACTION_SCALE,
    GrippedPad,
)
from train.physics.magnets import Magnet, MagnetArray
from train.physics.pad_draws import NOMINAL, Pad
from train.physics.taxel_response import Skin
from train.physics.tpsf import resample, resample_touching
from train.surfaces.depth_image import NOTHING_MM, Pose

SIZE, CELL_MM = 42, 0.47
WAVES = np.concatenate([[0.0], np.logspace(-9, 4, 60), [1e6]])
"""q h, from even loads to overflow."""


def cells_mm(size=SIZE, cell_mm=CELL_MM):
    return (np.arange(size) - (size - 1) / 2) * cell_mm


def radius_mm(size=SIZE, cell_mm=CELL_MM, centre_mm=(0.0, 0.0)):
    along = cells_mm(size, cell_mm)
    return np.hypot(along - centre_mm[0], along[:, None] - centre_mm[1])


def punch(radius, centre_mm=(0.0, 0.0), size=SIZE, cell_mm=CELL_MM):
    return np.where(radius_mm(size, cell_mm, centre_mm) <= radius, 0.0, NOTHING_MM).astype(np.float32)[None]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.4999])
@pytest.mark.parametrize("thickness_mm", [0.1, 4.5, 50.0])
def test_closed_forms_and_boundary_conditions_agree(poisson, thickness_mm):
    layer, q = Layer(thickness_mm, 0.12, poisson), WAVES / thickness_mm
    compliance, (down, sideways) = surface_compliance(layer, q), inner_displacement(layer, q, thickness_mm)
    assert np.isfinite(compliance).all() and (compliance > 0).all() and np.isfinite(sideways).all()
    # Near nu = 0.5 the long waves' compliance is a small difference of large numbers.
    assert np.allclose(down, compliance, rtol=5e-7, atol=1e-12)
    along, across = surface_tangential_compliance(layer, q)
    top, board = (inner_tangential(layer, q, height_mm) for height_mm in (thickness_mm, 0.0))
    assert np.allclose(top.along[:-1], along[:-1], rtol=1e-9) and np.allclose(top.across, across, rtol=1e-12)
    assert np.allclose([board.along, board.across, board.sunk], 0, atol=1e-9 * along[0])


@pytest.mark.parametrize("settings", [{"poisson": 0.5}, {"poisson": -0.1}, {"thickness_mm": 0.0}])
def test_impossible_layers_are_refused(settings):
    with pytest.raises(ValueError, match=r"poisson|positive"):
        Layer(**settings)


# By finite elements of the whole pad (docs/decisions.md): stiffness in N/mm, pressure over its mean at .235, 7.05 and
# 9.635 mm from the centre along x, and per mm of indentation the inner, edge and corner magnets' way down and outwards.
ELEMENTS = {
    0.45: (46.97, (1.33, 1.09, 0.60), (0.450, 0.438, 0.438), (0.189, 0.674, 0.535)),
    0.495: (56.8, (1.48, 1.11, 0.48), (0.385, 0.382, 0.389), (0.290, 0.973, 0.734)),
}


@pytest.mark.parametrize("poisson", ELEMENTS)
def test_a_flat_face_presses_as_the_finite_elements_have_it(poisson):
    layer, (stiffness, shape, down, out) = Layer(poisson=poisson), ELEMENTS[poisson]
    flat = np.zeros((1, SIZE, SIZE), dtype=np.float32)
    bare, pressure = (
        ContactSolver(layer, SIZE, CELL_MM, torch.float64, sides=sides).solve(flat, 1.0, 1e-4)[0][0].astype(float)
        for sides in (0.0, 1.0)
    )
    assert bare.sum() * CELL_MM**2 > 1.6 * stiffness  # so much is at stake
    assert pressure.sum() * CELL_MM**2 == pytest.approx(stiffness, rel=0.09)
    found = np.interp([0.235, 7.05, 9.635], cells_mm(), pressure[SIZE // 2]) / pressure.mean()
    assert np.abs(found - shape).max() < 0.09
    skin = Skin(Pad(poisson=poisson, in_plane_share=1.0, free_sides=1.0), SIZE, CELL_MM)
    quarter = skin.movement(pressure).reshape(4, 4, 5)[2:, 2:].reshape(4, 5)[[0, 1, 3]]
    assert quarter[:, 2] == pytest.approx(down, rel=0.2)
    assert quarter[:, 0] == pytest.approx(out, rel=0.12)


@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_no_pull_no_overlap_and_one_of_them_zero(poisson):
    solver = ContactSolver(Layer(poisson=poisson), SIZE, CELL_MM, torch.float64)
    ball = (30 - np.sqrt(900 - radius_mm() ** 2)).astype(np.float32)[None]
    depth = np.concatenate([punch(6.0), ball, punch(4.0, (9.0, 9.0))])
    pressure, residual = solver.solve(depth, indentation_mm=0.3, tolerance=1e-6)
    gap = solver.displacement_mm(pressure) - (0.3 - depth)
    assert (pressure >= 0).all() and gap.min() > -1e-5
    assert np.abs(gap[pressure > 0]).max() < 1e-5 and residual.max() < 1e-6


@pytest.mark.parametrize("layer", [Layer(poisson=0.4999), Layer(thickness_mm=0.1), Layer(thickness_mm=50.0)])
def test_stiff_layers_are_solved_alike_in_both_precisions(layer):
    found = [
        ContactSolver(layer, SIZE, CELL_MM, kind).solve(punch(4.0), 0.3) for kind in (torch.float32, torch.float64)
    ]
    assert max(float(residual[0]) for _, residual in found) < 1e-3
    single_n, double_n = (pressure.sum(dtype=float) for pressure, _ in found)
    assert single_n == pytest.approx(double_n, rel=1e-4)


def test_a_punch_on_a_thick_layer_is_boussinesqs_and_mindlins():
    layer, size, cell_mm = Layer(thickness_mm=8.0, poisson=0.3), 128, 0.1
    shape = punch(0.4, size=size, cell_mm=cell_mm)
    radius = np.sqrt((shape == 0).sum() * cell_mm**2 / np.pi)
    pressure, _ = ContactSolver(layer, size, cell_mm, torch.float64).solve(shape, indentation_mm=0.1, tolerance=1e-6)
    # Measured 0.8 % above: cells, and a layer 20 radii thick instead of a half-space.
    expected_n = 4 * layer.shear_modulus_mpa * radius * 0.1 / (1 - layer.poisson)
    assert pressure.sum(dtype=float) * cell_mm**2 == pytest.approx(expected_n, rel=0.02)
    solver = FrictionSolver(layer, size, cell_mm, torch.float64)
    *_, force_n = push(solver, (shape[0] == 0) * 1.0, (0.1, 0.0), 0.0, 1e6, 1e-4)
    expected_n = 8 * radius * layer.shear_modulus_mpa / (2 - layer.poisson) * 0.1
    assert force_n == pytest.approx((expected_n, 0), rel=0.03, abs=1e-4 * expected_n)


def push(solver, pressure, slide_mm, twist_rad, friction, tolerance=1e-5):
    """Traction in [MPa] of one pose, where it sticks, and the force in [N]."""
    (traction,), (residual,) = solver.solve(
        pressure[None], np.array([slide_mm]), np.array([twist_rad]), np.array([friction]), tolerance=tolerance
    )
    assert residual < 1.01 * tolerance
    traction = traction.astype(float)
    stick = (pressure > 0) & (np.hypot(*traction) < (1 - 1e-4) * friction * pressure)
    return traction, stick, traction.sum(axis=(1, 2)) * solver.cell_mm**2


def test_the_law_of_friction_holds():
    rng = np.random.default_rng(2)
    pressure = ContactSolver(Layer(), SIZE, CELL_MM).solve(punch(6.0, (-1.0, 3.0)), 0.2)[0][0]
    solver, sticking = FrictionSolver(Layer(), SIZE, CELL_MM, torch.float64), 0
    for _ in range(5):
        slide, twist, friction = rng.normal(0, 0.1, 2), rng.normal(0, 0.02), rng.uniform(0.3, 0.8)
        traction, stick, _ = push(solver, pressure, slide, twist, friction)
        along, size = cells_mm(), np.hypot(*traction)
        assert (size <= friction * pressure * (1 + 1e-5)).all()
        # What a cell slips, the surface less the pad: none where it sticks, along its traction where it slips.
        moved = np.stack(np.broadcast_arrays(slide[0] - twist * along[:, None], slide[1] + twist * along))
        slip = moved - solver.displacement_mm(traction[None])[0]
        scale = np.sqrt((moved**2).mean())
        assert np.abs(slip[:, stick]).max(initial=0.0) < 2e-3 * scale
        slipping = (pressure > 0) & ~stick
        across = slip[0] * traction[1] - slip[1] * traction[0]
        assert np.abs(across[slipping] / size[slipping]).max(initial=0.0) < 2e-3 * scale
        assert ((slip * traction).sum(axis=0)[slipping] / size[slipping]).min(initial=0.0) > -2e-3 * scale
        sticking += stick.sum()
    assert 0 < sticking < 5 * (pressure > 0).sum()


def test_the_whole_array_is_magpylibs_sum_over_all_magnets():
    rng, magnet = np.random.default_rng(2), Magnet()
    movement = rng.normal(size=(16, 5)) * [0.1, 0.1, 0.15, 0.3, 0.3]
    source = magpylib.Collection()
    for (x_mm, y_mm), (right, back, down, lean_x, lean_y) in zip(USPA44.taxel_centres_mm(), movement, strict=True):
        place = np.array([x_mm + right, y_mm + back, 2.5 - down]) * 1e-3
        upright, _ = Rotation.align_vectors([[lean_x, lean_y, 1.0]], [[0.0, 0.0, 1.0]])
        moment = magnet.remanence_t * np.pi / 4 * 1e-3**2 * 0.5e-3 / magpylib.mu_0
        source.add(magpylib.misc.Dipole(place, upright, moment=(0, 0, moment)))
    chips = np.column_stack([USPA44.taxel_centres_mm(), np.full(16, 0.5)]) * 1e-3
    assert np.allclose(MagnetArray(USPA44, magnet).flux_mt(movement), 1e3 * source.getB(chips), atol=1e-5)


def test_a_magnet_near_its_chip_or_through_it_is_refused():
    with pytest.raises(ValueError, match="mm above its chip"):
        MagnetArray(USPA44, Magnet(chip_height_mm=2.3))
    array, movement = MagnetArray(USPA44, Magnet()), np.zeros((16, 5))
    assert np.isfinite(array.change_mt(movement)).all()
    for down_mm in (1.01, 1.75, np.nan):
        movement[3, 2] = down_mm
        with pytest.raises(ValueError, match=r"mm above its chip, expected 0\.75 mm or more"):
            array.change_mt(movement)


@pytest.fixture(scope="module")
def pad():
    return GrippedPad(NOMINAL)


def press(pad, heights_mm, depth_mm=0.2, slide_mm=(0.0, 0.0), twist_rad=0.0, friction=0.5, **options):
    depth, slide, twist, mu = (np.array([value]) for value in (depth_mm, slide_mm, twist_rad, friction))
    return pad.press(heights_mm, depth, slide, twist, mu, [BARE], **options)


@pytest.mark.parametrize(("slide_mm", "twist_rad"), [((0.1, 0.0), 0.0), ((0.0, -0.3), 0.0), ((0.05, 0.1), 0.03)])
def test_traction_adds_up_to_force_and_twist(pad, slide_mm, twist_rad):
    pixel_mm = USPA44.pitch_mm / TRACTION_SCALE
    done = press(pad, heights_of("C", Pose(0.5, -0.5, 20.0), pad)[None], 0.3, slide_mm, twist_rad, friction=0.6)
    added_n = done.traction_kpa[0].sum(axis=(1, 2)) * 1e-3 * pixel_mm**2
    assert added_n == pytest.approx(done.force_n[0], rel=1e-4, abs=1e-5)
    across_mm = (np.arange(8) - 3.5) * pixel_mm
    x_kpa, y_kpa, _ = done.traction_kpa[0]
    twist = float((y_kpa * across_mm - x_kpa * across_mm[:, None]).sum() * 1e-3 * pixel_mm**2)
    # Coarse pixels know no arm within themselves: off by 5 % of force times the pixel, measured.
    most = 0.08 * float(np.abs(done.force_n[0, :2]).max()) * pixel_mm
    assert twist == pytest.approx(float(done.twist_nmm[0]), abs=most + 1e-3)
    assert np.abs(done.force_n[0, :2]).max() > 0.1 or abs(done.twist_nmm[0]) > 1, "it is dragged"


@pytest.mark.parametrize("name", ["C", "O"])
def test_every_frame_of_a_whole_tap_is_a_press_of_its_depth(pad, name):
    heights = heights_of(name, Pose(1.0, -0.5, 30.0), pad)[None]
    tap = pad.tap(heights, 5.0)
    assert tap.indentation_mm[0] == pytest.approx(tap.indentation_mm[0, -1] * np.arange(1, FRAMES + 1) / FRAMES)
    reached = tap.force_n[0, -1] == pytest.approx(5.0, rel=1e-3)
    assert reached or tap.indentation_mm[0, -1] == pytest.approx(MAX_INDENTATION_MM)
    for frame in (4, -1):
        depth_mm = float(tap.indentation_mm[0, frame])
        done = press(pad, heights, depth_mm)
        assert np.abs(done.counts[0] - tap.counts[0, frame]).max() < 1e-3 * np.abs(tap.counts[0, -1]).max()
        assert done.force_n[0, 2] == pytest.approx(tap.force_n[0, frame], rel=1e-4)
        true = resample(tap.unit_patterns, FINE_SCALE, SCALE) * depth_mm
        assert np.abs(done.patterns - true).max() < 1e-3 * depth_mm
        assert np.array_equal(done.touching, resample_touching(tap.touching, FINE_SCALE, SCALE))
    fine = press(pad, heights, 0.2, scale=FINE_SCALE)
    assert fine.patterns.shape == tap.unit_patterns.shape and np.array_equal(fine.touching, tap.touching)


def test_a_press_that_takes_too_much_force_goes_less_deep():
    stiff = GrippedPad(replace(NOMINAL, thickness_mm=3.6, shear_modulus_mpa=0.15))
    face = np.zeros((1, *(stiff.places_mm[0] + stiff.places_mm[1]).shape), np.float32)
    free = stiff.tap(face, 1e3)
    held = press(stiff, face, 0.5)
    assert free.force_n[0, -1] > 1.3 * MOST_FORCE_N
    assert 0.7 * MOST_FORCE_N < held.force_n[0, 2] <= MOST_FORCE_N
    assert held.indentation_mm[0] < free.indentation_mm[0, -1] == 0.5
    assert held.patterns.max() == pytest.approx(held.indentation_mm[0], rel=1e-4)
    light = press(stiff, face, 0.1)
    assert light.indentation_mm[0] == pytest.approx(0.1) and light.force_n[0, 2] < MOST_FORCE_N
    with pytest.raises(SurfaceError, match="nothing lies under the pad"):
        press(stiff, np.full_like(face, NOWHERE_MM))
