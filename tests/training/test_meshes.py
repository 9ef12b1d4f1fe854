import numpy as np
import pytest
import trimesh

from train.errors import MeshError
from train.surfaces.meshes import MAX_FILE_BYTES, load_mesh

AT_REST = [-5, -4, -3, 5, 4, 0]


def box(extents=(10.0, 8.0, 3.0), at=(20.0, -7.0, 11.0)):
    return trimesh.creation.box(extents).apply_translation(at)


def ascii_stl(mesh, name="part"):
    return mesh.export(file_type="stl_ascii").replace("solid ", f"solid {name}").encode("latin-1")


def binary_stl(triangles):
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False).export(file_type="stl")


def obj(mesh, head=""):
    return (head + mesh.export(file_type="obj", header=None)).encode("latin-1")


def ply(mesh, comment=""):
    head, _, body = mesh.export(file_type="ply", encoding="ascii").partition(b"element vertex")
    return head + f"comment {comment}\nelement vertex".encode("latin-1") + body


FILES = {
    "ascii.stl": ascii_stl(box()),
    "binary.STL": binary_stl(box().triangles),
    "part.obj": obj(box()),
    "ascii.ply": ply(box()),
    "binary.ply": box().export(file_type="ply", encoding="binary"),
}


def saved(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    return path


def refused(path, match, **options):
    with pytest.raises(MeshError, match=match) as error:
        load_mesh(path, **options)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("name", FILES)
def test_every_format_comes_to_rest_under_the_sensor(tmp_path, name):
    mesh = load_mesh(saved(tmp_path, name, FILES[name]))
    assert mesh.bounds.ravel() == pytest.approx(AT_REST)
    assert mesh.is_watertight
    assert len(mesh.vertices) == 8 and len(mesh.faces) == 12
    assert mesh.volume == pytest.approx(10 * 8 * 3)


def test_a_file_of_several_bodies_is_one_surface(tmp_path):
    left, right = box(at=(0, 0, 0)), box(at=(30, 0, -1))
    both = obj(left, "o left\n") + b"o right\n"
    both += "".join("v {} {} {}\n".format(*corner) for corner in right.vertices).encode()
    both += "".join("f {} {} {}\n".format(*(face + 9)) for face in right.faces).encode()
    solids = ascii_stl(left, "left") + ascii_stl(right, "right")
    for name, content in (("two.obj", both), ("two.stl", solids)):
        mesh = load_mesh(saved(tmp_path, name, content))
        assert mesh.bounds.ravel() == pytest.approx([-20, -4, -4, 20, 4, 0])
        assert mesh.volume == pytest.approx(2 * 10 * 8 * 3)
    along_an_edge = np.concatenate([left.triangles, box(at=(10, 8, 0)).triangles])
    assert load_mesh(saved(tmp_path, "touching.stl", binary_stl(along_an_edge))).volume == pytest.approx(2 * 10 * 8 * 3)


def test_old_encodings_and_absent_materials_are_no_fault(tmp_path, caplog):
    for name, content in (
        ("part.stl", ascii_stl(box(), "Prüfkörper")),
        ("part.obj", obj(box(), "o Prüfkörper\nmtllib absent.mtl\nusemtl gold\n")),
        ("part.ply", ply(box(), "Prüfkörper\ncomment TextureFile absent.png")),
    ):
        assert load_mesh(saved(tmp_path, name, content)).bounds.ravel() == pytest.approx(AT_REST)
    assert not caplog.records


def test_what_is_no_file_of_triangles_is_refused(tmp_path):
    refused(tmp_path / "absent.stl", "cannot be read: No such file")
    (tmp_path / "folder.stl").mkdir()
    refused(tmp_path / "folder.stl", "cannot be read")
    for name in ("part.step", "part.stl.gz", "part"):
        refused(saved(tmp_path, name, FILES["ascii.stl"]), r"unknown mesh format.*\.stl, \.obj, \.ply")
    for unit_mm in (0, -1, float("nan"), float("inf")):
        with pytest.raises(MeshError, match="--unit-mm is"):
            load_mesh(saved(tmp_path, "part.stl", FILES["ascii.stl"]), unit_mm)
    cloud = box()
    cloud.update_faces(np.zeros(12, dtype=bool))
    refused(saved(tmp_path, "cloud.ply", ply(trimesh.PointCloud(cloud.vertices))), "8 points but no triangles")


@pytest.mark.parametrize("name", FILES)
def test_a_cut_or_changed_file_is_refused_or_whole(tmp_path, name):
    whole, rng = FILES[name].rstrip(), np.random.default_rng(7)
    for length in range(0, len(whole) - 8, max(len(whole) // 60, 1)):
        path = saved(tmp_path, f"cut{name[-4:]}", whole[:length])
        refused(path, "no triangles|cut short or broken|is open|corners outside|flat|expected 1 to")
    for _ in range(60):
        content = np.frombuffer(FILES[name], dtype=np.uint8).copy()
        content[rng.integers(len(content), size=rng.integers(1, 8))] = rng.integers(256, dtype=np.uint8)
        path = saved(tmp_path, f"changed{name[-4:]}", content.tobytes())
        try:
            mesh = load_mesh(path)
        except MeshError as error:
            assert "\n" not in str(error)
        else:
            assert mesh.bounds[1, 2] == 0 and np.isfinite(mesh.bounds).all()


def test_a_mesh_that_is_no_closed_body_is_refused(tmp_path):
    corners = box().triangles.copy()
    corners[3, 1, 2] = np.nan
    refused(saved(tmp_path, "nan.stl", binary_stl(corners)), "1 of 12 triangles.*not finite numbers")
    for corner in (8, -1):
        sick = box()
        sick.faces[5, 0] = corner
        refused(saved(tmp_path, "sick.ply", ply(sick)), "broken")
    lidless = box()
    lidless.update_faces(lidless.face_normals[:, 2] < 0.5)
    refused(saved(tmp_path, "open.stl", binary_stl(lidless.triangles)), "open, 4 of its edges.*fill_holes")
    sheet = box((10, 8, 0))
    refused(saved(tmp_path, "sheet.stl", binary_stl(sheet.triangles)), "flat, a sheet.*10 x 8 x 0 mm.*extrude")
    sheet.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    refused(saved(tmp_path, "tilted.stl", binary_stl(sheet.triangles)), "flat")
    assert load_mesh(saved(tmp_path, "plate.stl", binary_stl(box((100, 80, 0.1)).triangles))).is_watertight


def test_an_impossible_size_says_the_size_and_the_unit(tmp_path):
    for extent_mm in (1.001, 499.9):
        load_mesh(saved(tmp_path, "fits.stl", binary_stl(box((extent_mm, extent_mm / 2, extent_mm / 3)).triangles)))
    big = saved(tmp_path, "big.stl", binary_stl(box((501, 8, 3)).triangles))
    refused(big, "501 x 8 x 3 mm, expected 1 to 500 mm; .*pass --unit-mm 1000 if it is in metres")
    metres = saved(tmp_path, "metres.stl", binary_stl(box((0.02, 0.02, 0.002), at=(0, 0, 0)).triangles))
    refused(metres, "0.02 x 0.02 x 0.002 mm, expected 1 to 500 mm; .*if it is in metres")
    refused(saved(tmp_path, "unit.stl", binary_stl(box().triangles)), "by --unit-mm 1000, expected 1 to", unit_mm=1000)
    path = saved(tmp_path, "huge.stl", b"")
    with path.open("r+b") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    refused(path, "100 MB; at most 100 MB are read: save it as a binary file, or reduce the mesh")
