"""Group laws of rotations, rigid motions and similarities, over batch shapes and awkward samples."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation as ScipyRotation

from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3, skew

BATCHES = [(), (1,), (10, 1, 2), (0,)]
SAMPLES = ["random", "near identity", "near pi", "zero"]


@dataclass(frozen=True)
class Group:
    """One of the groups: its type, the length of its tangents and their generator as a homogeneous matrix."""

    kind: Any
    tangent_size: int
    angle: slice
    hat: Callable[[np.ndarray], np.ndarray]
    dimension: int = 3

    def identity(self, *batch: int) -> Any:
        return self.kind.identity(*batch)

    def exp(self, xi: np.ndarray) -> Any:
        return self.kind.exp(xi)


def hat_of_rotation(phi: np.ndarray) -> np.ndarray:
    out = np.zeros((*phi.shape[:-1], 4, 4))
    out[..., :3, :3] = skew(phi)
    return out


def hat_of_rigid(xi: np.ndarray) -> np.ndarray:
    out = hat_of_rotation(np.ascontiguousarray(xi[..., 3:6]))
    out[..., :3, 3] = xi[..., :3]
    return out


def hat_of_similarity(xi: np.ndarray) -> np.ndarray:
    out = hat_of_rigid(xi)
    out[..., :3, :3] += xi[..., 6, None, None] * np.eye(3)
    return out


def hat_of_plane(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((*xi.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 1, 0] = -xi[..., 2], xi[..., 2]
    out[..., :2, 2] = xi[..., :2]
    return out


ROTATION = Group(Rotation3, 3, slice(0, 3), hat_of_rotation)
RIGID = Group(Rigid3, 6, slice(3, 6), hat_of_rigid)
SIMILARITY = Group(Similarity3, 7, slice(3, 6), hat_of_similarity)
PLANE = Group(Rigid2, 3, slice(2, 3), hat_of_plane, 2)
GROUPS = [pytest.param(g, id=g.kind.__name__) for g in (ROTATION, RIGID, SIMILARITY, PLANE)]


def tangents(group: Group, sample: str, batch: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Tangents with a rotation angle below pi."""
    xi = rng.normal(size=(*batch, group.tangent_size))
    axis = rng.normal(size=(*batch, group.angle.stop - group.angle.start))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    largest = {"random": 3.1, "near identity": 1e-7, "near pi": np.pi - 1e-7, "zero": 0.0}[sample]
    angle = largest * (rng.uniform(size=(*batch, 1)) if sample == "random" else 1.0)
    xi[..., group.angle] = angle * axis
    if sample in ("near identity", "zero"):
        xi[..., : group.angle.start] *= largest
        xi[..., group.angle.stop :] *= largest
    return xi


def rotation_of(element: Any) -> np.ndarray:
    found = element.matrix if isinstance(element, Rotation3) else element.rotation
    return found() if callable(found) else found


def matrix_of(element: Any) -> np.ndarray:
    """The homogeneous matrix, written out here again."""
    rotation = rotation_of(element)
    size = rotation.shape[-1]
    scale = element.scale if isinstance(element, Similarity3) else np.ones(rotation.shape[:-2])
    out = np.zeros((*rotation.shape[:-2], size + 1, size + 1))
    out[..., :size, :size] = scale[..., None, None] * rotation
    out[..., :size, size] = 0.0 if isinstance(element, Rotation3) else element.translation
    out[..., size, size] = 1.0
    return out


def assert_same(a: Any, b: Any, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(matrix_of(a), matrix_of(b), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("batch", BATCHES, ids=str)
@pytest.mark.parametrize("sample", SAMPLES)
@pytest.mark.parametrize("group", GROUPS)
class TestAxioms:
    """Closure, associativity, identity, inverse, action, exp and log, adjoint."""

    @pytest.fixture
    def xi(self, group: Group, sample: str, batch: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        return tangents(group, sample, batch, rng)

    def test_product_stays_in_the_group(
        self, group: Group, xi: np.ndarray, batch: tuple[int, ...], rng: np.random.Generator
    ) -> None:
        other = group.exp(tangents(group, "random", batch, rng))
        product = group.exp(xi) @ other
        rotation = rotation_of(product)
        one = np.broadcast_to(np.eye(group.dimension), rotation.shape)
        np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), one, atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(rotation), np.ones(batch), atol=1e-13)
        np.testing.assert_allclose(
            matrix_of(product), matrix_of(group.exp(xi)) @ matrix_of(other), rtol=1e-13, atol=1e-13
        )

    def test_associativity(
        self, group: Group, xi: np.ndarray, batch: tuple[int, ...], rng: np.random.Generator
    ) -> None:
        a, b, c = (group.exp(x) for x in (xi, tangents(group, "random", batch, rng), xi[..., ::-1].copy()))
        assert_same((a @ b) @ c, a @ (b @ c), 1e-11)

    def test_identity_and_inverse(self, group: Group, xi: np.ndarray, batch: tuple[int, ...]) -> None:
        a, one = group.exp(xi), group.identity(*batch)
        assert_same(one @ a, a)
        assert_same(a @ one, a)
        assert_same(a @ a.inverse(), one)
        assert_same(a.inverse() @ a, one)
        assert_same(a.inverse(), group.exp(-xi))

    def test_exp_is_the_matrix_exponential(self, group: Group, xi: np.ndarray) -> None:
        hats = group.hat(xi)
        expected = np.array([expm(m) for m in hats.reshape(-1, *hats.shape[-2:])]).reshape(hats.shape)
        np.testing.assert_allclose(matrix_of(group.exp(xi)), expected, rtol=1e-12, atol=1e-12)

    def test_log_undoes_exp(self, group: Group, xi: np.ndarray, sample: str) -> None:
        found = group.exp(xi).log()
        assert found.shape == xi.shape
        if sample == "zero":
            assert not found.any()
        # Relative to the size of the tangent, so that log keeps the digits of small motions.
        np.testing.assert_allclose(found, xi, atol=1e-8 * np.abs(xi).max(initial=0.0))
        assert_same(group.exp(found), group.exp(xi))

    def test_adjoint_moves_tangents(
        self, group: Group, xi: np.ndarray, batch: tuple[int, ...], rng: np.random.Generator
    ) -> None:
        moving = group.exp(tangents(group, "random", batch, rng))
        moved = (moving.adjoint() @ xi[..., None])[..., 0]
        assert moving.adjoint().shape == (*batch, group.tangent_size, group.tangent_size)
        assert_same(moving @ group.exp(xi) @ moving.inverse(), group.exp(moved), 1e-10)
        expected = moving.adjoint() @ group.exp(xi).adjoint()
        np.testing.assert_allclose((moving @ group.exp(xi)).adjoint(), expected, rtol=1e-11, atol=1e-11)

    def test_action_is_compatible_with_the_product(
        self, group: Group, xi: np.ndarray, batch: tuple[int, ...], rng: np.random.Generator
    ) -> None:
        a, b = group.exp(xi), group.exp(tangents(group, "random", batch, rng))
        points = rng.normal(size=(*batch, group.dimension))
        np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, rtol=1e-11, atol=1e-11)
        homogeneous = np.concatenate([points, np.ones((*batch, 1))], axis=-1)[..., None]
        expected = (matrix_of(a) @ homogeneous)[..., :-1, 0]
        np.testing.assert_allclose(a.apply(points), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("group", GROUPS[:3])
def test_axis_turned_by_pi_comes_back_up_to_sign(group: Group, rng: np.random.Generator) -> None:
    xi = tangents(group, "random", (20,), rng)
    axis = xi[:, group.angle]
    axis = np.vstack([axis / np.linalg.norm(axis, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    xi = np.vstack([xi, tangents(group, "random", (6,), rng)])
    xi[:, group.angle] = np.pi * axis
    found = group.exp(xi).log()
    angle = np.linalg.norm(found[:, group.angle], axis=1)
    assert (angle <= np.pi + 1e-15).all() and (angle > np.pi - 1e-12).all()
    sign = np.sign((found[:, group.angle] * axis).sum(axis=1))[:, None]
    np.testing.assert_allclose(sign * found[:, group.angle], np.pi * axis, atol=1e-12)
    assert_same(group.exp(found), group.exp(xi), 1e-11)


def test_angles_beyond_pi_come_back_from_the_other_side() -> None:
    phi = np.array([[0.0, 0.0, np.pi + 0.5], [2 * np.pi, 0.0, 0.0]])
    expected = np.array([[0.0, 0.0, 0.5 - np.pi], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(Rotation3.exp(phi).log(), expected, atol=1e-14)


@pytest.mark.parametrize("angle", [1e-5, 1e-3, 5e-3, 9.99e-3, 1.001e-2, 2e-2, 0.3])
@pytest.mark.parametrize("group", GROUPS)
def test_no_seam_between_small_and_large_angles(group: Group, angle: float, rng: np.random.Generator) -> None:
    """A series near zero and a closed form beyond it must agree where one takes over from the other."""
    xi = tangents(group, "random", (10,), rng)
    xi[:, group.angle] *= angle / np.linalg.norm(xi[:, group.angle], axis=1, keepdims=True)
    expected = np.stack([expm(m) for m in group.hat(xi)])
    np.testing.assert_allclose(matrix_of(group.exp(xi)), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(group.exp(xi).log(), xi, atol=1e-12)


@pytest.mark.parametrize("batch", BATCHES, ids=str)
@pytest.mark.parametrize("sample", SAMPLES)
def test_quaternions_round_trip(sample: str, batch: tuple[int, ...], rng: np.random.Generator) -> None:
    phi = tangents(ROTATION, sample, batch, rng)
    rotation = Rotation3.exp(phi)
    quat = rotation.as_quat_wxyz()
    assert (quat[..., 0] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quat, axis=-1), np.ones(batch), atol=1e-15)
    assert_same(Rotation3.from_quat_wxyz(quat), rotation)
    assert_same(Rotation3.from_quat_wxyz(-3.0 * quat), rotation)
    if quat.size:
        expected = ScipyRotation.from_rotvec(phi.reshape(-1, 3)).as_quat(canonical=True, scalar_first=True)
        np.testing.assert_allclose(quat.reshape(-1, 4), expected, atol=1e-12)


@pytest.mark.parametrize("largest", range(4))
def test_quaternions_with_any_largest_part(largest: int, rng: np.random.Generator) -> None:
    quat = 0.02 * rng.normal(size=(50, 4))
    quat[:, largest] = 1.0
    quat /= np.linalg.norm(quat, axis=1, keepdims=True) * np.where(quat[:, :1] < 0, -1, 1)
    np.testing.assert_allclose(Rotation3.from_quat_wxyz(quat).as_quat_wxyz(), quat, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_large_changes_of_scale_survive_log_and_exp(scale: float, rng: np.random.Generator) -> None:
    similarity = Similarity3(
        np.full(5, scale), Rotation3.exp(rng.normal(size=(5, 3))).matrix, rng.normal(size=(5, 3)) * scale
    )
    assert_same(Similarity3.exp(similarity.log()), similarity, 1e-10)


def test_rigid_motions_are_the_similarities_of_scale_one(rng: np.random.Generator) -> None:
    xi = tangents(RIGID, "random", (6,), rng)
    similarity = Similarity3.exp(np.concatenate([xi, np.zeros((6, 1))], axis=1))
    assert_same(similarity, Rigid3.exp(xi), 1e-13)
    np.testing.assert_allclose(similarity.log()[:, :6], Rigid3.exp(xi).log(), atol=1e-12)


def test_a_similarity_moves_a_camera_with_its_world(rng: np.random.Generator) -> None:
    """The camera sees each moved point in the direction in which it saw the point."""
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0], [0.0, 0.0, 0.0]])
    for sample in 20 * SAMPLES:
        cam_from_world = RIGID.exp(10 * tangents(RIGID, sample, (), rng))
        moved_from_world = SIMILARITY.exp(tangents(SIMILARITY, sample, (), rng))
        moved_cam = moved_from_world.move_cam_from_source(cam_from_world)
        expected = float(moved_from_world.scale) * cam_from_world.apply(points)
        np.testing.assert_allclose(
            moved_cam.apply(moved_from_world.apply(points)), expected, rtol=1e-11, atol=1e-9
        )


@pytest.mark.parametrize("group", GROUPS)
def test_nan_stays_nan_and_stays_in_its_row(group: Group) -> None:
    tangent = np.zeros((3, group.tangent_size))
    tangent[1, group.angle.start] = np.nan
    found = group.exp(tangent).log()
    assert np.isnan(found[1]).any() and not found[[0, 2]].any()
