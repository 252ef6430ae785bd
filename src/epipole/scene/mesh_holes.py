"""Closing the holes of a mesh: each small border loop is filled with triangles between its vertices.

The corner of the loop with the smallest angle is cut off, again and again (the front of Zhao, Gao and Lin, A robust hole-filling algorithm for
triangular mesh, The Visual Computer 2007, without new vertices).
"""

from __future__ import annotations

import heapq
from dataclasses import replace

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.scene.mesh import Mesh


@checked
def close_holes(mesh: Mesh, widest: float) -> tuple[Mesh, int]:
    """Fill the holes of a mesh; returns it, and their number.

    Loops that pass a vertex twice are left open, and the outer border of a part of the mesh is not a hole.

    Args:
        mesh: the mesh.
        widest: diameter of the bounding box of the largest holes that are filled.

    Raises:
        ConfigError: widest is negative or not a number.
    """
    if not widest >= 0.0:
        raise ConfigError(f"widest must not be negative, got {widest}")
    vertices, added, num = mesh.vertices_in_world, list[tuple[int, int, int]](), 0
    for loop in _holes(mesh):
        if len(loop) >= 3 and _diameter(vertices[loop]) <= widest:
            added += _filled(vertices, loop)
            num += 1
    if not added:
        return mesh, 0
    return replace(mesh, faces=np.concatenate([mesh.faces, np.array(added, np.int64)])), num


def _holes(mesh: Mesh) -> list[np.ndarray]:
    """Border loops, in the direction that new triangles have, without the widest loop of each part."""
    loops = _border_loops(mesh.faces)
    if not loops:
        return []
    part = _part_of_vertex(mesh)
    first = np.array([part[loop[0]] for loop in loops])
    width = np.array([_diameter(mesh.vertices_in_world[loop]) for loop in loops])
    order = np.lexsort((-width, first))
    is_outer = np.ones(len(order), bool)
    is_outer[1:] = first[order[1:]] != first[order[:-1]]
    return [loops[k] for k in sorted(order[~is_outer].tolist())]


def _border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed loops of edges that have one triangle, against the direction of those triangles."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    n = int(faces.max(initial=0)) + 1
    keys, reverse = start * n + end, end * n + start
    is_border = ~np.isin(keys, reverse)
    after = dict[int, int]()
    shared = set[int]()
    for a, b in zip(end[is_border].tolist(), start[is_border].tolist()):
        if a in after:
            shared.add(a)
        after[a] = b
    loops, seen = list[np.ndarray](), set[int]()
    for first in sorted(after):
        if first in seen:
            continue
        loop, at = list[int](), first
        while at in after and at not in seen:
            seen.add(at)
            loop.append(at)
            at = after[at]
        if at == first and shared.isdisjoint(loop):
            loops.append(np.array(loop, np.int64))
    return loops


def _part_of_vertex(mesh: Mesh) -> np.ndarray:
    """Connected component of each vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(mesh.vertices_in_world)
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1])


def _diameter(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _filled(vertices: np.ndarray, loop: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangles that fill a loop of n vertices: n - 2."""
    n = len(loop)
    before, after = [(k - 1) % n for k in range(n)], [(k + 1) % n for k in range(n)]
    points = vertices[loop]
    up = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # twice the area vector

    def angle(k: int) -> float:
        one, two = points[before[k]] - points[k], points[after[k]] - points[k]
        cross = np.cross(two, one)
        inside = float(np.arctan2(np.linalg.norm(cross), one @ two))
        return inside if cross @ up >= 0 else 2.0 * np.pi - inside

    queue = [(angle(k), k) for k in range(n)]
    current = [value for value, _ in queue]
    heapq.heapify(queue)
    is_left, out = [True] * n, list[tuple[int, int, int]]()
    while len(out) < n - 2:
        value, k = heapq.heappop(queue)
        if not is_left[k] or value != current[k]:
            continue
        a, b = before[k], after[k]
        out.append((int(loop[a]), int(loop[k]), int(loop[b])))
        is_left[k] = False
        after[a], before[b] = b, a
        for end in (a, b):
            current[end] = angle(end)
            heapq.heappush(queue, (current[end], end))
    return out
