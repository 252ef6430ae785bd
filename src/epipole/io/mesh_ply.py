"""Triangles as PLY files (Turk 1994)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import ShapeError
from epipole.io.atomic import atomic_write

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_mesh_ply(path: str | Path, vertices: Any, faces: Any, rgb: Any) -> None:
    """Write triangles (m, 3) between vertices (n, 3) with colours (n, 3), 0 to 255, as binary little-endian PLY in single precision.

    Raises:
        ShapeError: the arrays do not fit, or a triangle names a vertex that is not there.
        WorkspaceError: the file cannot be written.
    """
    vertices, faces, rgb = np.asarray(vertices), np.asarray(faces), np.asarray(rgb)
    n, m = len(vertices), len(faces)
    if vertices.shape != (n, 3) or rgb.shape != (n, 3) or faces.shape != (m, 3):
        raise ShapeError("a mesh has vertices (n, 3), triangles (m, 3) and colours (n, 3)")
    if m and not (faces.min() >= 0 and faces.max() < n):
        raise ShapeError("a triangle names a vertex that is not there")
    corners, triangles = np.zeros(n, _VERTEX), np.zeros(m, _FACE)
    corners["xyz"], corners["rgb"] = vertices, rgb
    triangles["count"], triangles["vertices"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {m}", "property list uchar int vertex_indices", "end_header"]
    with atomic_write(Path(path)) as part, part.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in header).encode("ascii"))
        stream.write(corners.tobytes())
        stream.write(triangles.tobytes())
