"""Simplification of textured meshes by edge collapses in the order of quadric errors.

The costs are those of Garland and Heckbert, Surface Simplification Using Quadric Error Metrics, SIGGRAPH 1997. A vertex
moves onto a neighbor and takes its texture coordinates, so the coordinates stay valid. On a seam, a vertex moves along
the seam, on both sides at once; on the boundary of the mesh, along the boundary. Each round collapses many edges whose
triangles are all different.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array

from epipole.scene.mesh import Mesh

LEAST_COSINE = 0.3
"""Between the normals of a triangle before and after a collapse."""
LEAST_AREA = 1e-6
"""Of a triangle in the texture after a collapse, relative to the area before."""
LENGTH_WEIGHT = 1e-3
"""Cost of the squared length of an edge, relative to squared distances from the planes: prefers short edges in planes."""
EDGE_WEIGHT = 3.0
"""Cost of distances from the boundary and from seams, relative to distances from the surface."""
CANDIDATES = 0.6
"""Fraction of the vertices, cheapest first, that a round considers."""
MAX_ROUNDS = 60
_PASSES = 3
"""Passes that choose vertices without common edges, in each round."""


class Corners(NamedTuple):
    """A mesh whose triangles refer to corners: vertices with a texture coordinate, several at one vertex along seams."""

    positions: Float64[np.ndarray, "n 3"]
    vertex: Int64[np.ndarray, " c"]
    """Row of the position of each corner."""
    uv: Float64[np.ndarray, "c 2"]
    triangles: Int64[np.ndarray, "m 3"]
    """Rows of corners."""


class _Edges(NamedTuple):
    """Directed edges between corners, and the edges between vertices that they belong to."""

    start: np.ndarray
    end: np.ndarray
    """Corners."""
    num_faces: np.ndarray
    edge: np.ndarray
    """Row of the edge between vertices."""
    from_vertex: np.ndarray
    to_vertex: np.ndarray
    """Of each edge between vertices."""


def simplified(mesh: Corners, most_triangles: int) -> Corners:
    """Collapse edges until at most `most_triangles` are left, or no edge can be collapsed.

    Args:
        mesh: the mesh; corners that no triangle uses stay.
        most_triangles: largest number of triangles wanted.
    """
    positions = mesh.positions - mesh.positions.mean(axis=0)
    triangles = mesh.triangles[_is_proper(mesh.vertex[mesh.triangles])]
    quadrics = _quadrics(positions, mesh.vertex, triangles)
    for _ in range(MAX_ROUNDS):
        excess = len(triangles) - most_triangles
        if excess <= 0:
            break
        moved = _round(mesh, positions, quadrics, triangles, excess)
        if moved is None:
            break
        triangles = moved[triangles]
        triangles = triangles[_is_proper(mesh.vertex[triangles])]
    return mesh._replace(triangles=triangles)


def simplified_mesh(mesh: Mesh, most_faces: int) -> Mesh:
    """A mesh without texture, simplified to at most `most_faces` triangles where edges can be collapsed; see `simplified`."""
    n = len(mesh.vertices_in_world)
    corners = Corners(mesh.vertices_in_world, np.arange(n), np.zeros((n, 2)), mesh.faces)
    used, faces = np.unique(simplified(corners, most_faces).triangles, return_inverse=True)
    return replace(
        mesh, vertices_in_world=mesh.vertices_in_world[used], faces=faces.reshape(-1, 3), rgb=mesh.rgb[used]
    )


def _is_proper(vertices: np.ndarray) -> np.ndarray:
    """Triangles with three different vertices."""
    a, b, c = vertices.T
    return np.asarray((a != b) & (b != c) & (c != a))


def _round(
    mesh: Corners, positions: np.ndarray, quadrics: np.ndarray, triangles: np.ndarray, excess: int
) -> np.ndarray | None:
    """The corner that replaces each corner in one round of collapses; None if there is none.

    Quadrics of the vertices that stay are updated.
    """
    n = len(positions)
    edges = _edges_of(mesh.vertex, triangles, len(mesh.vertex), n)
    allowed = _allowed(edges, mesh.vertex, n)
    a, b = edges.from_vertex[allowed], edges.to_vertex[allowed]
    cost = _cost(quadrics[a] + quadrics[b], positions[a], positions[b])
    order = np.lexsort((cost, a))
    first = np.ones(len(order), bool)
    first[1:] = a[order[1:]] != a[order[:-1]]
    best = order[first]
    best = best[np.argsort(cost[best], kind="stable")]
    best = best[: max(int(CANDIDATES * len(best)), min(len(best), 64))]
    target = np.full(n, -1, np.int64)
    target[a[best]] = b[best]
    onto = np.arange(len(mesh.vertex))
    used = target[mesh.vertex[edges.start]] == mesh.vertex[edges.end]
    onto[edges.start[used]] = edges.end[used]
    is_bad = _flips(mesh, positions, triangles, target, onto) | _pinches(edges, target, n)
    target[is_bad] = -1
    rank = np.full(n, n, np.int64)
    rank[a[best]] = np.arange(len(best))
    chosen = _independent(rank, target >= 0, edges)[: max(1, (excess + 1) // 2)]
    if not len(chosen):
        return None
    np.add.at(quadrics, target[chosen], quadrics[chosen])
    is_chosen = np.zeros(n, bool)
    is_chosen[chosen] = True
    return np.where(is_chosen[mesh.vertex], onto, np.arange(len(onto)))


def _edges_of(vertex: np.ndarray, triangles: np.ndarray, num_corners: int, n: int) -> _Edges:
    start = np.concatenate([triangles, np.roll(triangles, -1, axis=1)]).ravel()
    end = np.concatenate([np.roll(triangles, -1, axis=1), triangles]).ravel()
    keys, num_faces = np.unique(start * num_corners + end, return_counts=True)
    start, end = keys // num_corners, keys % num_corners
    of_vertices, edge = np.unique(vertex[start] * n + vertex[end], return_inverse=True)
    return _Edges(start, end, num_faces, edge, of_vertices // n, of_vertices % n)


def _allowed(edges: _Edges, vertex: np.ndarray, n: int) -> np.ndarray:
    """Edges along which the first vertex may move: all of its corners have exactly one corner at the other vertex."""
    faces = np.bincount(edges.edge, edges.num_faces)
    # A corner with several corners at the other vertex: the end of a seam.
    starts, count = np.unique(edges.edge * len(vertex) + edges.start, return_counts=True)
    is_split = np.zeros(len(faces), bool)
    is_split[starts[count > 1] // len(vertex)] = True
    present = np.zeros(len(vertex), bool)
    present[edges.start] = True
    corners_at = np.bincount(vertex[present], minlength=n)
    num_pairs = np.bincount(edges.edge)
    on_boundary, irregular = np.zeros(n, bool), np.zeros(n, bool)
    on_boundary[edges.from_vertex[faces == 1]] = True
    irregular[edges.from_vertex[faces > 2]] = True
    a = edges.from_vertex
    fits = (num_pairs == corners_at[a]) & ~is_split & ~irregular[a]
    return np.asarray(fits & ~(on_boundary[a] & (faces != 1)))


def _quadrics(positions: np.ndarray, vertex: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Upper triangles (n, 10) of the quadrics of the vertices: planes of the triangles, and of edges of charts."""
    corners = positions[vertex[triangles]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    unit = normal / np.maximum(area, 1e-300)[:, None]
    planes = [_of_plane(unit, corners[:, 0]) * (0.5 * area / 3.0)[:, None]]
    rows = [vertex[triangles]]
    num_corners = len(vertex)
    key = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    _, edge, count = np.unique(
        (key[..., 0] * num_corners + key[..., 1]).ravel(), return_inverse=True, return_counts=True
    )
    face, side = np.divmod(np.flatnonzero(count[edge] == 1), 3)
    start, end = corners[face, side], corners[face, (side + 1) % 3]
    along = end - start
    across = np.cross(along, unit[face])
    length = np.linalg.norm(across, axis=1)
    weight = EDGE_WEIGHT * np.einsum("ij,ij->i", along, along) / 2.0
    planes.append(_of_plane(across / np.maximum(length, 1e-300)[:, None], start) * weight[:, None])
    rows.append(vertex[np.stack([triangles[face, side], triangles[face, (side + 1) % 3]], axis=1)])
    out = np.zeros((len(positions), 10))
    for of_rows, plane in zip(rows, planes):
        for column in range(of_rows.shape[1]):
            for k in range(10):
                out[:, k] += np.bincount(of_rows[:, column], plane[:, k], minlength=len(positions))
    return out


def _of_plane(unit: np.ndarray, point: np.ndarray) -> np.ndarray:
    x, y, z = unit.T
    d = -np.einsum("ij,ij->i", unit, point)
    return np.stack([x * x, x * y, x * z, x * d, y * y, y * z, y * d, z * z, z * d, d * d], axis=1)


def _cost(quadric: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Squared distances of the new position from the planes, weighted by area, and from the old position."""
    x, y, z = end.T
    q = quadric.T
    distances = (
        q[0] * x * x + q[4] * y * y + q[7] * z * z
        + 2.0 * (q[1] * x * y + q[2] * x * z + q[5] * y * z + q[3] * x + q[6] * y + q[8] * z) + q[9]
    )  # fmt: skip
    length2 = np.einsum("ij,ij->i", end - start, end - start)
    return np.asarray(np.maximum(distances, 0.0) + LENGTH_WEIGHT * length2 * length2)


def _flips(
    mesh: Corners, positions: np.ndarray, triangles: np.ndarray, target: np.ndarray, onto: np.ndarray
) -> np.ndarray:
    """(n,) whether moving a vertex to its target flips a triangle, in the world or in the texture."""
    is_bad = np.zeros(len(positions), bool)
    for corner in range(3):
        moving, left, right = (triangles[:, (corner + k) % 3] for k in range(3))
        v = mesh.vertex[moving]
        to = target[v]
        rows = np.flatnonzero((to >= 0) & (to != mesh.vertex[left]) & (to != mesh.vertex[right]))
        v, to, moving, left, right = v[rows], to[rows], moving[rows], left[rows], right[rows]
        p, q = positions[mesh.vertex[left]], positions[mesh.vertex[right]]
        before, after = (np.cross(p - positions[at], q - positions[at]) for at in (v, to))
        dots = np.einsum("ij,ij->i", before, after)
        lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        areas = [
            _cross2(mesh.uv[left] - mesh.uv[at], mesh.uv[right] - mesh.uv[at])
            for at in (moving, onto[moving])
        ]
        is_flat = (areas[0] != 0) & (areas[1] * areas[0] <= LEAST_AREA * areas[0] ** 2)
        flips = (dots <= LEAST_COSINE * lengths) | is_flat
        is_bad[v[flips]] = True
    return is_bad


def _cross2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _pinches(edges: _Edges, target: np.ndarray, n: int) -> np.ndarray:
    """(n,) whether a vertex and its target have common neighbors beyond the triangles of their edge."""
    a, b = edges.from_vertex, edges.to_vertex
    graph = csr_array((np.ones(len(a), np.int32), (a, b)), shape=(n, n))
    rows = np.flatnonzero(target[a] == b)
    common = np.asarray(graph[a[rows]].multiply(graph[b[rows]]).sum(axis=1)).ravel()
    faces = np.bincount(edges.edge, edges.num_faces)
    out = np.zeros(n, bool)
    out[a[rows]] = common != faces[rows]
    return out


def _independent(rank: np.ndarray, is_candidate: np.ndarray, edges: _Edges) -> np.ndarray:
    """Candidates without common edges, cheapest first."""
    n = len(rank)
    a, b = edges.from_vertex, edges.to_vertex
    free, chosen = is_candidate.copy(), np.zeros(n, bool)
    for _ in range(_PASSES):
        rows = np.flatnonzero(free[a] & free[b])
        a, b = a[rows], b[rows]
        lowest = np.full(n, n, np.int64)
        np.minimum.at(lowest, a, rank[b])
        new = free & (rank < lowest)
        chosen |= new
        free &= ~new
        free[b[new[a]]] = False
    found = np.flatnonzero(chosen)
    return np.asarray(found[np.argsort(rank[found])])
