"""Users' mesh files as surfaces to tap: read, checked, and moved under the sensor."""

from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from train.errors import MeshError

MESH: Final = "mesh:"  # beginning of a surface's name that is a user's file
_UNIT: Final = "?unit_mm="
SUFFIXES: Final = (".stl", ".obj", ".ply")
MAX_FILE_BYTES: Final = 100_000_000  # two million triangles of a binary STL; a longer one would fill the memory
_TO_ASCII: Final = bytes(range(128)) + b"?" * 128


def mesh_name(path: Path, unit_mm: float = 1.0) -> str:
    """Return the name of a user's file as a surface, which states its unit in [mm] where that is not 1."""
    return f"{MESH}{path.resolve()}" + (f"{_UNIT}{unit_mm:g}" if unit_mm != 1 else "")


def mesh_file(name: str) -> tuple[Path, float]:
    """Return the file in a name of `mesh_name`, and its unit in [mm]."""
    path, stated, unit = name.removeprefix(MESH).rpartition(_UNIT)
    try:
        return (Path(path), float(unit)) if stated else (Path(unit), 1.0)
    except ValueError:
        return Path(name.removeprefix(MESH)), 1.0


def size_of(name: str) -> str:
    """Return a line with the size that is taken of the file in a name."""
    path, unit_mm = mesh_file(name)
    unit = "taken as in mm (commands with --unit-mm take other units)" if unit_mm == 1 else f"by --unit-mm {unit_mm:g}"
    return f"{path.name}: {_sides(load_mesh(path, unit_mm).extents)}, {unit}"


def load_mesh(path: Path, unit_mm: float = 1.0) -> trimesh.Trimesh:
    """Read an STL, OBJ or PLY file as a closed surface in [mm]: z up as it stands, top at z = 0, centred on x = y = 0.

    Several bodies are taken together. MeshError if it is absent, broken, empty, open, flat, or of an impossible size.
    """
    if not (isfinite(unit_mm) and unit_mm > 0):
        raise MeshError(f"--unit-mm is {unit_mm:g}; it must be a length above 0, such as 1000 for a file in metres")
    corners, faces = _read(path)
    corners = corners * unit_mm
    _check_size(path, corners[faces].reshape(-1, 3), unit_mm)
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.merge_vertices(digits_vertex=4)  # no press resolves a tenth of a micrometre
    a, b, c = mesh.faces.T
    mesh.update_faces((a != b) & (b != c) & (c != a))  # triangles that merging shut
    mesh.remove_unreferenced_vertices()
    if count := _open_edges(mesh.faces):
        raise MeshError(
            f"{path}: the mesh is open, {count} of its edges bound a hole or overlap; "
            "close it in a mesh editor (make solid, fill holes) or with trimesh.repair.fill_holes"
        )
    low, high = mesh.bounds
    mesh.apply_translation([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -high[2]])
    return mesh


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return finite corners (n, 3) in the file's unit, and at least one triangle (m, 3) between them."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: unknown mesh format {suffix!r}; save it as one of {', '.join(SUFFIXES)}")
    try:
        if (size := path.stat().st_size) > MAX_FILE_BYTES:
            raise MeshError(
                f"{path}: {size / 1e6:.0f} MB; at most {MAX_FILE_BYTES / 1e6:.0f} MB are read: "
                "save it as a binary file, or reduce the mesh"
            )
        content = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read: {error.strerror}; give the path of a mesh file") from error
    corners, faces = _parse(path, content, suffix)
    if not len(faces):
        held = f"{len(corners)} points but no triangles" if len(corners) else "no triangles"
        raise MeshError(f"{path}: the file holds {held} (empty, cut short, or not a mesh); save it as a closed mesh")
    if faces.min() < 0 or faces.max() >= len(corners):
        raise MeshError(f"{path}: broken: triangles name corners outside the {len(corners)} there are; save it again")
    if bad := int((~np.isfinite(corners[faces]).all(axis=(1, 2))).sum()):
        raise MeshError(f"{path}: {bad} of {len(faces)} triangles have corners that are not finite numbers; repair it")
    return corners, faces


def _parse(path: Path, content: bytes, suffix: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return all bodies of a file side by side; a point cloud has corners without triangles."""
    try:
        # Parsed from bytes and without materials, so that a mesh file cannot make the program open other files.
        scene = trimesh.load_scene(
            BytesIO(_legible(content, suffix)), file_type=suffix[1:], process=False, skip_materials=True
        )
        corners, faces, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], 0
        for body in scene.geometry.values():
            corners.append(np.asarray(body.vertices, dtype=np.float64).reshape(-1, 3))
            faces.append(np.asarray(getattr(body, "faces", faces[0]), dtype=np.int64).reshape(-1, 3) + count)
            count += len(corners[-1])
    except Exception as error:  # a parser raises any exception on a broken file, and each means that the file is broken
        raise MeshError(f"{path}: no {suffix[1:].upper()} file, or one cut short or broken; save it again") from error
    return np.concatenate(corners), np.concatenate(faces)


def _legible(content: bytes, suffix: str) -> bytes:
    """Return the file with all its text in ASCII, so that a name in an old encoding does not make it unreadable."""
    if suffix == ".ply":
        header, end, body = content.partition(b"end_header")
        return header.translate(_TO_ASCII) + end + body
    is_binary = suffix == ".stl" and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    return content if is_binary else content.translate(_TO_ASCII)


def _check_size(path: Path, corners: NDArray[np.float64], unit_mm: float) -> None:
    """Refuse a sheet, and a size of which the unit is more likely wrong than the part."""
    extent_mm = np.ptp(corners, axis=0)
    sides = _sides(extent_mm)
    size = f"{path}: {sides}" + ("" if unit_mm == 1.0 else f" by --unit-mm {unit_mm:g}")
    if not 1 <= extent_mm.max() <= 500:
        raise MeshError(
            f"{size}, expected 1 to 500 mm; a file is taken to be in mm: pass --unit-mm 1000 if it is in metres, "
            "25.4 if in inches, else cut out a part"
        )
    spreads = np.linalg.eigvalsh(np.cov(corners, rowvar=False))
    # A sheet is thinner than a hundred times the rounding of single precision.
    if spreads[0] <= 1e-5**2 * spreads[-1]:
        raise MeshError(f"{path}: flat, a sheet without thickness ({sides}); extrude it to a closed body")


def _sides(extent_mm: NDArray[np.float64]) -> str:
    return f"{' x '.join(f'{side:.4g}' for side in extent_mm)} mm"


def _open_edges(faces: NDArray[np.int64]) -> int:
    """Count edges with an odd number of triangles: 0 for closed bodies, even if they touch along an edge."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(ends[:, 0] * (faces.max() + 1) + ends[:, 1], return_counts=True)
    return int((counts % 2).sum())
