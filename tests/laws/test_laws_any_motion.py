"""Group laws of SO(3), SE(2), SE(3) and Sim(3) for motions that Hypothesis makes up."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from any_geometry import GROUPS, rotations, similarity_tangents, turns, twists, vectors
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3, align_points

KINDS = [pytest.param(kind, id=kind.__name__) for kind in GROUPS]


def matrix_of(element: Any) -> np.ndarray:
    """The homogeneous matrix, written out here again."""
    turn = element.matrix if isinstance(element, Rotation3) else element.rotation
    turn = turn() if callable(turn) else turn
    size = len(turn)
    out = np.eye(size + 1)
    out[:size, :size] = turn * (element.scale if isinstance(element, Similarity3) else 1.0)
    if not isinstance(element, Rotation3):
        out[:size, size] = element.translation
    return out


def assert_same(a: Any, b: Any, tolerance: float = 1e-10) -> None:
    expected = matrix_of(b)
    np.testing.assert_allclose(matrix_of(a), expected, atol=tolerance * max(1.0, np.abs(expected).max()))


def point_for(kind: Any, data: st.DataObject) -> np.ndarray:
    return data.draw(vectors(2 if kind is Rigid2 else 3, 100.0))


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_log_undoes_exp_and_exp_undoes_log(kind: Any, data: st.DataObject) -> None:
    xi = data.draw(GROUPS[kind])
    element = kind.exp(xi)
    np.testing.assert_allclose(element.log(), xi, atol=1e-7 * np.abs(xi).max() + 1e-15)
    assert_same(kind.exp(element.log()), element)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_the_axioms_of_a_group(kind: Any, data: st.DataObject) -> None:
    a, b, c = (kind.exp(data.draw(GROUPS[kind])) for _ in range(3))
    one = kind.identity()
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(one @ a, a)
    assert_same(a @ one, a)
    assert_same(a @ a.inverse(), one)
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())
    np.testing.assert_allclose(
        matrix_of(a @ b), matrix_of(a) @ matrix_of(b), rtol=1e-12, atol=1e-12 * np.abs(matrix_of(a)).max()
    )


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_a_product_moves_points_one_after_the_other(kind: Any, data: st.DataObject) -> None:
    a, b = (kind.exp(data.draw(GROUPS[kind])) for _ in range(2))
    point = point_for(kind, data)
    there = a.apply(b.apply(point))
    size = max(1.0, np.abs(there).max())
    np.testing.assert_allclose((a @ b).apply(point), there, atol=1e-11 * size)
    back = b.inverse().apply(a.inverse().apply(there))
    np.testing.assert_allclose(back, point, atol=1e-9 * max(size, np.abs(point).max()))


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_the_adjoint_carries_tangents(kind: Any, data: st.DataObject) -> None:
    """T exp(xi) T^-1 = exp(Ad xi)."""
    moving, xi = kind.exp(data.draw(GROUPS[kind])), 0.1 * data.draw(GROUPS[kind])
    assert_same(moving @ kind.exp(xi) @ moving.inverse(), kind.exp(moving.adjoint() @ xi), 1e-9)


@pytest.mark.parametrize("kind", [p for p in KINDS if p.id in ("Rotation3", "Rigid3", "Similarity3")])
@given(data=st.data())
def test_the_adjoint_of_a_product_is_the_product_of_adjoints(kind: Any, data: st.DataObject) -> None:
    a, b = (kind.exp(data.draw(GROUPS[kind])) for _ in range(2))
    expected = a.adjoint() @ b.adjoint()
    np.testing.assert_allclose((a @ b).adjoint(), expected, atol=1e-11 * max(1.0, np.abs(expected).max()))


@given(rotations(), vectors(3, 50.0), vectors(3, 50.0))
def test_rotations_keep_lengths_angles_and_hands(rotation: Rotation3, a: np.ndarray, b: np.ndarray) -> None:
    turned_a, turned_b = rotation.apply(a), rotation.apply(b)
    np.testing.assert_allclose(turned_a @ turned_b, a @ b, atol=1e-10)
    np.testing.assert_allclose(np.cross(turned_a, turned_b), rotation.apply(np.cross(a, b)), atol=1e-10)


@given(turns())
def test_a_quaternion_and_a_matrix_are_one_rotation(phi: np.ndarray) -> None:
    rotation = Rotation3.exp(phi)
    quaternion = rotation.as_quat_wxyz()
    assert quaternion[0] >= 0 and np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(Rotation3.from_quat_wxyz(quaternion).matrix, rotation.matrix, atol=1e-14)
    angle = np.linalg.norm(phi)
    np.testing.assert_allclose(quaternion[0], np.cos(angle / 2), atol=1e-14)


@given(rotations(), vectors(9, 1.0))
def test_the_nearest_rotation_is_one_and_none_is_nearer(rotation: Rotation3, noise: np.ndarray) -> None:
    matrix = rotation.matrix + 0.1 * noise.reshape(3, 3)
    nearest = Rotation3.nearest(matrix).matrix
    np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(nearest) > 0
    assert np.linalg.norm(nearest - matrix) <= np.linalg.norm(rotation.matrix - matrix) + 1e-14


@given(twists(), similarity_tangents())
def test_a_similarity_moves_a_camera_with_its_world(xi: np.ndarray, tangent: np.ndarray) -> None:
    """The camera sees each moved point in the direction in which it saw the point."""
    cam_from_world, moved_from_world = Rigid3.exp(xi), Similarity3.exp(tangent)
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0], [0.0, 0.0, 0.0]])
    moved_cam = moved_from_world.move_cam_from_source(cam_from_world)
    seen = moved_cam.apply(moved_from_world.apply(points))
    expected = float(moved_from_world.scale) * cam_from_world.apply(points)
    np.testing.assert_allclose(seen, expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


@given(similarity_tangents(), st.booleans())
def test_alignment_of_points_finds_the_similarity_that_moved_them(xi: np.ndarray, with_scale: bool) -> None:
    source = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [1, 1, 5], [-2, 4, 1]])
    truth = Similarity3.exp(xi if with_scale else np.array([*xi[:6], 0.0]))
    found = align_points(source, truth.apply(source), with_scale=with_scale)
    assert_same(found, truth, 1e-9)
