"""Presses of any shape: held against closed forms, against flat taps, and against themselves in the limits."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge.pad_geometry import USPA44
from train.errors import SurfaceError
from train.families.family_shares import heights_of
from train.families.shapes import NOWHERE_MM
from train.physics.contact import BARE
from train.physics.gripped import (
    FINE_SCALE,
    FRAMES,
    MAX_INDENTATION_MM,
    MOST_FORCE_N,
    SCALE,
    TRACTION_SCALE,
    GrippedPad,
)
from train.physics.pad_draws import NOMINAL
from train.physics.tpsf import resample, resample_touching
from train.surfaces.depth_image import Pose

PIXEL_MM = USPA44.pitch_mm / TRACTION_SCALE


@pytest.fixture(scope="module")
def pad():
    return GrippedPad(NOMINAL)


def figure(pad, name="C", pose=None):
    """Heights of a figure under the pad, (1, m, m) in [mm]."""
    pose = Pose(0.5, -0.5, 20.0) if pose is None else pose
    return heights_of(name, pose, pad)[None]


def face(pad, slope=0.0):
    x_mm, _ = np.broadcast_arrays(*pad.places_mm)
    return (slope * x_mm)[None].astype(np.float32)


def press(pad, heights_mm, depth_mm=0.2, slide_mm=(0.0, 0.0), twist_rad=0.0, friction=0.5, cover=BARE, **options):
    """One press."""
    return pad.press(
        heights_mm,
        np.array([depth_mm]),
        np.array([slide_mm]),
        np.array([twist_rad]),
        np.array([friction]),
        [cover],
        **options,
    )


@pytest.mark.parametrize(("slide_mm", "twist_rad"), [((0.1, 0.0), 0.0), ((0.0, -0.3), 0.0), ((0.05, 0.1), 0.03)])
def test_traction_adds_up_to_force_and_twist(pad, slide_mm, twist_rad):
    done = press(pad, figure(pad), 0.3, slide_mm, twist_rad, friction=0.6)
    added_n = done.traction_kpa[0].sum(axis=(1, 2)) * 1e-3 * PIXEL_MM**2
    assert added_n == pytest.approx(done.force_n[0], rel=1e-4, abs=1e-5)
    across_mm = (np.arange(8) - 3.5) * PIXEL_MM
    x_kpa, y_kpa, _ = done.traction_kpa[0]
    twist = float((y_kpa * across_mm - x_kpa * across_mm[:, None]).sum() * 1e-3 * PIXEL_MM**2)
    # Coarse pixels know no arm within themselves: off by 5 % of force times the pixel, measured.
    most = 0.08 * float(np.abs(done.force_n[0, :2]).max()) * PIXEL_MM
    assert twist == pytest.approx(float(done.twist_nmm[0]), abs=most + 1e-3)
    assert np.abs(done.force_n[0, :2]).max() > 0.1 or abs(done.twist_nmm[0]) > 1, "it is dragged"


@pytest.mark.parametrize("name", ["C", "O"])
def test_every_frame_of_a_whole_tap_is_a_press_of_its_depth(pad, name):
    pose = Pose(1.0, -0.5, 30.0)
    heights = figure(pad, name, pose)
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
    free = stiff.tap(face(stiff), 1e3)
    held = press(stiff, face(stiff), 0.5)
    assert free.force_n[0, -1] > 1.3 * MOST_FORCE_N
    assert 0.7 * MOST_FORCE_N < held.force_n[0, 2] <= MOST_FORCE_N
    assert held.indentation_mm[0] < free.indentation_mm[0, -1] == 0.5
    assert held.patterns.max() == pytest.approx(held.indentation_mm[0], rel=1e-4)
    light = press(stiff, face(stiff), 0.1)
    assert light.indentation_mm[0] == pytest.approx(0.1) and light.force_n[0, 2] < MOST_FORCE_N


def test_nothing_under_the_pad_is_refused(pad):
    with pytest.raises(SurfaceError, match="nothing lies under the pad"):
        press(pad, np.full_like(face(pad), NOWHERE_MM))
