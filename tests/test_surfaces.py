import numpy as np
import pytest

from train.depth import NOTHING_MM, Pose, depth_image, depth_map
from train.surfaces import FIGURE_HEIGHT_MM, PLATE_MM, SURFACES, surface_mesh


def test_there_are_nine_letters_and_three_shapes_in_three_forms():
    assert len(SURFACES) == len(set(SURFACES)) == 18
    assert "".join(name for name in SURFACES if len(name) == 1) == "CFILOPSTU"


@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_is_closed_and_fits_its_plate(name):
    mesh = surface_mesh(name)
    assert mesh.is_watertight
    (left, front, _), (right, back, top) = mesh.bounds
    assert top == pytest.approx(0)
    assert right - left == pytest.approx(PLATE_MM)
    assert back - front == pytest.approx(PLATE_MM)


def test_an_unknown_surface_lists_the_known():
    with pytest.raises(ValueError, match="small triangle"):
        surface_mesh("Q")


@pytest.mark.parametrize("name", SURFACES)
def test_the_depth_map_shows_the_figures_area(name):
    figure = surface_mesh(name)
    top = figure.area_faces[(figure.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()
    seen = depth_map(figure)
    assert (seen.depth_mm < FIGURE_HEIGHT_MM / 2).sum() * 0.1**2 == pytest.approx(top, rel=0.03)
    assert set(np.unique(seen.depth_mm.round(3))) <= {0.0, FIGURE_HEIGHT_MM}


def image(name, pose, size=41):
    return depth_image(depth_map(surface_mesh(name)), pose, size, 0.5) < FIGURE_HEIGHT_MM / 2


def test_a_letter_stands_upright_as_seen_through_the_pad():
    letter = image("F", Pose(0, 0, 0))
    upper, lower = letter[:20], letter[21:]
    left, right = letter[:, :20], letter[:, 21:]
    assert upper.sum() > lower.sum()
    assert left.sum() > right.sum()


def test_moving_the_pad_right_moves_the_figure_left():
    centre = np.argwhere(image("small circle", Pose(3, 0, 0))).mean(axis=0) - 20
    assert centre == pytest.approx([0, -6], abs=0.6)
    centre = np.argwhere(image("small circle", Pose(0, 3, 0))).mean(axis=0) - 20
    assert centre == pytest.approx([6, 0], abs=0.6)  # up on the surface is towards lower rows, so it moves down


def test_turning_the_pad_a_quarter_turns_the_figure_back():
    upright, turned = image("L", Pose(0, 0, 0)), image("L", Pose(0, 0, 90))
    # Seen from above the pad turns counterclockwise, so the figure turns clockwise.
    assert (np.rot90(upright, -1) == turned).mean() > 0.99


def test_off_the_plate_there_is_nothing():
    assert (depth_image(depth_map(surface_mesh("I")), Pose(50, 0, 0), 11, 0.5) == NOTHING_MM).all()
