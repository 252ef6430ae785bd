"""Point clouds and whole scenes as PLY files (Turk 1994)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import as_picture, as_points, require_same_length
from epipole._declared import checked
from epipole.errors import FileFormatError, ShapeError
from epipole.io._bytes import ByteReader
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, open_file
from epipole.scene import Reconstruction

CAMERA_RGB = (230, 60, 40)
"""Colour of the drawn cameras."""
CAMERA_SIZE = 0.3
"""Depth of a drawn camera as a share of the median distance from a camera to the nearest other one."""

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_EDGE = np.dtype([("vertices", "<i4", 2), ("rgb", "u1", 3)])
_VERTEX_HEADER = ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
_EDGE_HEADER = ("int vertex1", "int vertex2", "uchar red", "uchar green", "uchar blue")
SCENE_COMMENT = "comment epipole scene, +z up: points, then five corners and eight edges of each camera"
"""Of `write_scene_ply`: a viewer of ours draws the cameras as such."""
# Vertex 0 is the centre, 1 to 4 the corners of the picture in turn.
_FRUSTUM_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_COLOUR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_MAX_HEADER = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class PlyPoints:
    """The vertices of a PLY file."""

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None
    """None where the file has no colours."""

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        return f"PlyPoints({len(self)}, {'no' if self.rgb is None else 'with'} colours)"


@checked
def write_points_ply(path: str | Path, xyz: Any, rgb: Any) -> None:
    """Write points (n, 3) with colours (n, 3), 0 to 255, as binary little-endian PLY in single precision.

    Raises:
        ShapeError: the arrays do not fit.
        WorkspaceError: the file cannot be written.
    """
    _write(Path(path), _vertices(xyz, rgb), np.empty(0, _EDGE))


@checked
def write_scene_ply(path: str | Path, reconstruction: Reconstruction) -> None:
    """Write the points and, as edges, a pyramid for each registered camera.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    points = reconstruction.points
    corners = _frustums_in_world(reconstruction)
    frustum_rgb = np.broadcast_to(np.array(CAMERA_RGB, np.uint8), (5 * len(corners), 3))
    vertices = np.concatenate(
        [_vertices(points.xyz_in_world, points.rgb), _vertices(corners.reshape(-1, 3), frustum_rgb)]
    )
    first = len(points) + 5 * np.arange(len(corners))
    edges = np.empty(len(corners) * len(_FRUSTUM_EDGES), _EDGE)
    edges["vertices"] = (first[:, None, None] + _FRUSTUM_EDGES).reshape(-1, 2)
    edges["rgb"] = CAMERA_RGB
    _write(Path(path), vertices, edges, SCENE_COMMENT)


@checked
def num_cameras_of_scene(path: str | Path) -> int | None:
    """How many cameras a file of `write_scene_ply` holds; None of other files.

    Raises:
        FileFormatError: there is no such file.
    """
    with open_file(Path(path)) as stream:
        head = stream.read(_MAX_HEADER).split(b"end_header", 1)[0].decode("ascii", "replace").splitlines()
    if SCENE_COMMENT not in head:
        return None
    edges = next((line.split()[-1] for line in head if line.startswith("element edge ")), "0")
    return int(edges) // len(_FRUSTUM_EDGES) if edges.isdigit() else 0


@checked
def frustum_segments(corners: Float64[np.ndarray, "n 5 3"]) -> Float64[np.ndarray, "m 2 3"]:
    """The lines of drawn cameras, from their centres and the corners of their pictures."""
    return corners[:, _FRUSTUM_EDGES].reshape(-1, 2, 3)


def _vertices(xyz: Any, rgb: Any) -> np.ndarray:
    xyz, rgb = as_points(xyz, "xyz", 3), np.atleast_1d(as_picture(rgb, "rgb"))
    require_same_length(xyz=xyz, rgb=rgb)
    if rgb.dtype != np.uint8 or rgb.shape != xyz.shape:
        raise ShapeError(f"rgb must be (n, 3) of type uint8, got {rgb.shape} of type {rgb.dtype}")
    out = np.empty(len(xyz), _VERTEX)
    out["xyz"], out["rgb"] = xyz, rgb
    return out


def _frustums_in_world(reconstruction: Reconstruction) -> Float64[np.ndarray, "n 5 3"]:
    """Centre and picture corners of every registered camera; lens distortion is left out of the drawing."""
    cams_from_world, camera_of_image = reconstruction.cams_from_world(), reconstruction.camera_of_image
    registered = np.flatnonzero(np.isfinite(cams_from_world.translation).all(axis=1))
    depth = _frustum_depth(reconstruction, cams_from_world.centers()[registered])
    corners_in_world = np.empty((len(registered), 5, 3))
    for row, image in enumerate(registered):
        camera = reconstruction.cameras[int(camera_of_image[image])]
        right, bottom = camera.width - 0.5, camera.height - 0.5
        pixels = np.array([(-0.5, -0.5, 1), (right, -0.5, 1), (right, bottom, 1), (-0.5, bottom, 1)])
        in_cam = depth * np.concatenate([np.zeros((1, 3)), pixels @ np.linalg.inv(camera.K).T])
        corners_in_world[row] = cams_from_world[int(image)].inverse().apply(in_cam)
    return corners_in_world


def _frustum_depth(reconstruction: Reconstruction, centers: np.ndarray) -> float:
    """A length that keeps neighbouring cameras apart; without neighbours, by the distance to the points."""
    if len(centers) > 1:
        from scipy.spatial import cKDTree  # a sixth of a second to import, for a scene's cameras only

        nearest = cKDTree(centers).query(centers, k=2)[0][:, 1]
        depth = CAMERA_SIZE * float(np.median(nearest))
        if depth > 0:
            return depth
    if len(centers) and len(reconstruction.points):
        distance = np.linalg.norm(reconstruction.points.xyz_in_world - centers[0], axis=1)
        return 0.1 * float(np.median(distance))
    return 1.0


def _write(path: Path, vertices: np.ndarray, edges: np.ndarray, comment: str = "") -> None:
    lines = ["ply", "format binary_little_endian 1.0", *filter(None, [comment])]
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property {line}" for line in _VERTEX_HEADER]
    if len(edges):
        lines += [f"element edge {len(edges)}", *(f"property {line}" for line in _EDGE_HEADER)]
    header = "".join(f"{line}\n" for line in [*lines, "end_header"])
    with atomic_write(path) as part, part.open("wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(edges.tobytes())


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """What a file's header promises."""

    byte_order: str
    """Empty for a text file."""
    num_vertices: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    num_faces: int
    """0 unless faces follow the vertices at once."""
    face_types: tuple[tuple[str, ...], ...]
    """Of each property of a face: one type, or of a list those of the count and of its items."""
    size: int

    @property
    def vertex_bytes(self) -> int:
        """Of a vertex in a binary file."""
        return sum(np.dtype(kind).itemsize for kind in self.types)


@checked
def read_points_ply(path: str | Path) -> PlyPoints:
    """Read the vertices of a PLY file, text or binary, with their colours if there are any.

    Raises:
        FileFormatError: it is no PLY file, has no x, y, z, or is cut short.
    """
    path = Path(path)
    data = file_bytes(path)
    return points_of_ply(path, data, ply_header(path, data))


@checked
def points_of_ply(path: Path, data: bytes, header: PlyHeader) -> PlyPoints:
    """The vertices of a file's bytes.

    Raises:
        FileFormatError: they have no x, y, z, or are cut short.
    """
    columns = _columns(path, data, header)
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise FileFormatError(path, f"the vertices have no {', '.join(missing)}")
    xyz = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    return PlyPoints(xyz, _colours(columns))


@checked
def ply_columns(path: Path) -> dict[str, np.ndarray]:
    """The vertices of a PLY file, property by property.

    Raises:
        FileFormatError: it is no PLY file, or is cut short.
    """
    data = file_bytes(path)
    return _columns(path, data, ply_header(path, data))


def _columns(path: Path, data: bytes, header: PlyHeader) -> dict[str, np.ndarray]:
    return _binary_columns(path, data, header) if header.byte_order else _text_columns(path, data, header)


def _colours(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    names = next((names for names in _COLOUR_NAMES if all(name in columns for name in names)), None)
    if names is None:
        return None
    rgb = np.stack([columns[name] for name in names], axis=1)
    if rgb.dtype.kind == "f":
        rgb = np.nan_to_num(255.0 * rgb)  # colours that are no whole numbers run from 0 to 1
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8)


@checked
def ply_header(path: Path, data: bytes) -> PlyHeader:
    """What a file promises.

    Raises:
        FileFormatError: it is no PLY file, or its vertices do not come first.
    """
    end = data.find(b"end_header", 0, _MAX_HEADER)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise FileFormatError(path, "not a PLY file (no header from 'ply' to 'end_header')")
    byte_order, num_vertices, num_faces = None, -1, 0
    names: list[str] = []
    types: list[str] = []
    face_types: list[tuple[str, ...]] = []
    element, before = "", ""
    for number, line in enumerate(data[:end].decode("ascii", "replace").splitlines(), 1):
        words = line.split()
        try:
            if words[:1] == ["format"]:
                byte_order = "" if words[1] == "ascii" else _BYTE_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                before, element, count = element, words[1], int(words[2])
                if count < 0 or (num_vertices < 0 and element != "vertex" and count > 0):
                    raise FileFormatError(path, f"line {number}: the vertices must come first: {line[:60]!r}")
                num_vertices = count if element == "vertex" else num_vertices
                num_faces = count if (before, element) == ("vertex", "face") else num_faces
            elif words[:1] == ["property"] and element == "vertex":
                types.append(PLY_TYPES[words[1]])
                names.append(words[2])
            elif words[:1] == ["property"] and (before, element) == ("vertex", "face"):
                kinds = words[2:4] if words[1] == "list" else words[1:2]
                face_types.append(tuple(PLY_TYPES[kind] for kind in kinds))
        except (KeyError, IndexError, ValueError) as error:
            raise FileFormatError(path, f"line {number}: cannot be understood: {line[:60]!r}") from error
    if byte_order is None or num_vertices < 0 or not names or len(set(names)) < len(names):
        raise FileFormatError(path, "the header does not describe vertices")
    return PlyHeader(
        byte_order, num_vertices, tuple(names), tuple(types), num_faces, tuple(face_types), newline + 1
    )


def _binary_columns(path: Path, data: bytes, header: PlyHeader) -> dict[str, np.ndarray]:
    dtype = np.dtype([(name, header.byte_order + kind) for name, kind in zip(header.names, header.types)])
    reader = ByteReader(path, data)
    reader.position = header.size
    reader.require_room(header.num_vertices, dtype.itemsize, "vertices")
    vertices = reader.array(dtype, header.num_vertices, "the vertices")
    return {name: vertices[name] for name in header.names}


def _text_columns(path: Path, data: bytes, header: PlyHeader) -> dict[str, np.ndarray]:
    width = len(header.names)
    needed = header.num_vertices * width
    words = data[header.size :].split(maxsplit=needed)[:needed] if needed <= len(data) else []
    if len(words) < needed:
        raise FileFormatError(path, f"the file ends before the last of {header.num_vertices} vertices")
    try:
        table = np.array([float(word) for word in words]).reshape(-1, width)
    except ValueError as error:
        raise FileFormatError(path, f"the vertices are not all numbers: {error}") from error
    columns = {}
    for name, kind, column in zip(header.names, header.types, table.T):
        if not kind.startswith("f") and not (np.abs(column) < 2.0**53).all():
            raise FileFormatError(path, f"the vertices' {name} is not all whole numbers")
        columns[name] = column if kind.startswith("f") else column.astype(np.int64)
    return columns
