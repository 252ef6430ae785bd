"""Reading and writing point clouds, and scenes with cameras, as PLY files (Turk 1994)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import as_image, as_points, checked, require_same_length
from epipole.errors import FileFormatError, ShapeError
from epipole.io._bytes import ByteReader
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, open_file
from epipole.io.meshes._ply_colors import ply_colors
from epipole.scene import Georeference, Reconstruction

CAMERA_RGB = (230, 60, 40)
"""Color of the camera frustums."""
CAMERA_SIZE = 0.3
"""Depth of a frustum as a fraction of the median distance from a camera to its nearest neighbor."""

_EDGE = np.dtype([("vertices", "<i4", 2), ("rgb", "u1", 3)])
_LARGEST_ROUNDING = 1e-6
"""Largest single-precision rounding, as a fraction of the points' spread; beyond, coordinates are doubles."""
_FEW, _ROUNDING_OF_FEW = 10, 1e-6
"""Below this number of points, the spread is not meaningful; largest rounding in that case."""
_EDGE_HEADER = ("int vertex1", "int vertex2", "uchar red", "uchar green", "uchar blue")
SCENE_COMMENT = "comment epipole scene, +z up: points, then five corners and eight edges of each camera"
"""Header comment of `write_scene_ply`, by which epipole's viewer recognizes the cameras."""
# Vertex 0 is the camera center, 1 to 4 are the image corners in order.
_FRUSTUM_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
ORIGIN_COMMENT = "comment epipole origin of x east, y north, z up in meters:"
_IGNORED_LINES = ("comment", "obj_info", "ply")
MAX_HEADER = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class PlyPoints:
    """The vertices of a PLY file."""

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None
    """None if the file has no colors."""

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        return f"PlyPoints({len(self)}, {'no' if self.rgb is None else 'with'} colors)"


@checked
def vertex_type(xyz: Float64[np.ndarray, "n 3"]) -> tuple[np.dtype, list[str]]:
    """Storage type of vertices (n, 3) with colors, and its header lines.

    Coordinates are `float`, or `double` if single precision rounds them by more than a millionth of their spread: for
    points far from the origin, such as UTM, `float` has a resolution of 0.25 to 0.5 m. For fewer than ten points, whose
    spread is not meaningful, rounding by up to 1e-6 is allowed.
    """
    points = xyz[np.isfinite(xyz).all(axis=1)].astype(np.float64)
    kind, word = "<f4", "float"
    if len(points):
        with np.errstate(over="ignore", invalid="ignore"):
            rounding = np.abs(points.astype(np.float32) - points).max(axis=1)
        spread = float(np.median(np.abs(points - np.median(points, axis=0)).max(axis=1)))
        allowed = _LARGEST_ROUNDING * spread if len(points) >= _FEW else _ROUNDING_OF_FEW
        if np.median(rounding) > allowed:
            kind, word = "<f8", "double"
    header = [f"property {word} {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    return np.dtype([("xyz", kind, 3), ("rgb", "u1", 3)]), header


@checked
def write_points_ply(path: str | Path, xyz: Any, rgb: Any) -> None:
    """Write points (n, 3) with colors (n, 3), 0 to 255, as binary little-endian PLY, in the precision of `vertex_type`.

    Raises:
        ShapeError: the arrays do not match.
        WorkspaceError: the file cannot be written.
    """
    xyz, rgb = _points_and_colors(xyz, rgb)
    _write(Path(path), xyz, rgb, np.empty(0, _EDGE))


@checked
def write_scene_ply(path: str | Path, reconstruction: Reconstruction) -> None:
    """Write the points, and a frustum for each registered camera as edges; a comment has the position of the origin on Earth, if it is known.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    points = reconstruction.points
    corners = _frustums_in_world(reconstruction)
    frustum_rgb = np.broadcast_to(np.array(CAMERA_RGB, np.uint8), (5 * len(corners), 3))
    xyz = np.concatenate([points.xyz_in_world, corners.reshape(-1, 3)])
    rgb = np.concatenate([points.rgb, frustum_rgb])
    first = len(points) + 5 * np.arange(len(corners))
    edges = np.empty(len(corners) * len(_FRUSTUM_EDGES), _EDGE)
    edges["vertices"] = (first[:, None, None] + _FRUSTUM_EDGES).reshape(-1, 2)
    edges["rgb"] = CAMERA_RGB
    _write(Path(path), xyz, rgb, edges, (SCENE_COMMENT, *_origin_comment(reconstruction.georeference)))


def _origin_comment(origin: Georeference | None) -> tuple[str, ...]:
    if origin is None:
        return ()
    return (
        f"{ORIGIN_COMMENT} latitude {origin.lat_deg:.10f} longitude {origin.lon_deg:.10f} degrees (WGS84), "
        f"altitude {origin.alt_m:.4f} m",
    )


@checked
def num_cameras_of_scene(path: str | Path) -> int | None:
    """Number of cameras in a file written by `write_scene_ply`; None for other files.

    Raises:
        FileFormatError: there is no such file.
    """
    with open_file(Path(path)) as stream:
        head = stream.read(MAX_HEADER).split(b"end_header", 1)[0].decode("ascii", "replace").splitlines()
    if SCENE_COMMENT not in head:
        return None
    edges = next((line.split()[-1] for line in head if line.startswith("element edge ")), "0")
    return int(edges) // len(_FRUSTUM_EDGES) if edges.isdigit() else 0


@checked
def frustum_segments(corners: Float64[np.ndarray, "n 5 3"]) -> Float64[np.ndarray, "m 2 3"]:
    """The line segments of frustums, from their centers and image corners."""
    return corners[:, _FRUSTUM_EDGES].reshape(-1, 2, 3)


def _points_and_colors(xyz: Any, rgb: Any) -> tuple[np.ndarray, np.ndarray]:
    xyz, rgb = as_points(xyz, "xyz", 3), np.atleast_1d(as_image(rgb, "rgb"))
    require_same_length(xyz=xyz, rgb=rgb)
    if rgb.dtype != np.uint8 or rgb.shape != xyz.shape:
        raise ShapeError(f"rgb must be (n, 3) of type uint8, got {rgb.shape} of type {rgb.dtype}")
    return xyz, rgb


def _frustums_in_world(reconstruction: Reconstruction) -> Float64[np.ndarray, "n 5 3"]:
    """Center and image corners of every registered camera; distortion is ignored."""
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
    """A length that keeps neighboring frustums apart; with a single camera, derived from the distance to the points."""
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


def _write(
    path: Path, xyz: np.ndarray, rgb: np.ndarray, edges: np.ndarray, comments: tuple[str, ...] = ()
) -> None:
    kind, properties = vertex_type(xyz)
    vertices = np.empty(len(xyz), kind)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    lines += [f"element vertex {len(vertices)}", *properties]
    if len(edges):
        lines += [f"element edge {len(edges)}", *(f"property {line}" for line in _EDGE_HEADER)]
    header = "".join(f"{line}\n" for line in [*lines, "end_header"])
    with atomic_write(path) as part, part.open("wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(edges.tobytes())


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The content of a file's header."""

    byte_order: str
    """Empty for a text file."""
    num_vertices: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    num_faces: int
    """0 unless faces come directly after the vertices."""
    face_types: tuple[tuple[str, ...], ...]
    """For each property of a face: its type, or the types of the count and the items for a list."""
    size: int
    elements: tuple[tuple[str, int], ...] = ()
    """Names and counts of all elements, in file order."""

    @property
    def vertex_bytes(self) -> int:
        """Size of a vertex in a binary file."""
        return sum(np.dtype(kind).itemsize for kind in self.types)


@checked
def read_points_ply(path: str | Path) -> PlyPoints:
    """Read the vertices of a PLY file, text or binary, with their colors if there are any.

    Other vertex properties (normals, intensities, labels) and elements after the vertices are ignored.

    Raises:
        FileFormatError: not a PLY file, an invalid header line, no x, y, z, or a truncated file.
    """
    path = Path(path)
    data = file_bytes(path)
    return points_of_ply(path, data, ply_header(path, data))


@checked
def points_of_ply(path: Path, data: bytes, header: PlyHeader) -> PlyPoints:
    """The vertices in a file's bytes.

    Raises:
        FileFormatError: they have no x, y, z, or are truncated.
    """
    columns = _columns(path, data, header)
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise FileFormatError(path, f"the vertices have no {', '.join(missing)}")
    xyz = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    return PlyPoints(xyz, ply_colors(path, columns))


@checked
def ply_columns(path: Path) -> dict[str, np.ndarray]:
    """The vertices of a PLY file, by property.

    Raises:
        FileFormatError: not a PLY file, or truncated.
    """
    data = file_bytes(path)
    return _columns(path, data, ply_header(path, data))


def _columns(path: Path, data: bytes, header: PlyHeader) -> dict[str, np.ndarray]:
    return _binary_columns(path, data, header) if header.byte_order else _text_columns(path, data, header)


@checked
def ply_header(path: Path, data: bytes) -> PlyHeader:
    """Parse the header of a PLY file.

    Raises:
        FileFormatError: not a PLY file, the vertices do not come first, or a header line is invalid.
    """
    end = data.find(b"end_header", 0, MAX_HEADER)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise FileFormatError(
            path, "not a PLY file (no header from 'ply' to 'end_header'); export or copy it again"
        )
    lines = data[:end].decode("ascii", "replace").splitlines()
    byte_order: str | None = None
    elements: list[tuple[str, int]] = []
    names: list[str] = []
    types: list[str] = []
    face_types: list[tuple[str, ...]] = []
    is_orphan = False
    for number, line in enumerate(lines[1:], 2):
        words = line.split()
        element = elements[-1][0] if elements else ""
        try:
            if words[:1] == ["format"] and byte_order is None and words[2:] == ["1.0"]:
                byte_order = "" if words[1] == "ascii" else _BYTE_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                _add_element(elements, words)
            elif words[:1] == ["property"] and element == "vertex":
                _, kind, name = words
                types.append(PLY_TYPES[kind])
                names.append(name)
            elif words[:1] == ["property"] and element == "face" and _is_behind_vertices(elements):
                kinds = words[2:4] if words[1] == "list" else words[1:2]
                face_types.append(tuple(PLY_TYPES[kind] for kind in kinds))
            elif words[:1] == ["property"]:
                is_orphan |= not elements
            else:
                _require_ignorable(words)
        except _HeaderError as error:
            problem = f"line {number}: invalid header line {line[:60]!r} ({error})"
            raise FileFormatError(path, problem) from error
        except (KeyError, IndexError, ValueError) as error:
            raise FileFormatError(path, f"line {number}: invalid header line {line[:60]!r}") from error
    if is_orphan:
        raise FileFormatError(path, "invalid header: a property precedes all elements")
    num_vertices = dict(elements).get("vertex", -1)
    if byte_order is None or num_vertices < 0 or not names or len(set(names)) < len(names):
        raise FileFormatError(path, "the header does not describe vertices")
    num_faces = dict(elements)["face"] if face_types else 0
    return PlyHeader(
        byte_order,
        num_vertices,
        tuple(names),
        tuple(types),
        num_faces,
        tuple(face_types),
        newline + 1,
        tuple(elements),
    )


class _HeaderError(ValueError):
    """Why a header line is invalid."""


def _require_ignorable(words: list[str]) -> None:
    if words and words[0] not in _IGNORED_LINES:
        raise _HeaderError("unknown keyword")


def _add_element(elements: list[tuple[str, int]], words: list[str]) -> None:
    _, name, count = words
    if int(count) < 0 or name in dict(elements):
        raise _HeaderError("a negative count, or a duplicate element")
    if name != "vertex" and int(count) > 0 and "vertex" not in dict(elements):
        raise _HeaderError("the vertices must come first")
    elements.append((name, int(count)))


def _is_behind_vertices(elements: list[tuple[str, int]]) -> bool:
    """Whether the last element comes directly after the vertices, ignoring empty elements."""
    filled = [name for name, count in elements[:-1] if count > 0 or name == "vertex"]
    return filled == ["vertex"]


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
            raise FileFormatError(path, f"the vertex property {name} has values that are not integers")
        columns[name] = column if kind.startswith("f") else column.astype(np.int64)
    return columns
