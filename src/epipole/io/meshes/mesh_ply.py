"""Reading and writing triangle meshes as PLY files (Turk 1994)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole._checks import checked
from epipole.errors import FileFormatError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, open_file
from epipole.io.meshes.ply import MAX_HEADER, PlyHeader, ply_header, points_of_ply, vertex_type

FIRST_VIEW = "comment epipole first view, position, target and up:"
_NO_SURFACE = ("vertex", "edge", "camera", "material")
"""Elements without triangles."""
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


@checked
def write_mesh_ply(
    path: str | Path,
    vertices: Float64[np.ndarray, "n 3"],
    faces: Int64[np.ndarray, "m 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    first_view: Float64[np.ndarray, "3 3"] | None = None,
) -> None:
    """Write triangles (m, 3) between vertices (n, 3) with colors (n, 3), 0 to 255, as binary little-endian PLY.

    A comment of the header keeps `first_view`, rows of position, target and up, from which the viewer shows the mesh.
    Coordinates far from the origin are written as doubles (`vertex_type`).

    Raises:
        ShapeError: the arrays do not match, or a triangle refers to a missing vertex.
        WorkspaceError: the file cannot be written.
    """
    n, m = len(vertices), len(faces)
    if m and not (faces.min() >= 0 and faces.max() < n):
        raise ShapeError("a triangle refers to a missing vertex")
    kind, properties = vertex_type(vertices)
    corners, triangles = np.zeros(n, kind), np.zeros(m, _FACE)
    corners["xyz"], corners["rgb"] = vertices, rgb
    triangles["count"], triangles["vertices"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0"]
    if first_view is not None:
        header.append(f"{FIRST_VIEW} {' '.join(f'{value:.9g}' for value in first_view.ravel())}")
    header += [f"element vertex {n}", *properties]
    header += [f"element face {m}", "property list uchar int vertex_indices", "end_header"]
    with atomic_write(Path(path)) as part, part.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in header).encode("ascii"))
        stream.write(corners.tobytes())
        stream.write(triangles.tobytes())


def first_view_of_mesh(path: Path) -> Float64[np.ndarray, "3 3"] | None:
    """Rows of position, target and up that `write_mesh_ply` has written; None for other files.

    Raises:
        FileFormatError: there is no such file.
    """
    with open_file(path) as stream:
        head = stream.read(MAX_HEADER).split(b"end_header", 1)[0].decode("ascii", "replace")
    line = next((line for line in head.splitlines() if line.startswith(FIRST_VIEW)), "")
    try:
        values = np.array(line.removeprefix(FIRST_VIEW).split(), np.float64)
    except ValueError:
        return None
    if values.size != 9 or not np.isfinite(values).all():
        return None
    position, target, up = view = values.reshape(3, 3)
    return view if np.linalg.norm(np.cross(target - position, up)) > 0 else None


@dataclass(frozen=True, slots=True, eq=False)
class PlyMesh:
    """The vertices and triangles of a PLY file."""

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None
    """None if the file has no colors."""
    faces: Int64[np.ndarray, "m 3"]
    """Empty for a file of points."""

    def __repr__(self) -> str:
        return f"PlyMesh({len(self.xyz)} vertices, {len(self.faces)} triangles)"


@checked
def read_mesh_ply(path: str | Path) -> PlyMesh:
    """Read vertices and faces of a PLY file, text or binary; polygons become triangle fans from their first corner.

    Raises:
        FileFormatError: not a PLY file, without x, y, z, truncated, or a face refers to a missing vertex.
    """
    path = Path(path)
    data = file_bytes(path)
    header = ply_header(path, data)
    _require_no_other_surface(path, header)
    points = points_of_ply(path, data, header)
    corners = _corners(path, data, header)
    faces = np.concatenate([np.zeros((0, 3), np.int64), *(_fans(polygons) for polygons in corners)])
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(points)):
        raise FileFormatError(path, "a face refers to a missing vertex")
    return PlyMesh(points.xyz, points.rgb, faces)


def _require_no_other_surface(path: Path, header: PlyHeader) -> None:
    """Check that all surfaces can be read; triangle strips, and faces not right after the vertices, are not supported.

    Raises:
        FileFormatError: the file has an unsupported surface.
    """
    for name, count in header.elements:
        if count == 0 or name in _NO_SURFACE or (name == "face" and header.num_faces):
            continue
        problem = (
            "the faces must come directly after the vertices"
            if name == "face"
            else f"the element {name} is not supported"
        )
        raise FileFormatError(path, f"{problem}: save the mesh with vertices and faces only")


def _fans(polygons: np.ndarray) -> np.ndarray:
    """Triangle fans from the first corner of polygons (m, k)."""
    k = polygons.shape[1]
    first = np.repeat(polygons[:, :1], max(k - 2, 0), axis=1)
    return (
        np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2).reshape(-1, 3)
        if k > 2
        else np.zeros((0, 3), np.int64)
    )


def _corners(path: Path, data: bytes, header: PlyHeader) -> list[np.ndarray]:
    """Polygons (m, k) grouped by number of corners; empty for a file without faces.

    Raises:
        FileFormatError: the faces are truncated, or in an unsupported form.
    """
    if not header.num_faces:
        return []
    if len(header.face_types) != 1 or len(header.face_types[0]) != 2:
        raise FileFormatError(path, "the faces must have exactly one property, a list of corners")
    if any(kind.startswith("f") for kind in header.face_types[0]):
        raise FileFormatError(path, "the corners of the faces are not integers")
    if not header.byte_order:
        return _text_corners(path, data, header)
    count_type, corner_type = (np.dtype(header.byte_order + kind) for kind in header.face_types[0])
    start = header.size + header.num_vertices * header.vertex_bytes
    if start + count_type.itemsize > len(data):
        raise FileFormatError(path, "the file ends before its faces")
    k = int(np.frombuffer(data, count_type, 1, start)[0])
    # In nearly all files, all polygons have the same size: read them at once.
    if k >= 0 and header.num_faces * (count_type.itemsize + k * corner_type.itemsize) <= len(data) - start:
        kind = np.dtype([("count", count_type), ("corners", corner_type, (k,))])
        rows = np.frombuffer(data, kind, header.num_faces, start)
        if (rows["count"] == k).all():
            return [rows["corners"].astype(np.int64)]
    return _mixed_corners(path, data, header, start, count_type, corner_type)


def _mixed_corners(
    path: Path, data: bytes, header: PlyHeader, start: int, count_type: np.dtype, corner_type: np.dtype
) -> list[np.ndarray]:
    by_size: dict[int, list[np.ndarray]] = {}
    for _ in range(header.num_faces):
        room = len(data) - start - count_type.itemsize
        k = int(np.frombuffer(data, count_type, 1, start)[0]) if room >= 0 else -1
        start += count_type.itemsize
        if not 0 <= k * corner_type.itemsize <= room:
            raise FileFormatError(path, "the file ends within its faces")
        by_size.setdefault(k, []).append(np.frombuffer(data, corner_type, k, start))
        start += k * corner_type.itemsize
    return [np.stack(rows).astype(np.int64) for rows in by_size.values()]


def _text_corners(path: Path, data: bytes, header: PlyHeader) -> list[np.ndarray]:
    lines = [line for line in data[header.size :].split(b"\n") if line.strip()]
    by_size: dict[int, list[list[int]]] = {}
    for line in lines[header.num_vertices : header.num_vertices + header.num_faces]:
        try:
            numbers = [int(word) for word in line.split()]
            k = numbers[0]
        except (ValueError, IndexError) as error:
            raise FileFormatError(path, f"invalid face {line[:60]!r}") from error
        if k < 0 or len(numbers) < k + 1 or max(map(abs, numbers)) >= 2**63:
            raise FileFormatError(path, f"invalid face {line[:60]!r}")
        by_size.setdefault(k, []).append(numbers[1 : k + 1])
    if sum(map(len, by_size.values())) < header.num_faces:
        raise FileFormatError(path, f"the file ends before the last of {header.num_faces} faces")
    return [np.array(rows, np.int64).reshape(len(rows), k) for k, rows in by_size.items()]
