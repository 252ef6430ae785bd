"""Writing of dense clouds as PLY files (Turk 1994): positions, normals, colors and standard deviations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.meshes.ply import vertex_type

Columns = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Positions (n, 3), normals (n, 3), colors (n, 3) of 8 bits, and standard deviations (n,)."""


@checked
def write_cloud_ply(path: str | Path, chunks: Iterable[Columns], count: int) -> None:
    """Write a cloud that need not fit in memory as binary little-endian PLY.

    Coordinates are `float`, or `double` far from the origin (`vertex_type` of the first chunk that is not empty).

    Args:
        path: the file.
        chunks: columns of some points each.
        count: number of points of all chunks.

    Raises:
        ShapeError: the chunks do not have `count` points.
        WorkspaceError: the file cannot be written.
    """
    written, kind = 0, None
    with atomic_write(Path(path)) as part, part.open("wb") as stream:
        for xyz, normals, rgb, sigma in chunks:
            if not len(xyz):
                continue
            if kind is None:
                kind = _row_type(xyz)
                stream.write(_header(kind, count))
            rows = np.empty(len(xyz), kind)
            rows["xyz"], rows["normal"], rows["rgb"], rows["sigma"] = xyz, normals, rgb, sigma
            stream.write(rows.tobytes())
            written += len(rows)
        if kind is None:
            stream.write(_header(_row_type(np.zeros((0, 3))), count))
        if written != count:
            raise ShapeError(f"the chunks have {written} points, but count is {count}")


def _row_type(xyz: np.ndarray) -> np.dtype:
    coordinate = vertex_type(xyz)[0]["xyz"].base
    return np.dtype([("xyz", coordinate, 3), ("normal", "<f4", 3), ("rgb", "u1", 3), ("sigma", "<f4")])


def _header(kind: np.dtype, count: int) -> bytes:
    word = "double" if kind["xyz"].base.itemsize == 8 else "float"
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {word} {axis}" for axis in "xyz"]
    lines += [f"property float n{axis}" for axis in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += ["property float sigma", "end_header"]
    return "".join(f"{line}\n" for line in lines).encode("ascii")
