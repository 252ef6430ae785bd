"""Textured triangles as few bytes for a page that is a file.

Positions are quantized to 16 bits, texture coordinates to 14, and stored as differences from the previous corner, by
bytes of the same significance. Corners are in the order in which the triangles use them first, and an index is stored as
its distance from the lowest unused one (Chun, WebGL Models: End-to-End, in OpenGL Insights, 2012, chapter 30). The zlib
format (RFC 1950) compresses the result; `space_mesh.js` unpacks it.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

STEPS, UV_STEPS = 65535, 16383
"""Quantization steps of the range of a column."""


class PackedMesh(NamedTuple):
    """A mesh as bytes, and the numbers needed to unpack it."""

    data: bytes
    num_corners: int
    low: list[float]
    """Of x, y, z and the two texture coordinates."""
    step: list[float]


def packed_mesh(columns: Float64[np.ndarray, "c 5"], triangles: Int64[np.ndarray, "m 3"]) -> PackedMesh:
    """Pack corners (x, y, z and two texture coordinates) and the triangles between them, in this order."""
    corners = triangles.ravel()
    used, first = np.unique(corners, return_index=True)
    order = used[np.argsort(first, kind="stable")]
    row = np.zeros(len(columns), np.int64)
    row[order] = np.arange(len(order))
    index = row[corners]
    low, high = columns[order].min(axis=0), columns[order].max(axis=0)
    repeats = (high - low)[3:].max() > 1.0
    steps = np.array([STEPS] * 3 + [STEPS if repeats else UV_STEPS] * 2)
    step = np.where(high > low, (high - low) / steps, 1.0)
    values = np.rint((columns[order] - low) / step).astype(np.int64)
    differences = np.diff(values, axis=0, prepend=0)
    differences = (differences + 32768) % 65536 - 32768
    zigzag = (differences << 1 ^ differences >> 15) & 65535
    unused = np.concatenate([[0], np.maximum.accumulate(index)[:-1] + 1])
    planes = [zigzag[:, k] >> shift & 255 for k in range(5) for shift in (0, 8)]
    planes += [unused - index >> shift & 255 for shift in (0, 8, 16, 24)]
    data = zlib.compress(np.concatenate(planes).astype(np.uint8).tobytes(), 9)
    return PackedMesh(data, len(order), low.tolist(), step.tolist())


def depth_first(triangles: Int64[np.ndarray, "m 3"], num_corners: int) -> Int64[np.ndarray, " m"]:
    """An order of triangles in which most share an edge with an earlier one, so that their indices are small numbers."""
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    key = edges[:, 0] * num_corners + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    neighbor = np.full(len(key), -1, np.int64)
    neighbor[order[same]] = order[same + 1] // 3
    neighbor[order[same + 1]] = order[same] // 3
    beside = neighbor.reshape(-1, 3)[:, ::-1].tolist()
    is_done, out = [False] * len(triangles), list[int]()
    for start in range(len(triangles)):
        left = [] if is_done[start] else [start]
        while left:
            face = left.pop()
            if is_done[face]:
                continue
            is_done[face] = True
            out.append(face)
            left += [other for other in beside[face] if other >= 0 and not is_done[other]]
    return np.array(out, np.int64)
