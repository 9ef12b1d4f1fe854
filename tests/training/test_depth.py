import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay

from train.surfaces.depth_image import NOTHING_MM, Pose, Relief, depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, SURFACES, relief, surface_mesh

SIZE, CELL_MM = 42, 0.47
CENTRE = Pose(0, 0, 0)


def along_mm(size=SIZE, cell_mm=CELL_MM):
    return (np.arange(size) - (size - 1) / 2) * cell_mm


def ball(radius_mm):
    """A fine ball whose top is the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=radius_mm)
    return Relief("ball", mesh.apply_translation([0, 0, -radius_mm]))


def field(height, x_mm, y_mm):
    """A mesh of the function `height` over scattered points."""
    faces = Delaunay(np.stack([x_mm, y_mm], axis=1)).simplices
    return trimesh.Trimesh(np.stack([x_mm, y_mm, height(x_mm, y_mm)], axis=1), faces, process=False)


def scattered(half_mm, count, seed=0):
    rng = np.random.default_rng(seed)
    corners = half_mm * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    return np.concatenate([corners, rng.uniform(-half_mm, half_mm, (count, 2))]).T


def image(name, pose, size=41):
    return depth_image(relief(name), pose, size, 0.5) < FIGURE_HEIGHT_MM / 2


@pytest.mark.parametrize("angle_deg", [0, 37, 90])
def test_a_slope_is_exact_at_every_pixel(angle_deg):
    surface = Relief("slope", field(lambda x, y: 0.1 * x - 0.03 * y, *scattered(20, 500)))
    pose = Pose(1.3, -2.1, angle_deg)
    depth = depth_image(surface, pose, SIZE, CELL_MM)
    right, down = along_mm()[None, :], along_mm()[:, None]
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    height = 0.1 * (cosine * right + sine * down) - 0.03 * (sine * right - cosine * down)
    assert np.allclose(depth - depth.min(), height.max() - height, atol=1e-5)
    # First contact is at the footprint's corner, half a cell beyond the highest pixel.
    assert 0 <= depth.min() <= 0.13 * np.sqrt(2) * CELL_MM / 2


def test_a_dome_is_as_deep_as_a_sphere_wherever_it_stands():
    rng = np.random.default_rng(3)
    poses = [Pose(*rng.uniform(-1, 1, 2), rng.uniform(0, 360)) for _ in range(8)]
    dome = ball(8.0)
    for pose in poses:
        depth = depth_image(dome, pose, SIZE, CELL_MM)
        cosine, sine = np.cos(np.radians(pose.angle_deg)), np.sin(np.radians(pose.angle_deg))
        x_mm = pose.x_mm + cosine * along_mm()[None, :] + sine * along_mm()[:, None]
        y_mm = pose.y_mm + sine * along_mm()[None, :] - cosine * along_mm()[:, None]
        expected = 8 - np.sqrt(np.maximum(64 - x_mm**2 - y_mm**2, 0))
        cap = expected < 1
        assert np.abs(depth - expected)[cap].max() < 2e-3  # facets


def test_what_is_finer_than_a_cell_is_not_felt():
    slab = trimesh.creation.box([20, 20, 1])
    needle = trimesh.creation.box([0.2, 0.2, 3])
    seen = depth_image(Relief("needle", slab + needle), CENTRE, SIZE, CELL_MM)
    assert np.allclose(seen, 0, atol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
def test_the_image_shows_the_figures_area(name):
    mesh = surface_mesh(name)
    top = mesh.area_faces[(mesh.triangles[:, :, 2] > -1e-9).all(axis=1)].sum()
    seen = depth_image(Relief(name, mesh), Pose(0.03, 0.02, 20), 200, 0.1)
    assert (seen < FIGURE_HEIGHT_MM / 2).sum() * 0.1**2 == pytest.approx(top, rel=0.01)
    assert set(np.unique(seen.round(5))) <= {0.0, FIGURE_HEIGHT_MM, NOTHING_MM}


def test_a_pose_beside_the_surface_is_refused_by_name():
    with pytest.raises(ValueError, match=r"surface 'I' lies under the pad at Pose\(x_mm=50"):
        depth_image(relief("I"), Pose(50, 0, 0), SIZE, CELL_MM)


def test_a_letter_stands_upright_as_seen_through_the_pad():
    letter = image("F", CENTRE)
    assert letter[:20].sum() > letter[21:].sum()
    assert letter[:, :20].sum() > letter[:, 21:].sum()
