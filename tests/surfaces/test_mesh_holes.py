"""Closing holes of meshes."""

import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.scene import Mesh
from epipole.scene.mesh_holes import close_holes


def grid_mesh(side=12, bend=0.0):
    """A sheet of side x side squares, seen from +z."""
    y, x = np.mgrid[: side + 1, : side + 1].astype(np.float64)
    vertices = np.stack([x, y, bend * np.sin(0.5 * x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    right, above, both = corner + 1, corner + side + 1, corner + side + 2
    faces = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, above], 1)])
    return Mesh(vertices, faces, np.full((len(vertices), 3), 7, np.uint8))


def area_and_normals(mesh):
    a, b, c = (mesh.vertices_in_world[mesh.faces[:, k]] for k in range(3))
    normal = 0.5 * np.cross(b - a, c - a)
    return np.linalg.norm(normal, axis=1).sum(), normal


def without_faces_near(mesh, center, radius):
    middle = mesh.vertices_in_world[mesh.faces].mean(axis=1)
    keep = np.linalg.norm(middle[:, :2] - center, axis=1) > radius
    return Mesh(mesh.vertices_in_world, mesh.faces[keep], mesh.rgb)


def test_a_flat_hole_is_closed_exactly_and_the_border_stays():
    whole = grid_mesh()
    closed, num = close_holes(without_faces_near(whole, (6.0, 6.0), 2.5), 9.0)
    area, normals = area_and_normals(closed)
    assert num == 1 and area == pytest.approx(144.0) and (normals[:, 2] > -1e-12).all()
    assert len(set(map(tuple, np.sort(closed.faces, axis=1)))) == len(closed)


def test_holes_that_are_too_wide_stay():
    holes = without_faces_near(without_faces_near(grid_mesh(bend=0.4), (2.5, 2.5), 1.2), (8.0, 8.0), 3.0)
    closed, num = close_holes(holes, 5.0)
    assert num == 1 and len(holes) < len(closed) < len(grid_mesh())
    assert close_holes(holes, 0.0) == (holes, 0)
    assert close_holes(holes, np.inf)[1] == 2


def test_edges_of_a_closed_mesh_have_two_triangles():
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = Mesh(vertices, tetrahedron, np.zeros((4, 3), np.uint8))
    assert close_holes(mesh, 10.0) == (mesh, 0)
    with pytest.raises(ConfigError, match="widest"):
        close_holes(mesh, -1.0)
    empty = Mesh(vertices, tetrahedron[:0], np.zeros((4, 3), np.uint8))
    assert close_holes(empty, 1.0)[1] == 0
