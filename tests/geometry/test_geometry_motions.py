"""Rotation3, Rigid3, Similarity3: what the group laws do not say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as ScipyRotation

from epipole.errors import ShapeError
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3, skew


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    v, w = rng.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose((skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)
    np.testing.assert_array_equal(skew(v), -np.swapaxes(skew(v), -1, -2))
    assert skew(np.zeros((0, 3))).shape == (0, 3, 3)


def test_known_rotations() -> None:
    quarter = Rotation3.exp([0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(quarter.matrix, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(quarter.apply([1.0, 0, 0]), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(quarter.as_quat_wxyz(), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)
    assert float(quarter.angle_rad()) == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.1, np.pi])
def test_angles_keep_their_digits(angle: float, rng: np.random.Generator) -> None:
    axes = rng.normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    found = Rotation3.exp(angle * axes).angle_rad()
    # Entries of size one hold an angle to about 1e-16.
    np.testing.assert_allclose(found, angle, rtol=1e-14, atol=1e-16 if angle < 1e-6 else 1e-15)


def test_nearest_rotation(rng: np.random.Generator) -> None:
    truth = ScipyRotation.from_rotvec(rng.normal(size=(7, 3))).as_matrix()
    np.testing.assert_allclose(Rotation3.nearest(truth).matrix, truth, atol=1e-14)
    np.testing.assert_allclose(Rotation3.nearest(2.5 * truth[0]).matrix, truth[0], atol=1e-14)
    noisy = truth + 0.1 * rng.normal(size=truth.shape)
    found = Rotation3.nearest(noisy).matrix
    distance = np.linalg.norm(found - noisy, axis=(1, 2))
    for step in rng.normal(size=(50, 3)) * 0.05:
        other = Rotation3.exp(step).matrix @ found
        assert (np.linalg.norm(other - noisy, axis=(1, 2)) >= distance).all()


def test_nearest_rotation_of_a_mirror_is_no_mirror(rng: np.random.Generator) -> None:
    mirrors = rng.normal(size=(20, 3, 3))
    found = Rotation3.nearest(mirrors)
    np.testing.assert_allclose(np.linalg.det(found.matrix), 1.0)
    np.testing.assert_allclose(Rotation3.nearest(np.diag([1.0, 1.0, -0.1])).matrix, np.eye(3), atol=1e-15)


def test_quaternions_of_any_length_and_nan() -> None:
    rotation = Rotation3.from_quat_wxyz([[2.0, 0, 0, 0], [0, -3.0, 0, 0], [np.nan, 0, 0, 1]]).matrix
    np.testing.assert_allclose(rotation[:2], [np.eye(3), np.diag([1.0, -1, -1])])
    assert np.isnan(rotation[2]).all()


@pytest.mark.parametrize(
    "wrong",
    [np.ones((3, 3)), 2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), 1e200), np.zeros((3, 3))],
    ids=["ones", "scaled", "mirror", "huge", "zero"],
)
def test_what_is_no_rotation_is_refused(wrong: np.ndarray) -> None:
    both = np.stack([np.eye(3), wrong])
    for make in (
        lambda: Rotation3(wrong),
        lambda: Rotation3(both),
        lambda: Rigid3(wrong, np.zeros(3)),
        lambda: Rigid3(both, np.zeros((2, 3))),
        lambda: Similarity3(np.array(2.0), wrong, np.zeros(3)),
        lambda: Rigid3.from_matrix(np.vstack([np.c_[wrong, np.zeros(3)], [0, 0, 0, 1]])),
    ):
        with pytest.raises(ShapeError, match="rotation matrices"):
            make()


def test_few_digits_are_a_rotation_and_nan_is_not_known(rng: np.random.Generator) -> None:
    rotation = Rotation3.exp(rng.normal(size=(20, 3))).matrix
    assert len(Rotation3(np.round(rotation, 4))) == len(Rotation3(np.float64(np.float32(rotation)))) == 20
    rotation[3] = np.nan
    assert np.isnan(Rotation3(rotation).matrix[3]).all()
    assert repr(Rotation3(rotation[3])) == "Rotation3(unknown)"
    filled = Rigid3(rotation, np.ones((20, 3))).or_identity()
    np.testing.assert_array_equal(filled[3].as_matrix(), np.eye(4))
    np.testing.assert_array_equal(np.delete(filled.rotation, 3, axis=0), np.delete(rotation, 3, axis=0))


def test_the_last_row_of_a_matrix_and_a_zero_quaternion_are_looked_at() -> None:
    with pytest.raises(ShapeError, match="must end in the row"):
        Rigid3.from_matrix(np.vstack([np.eye(3, 4), [0, 0, 1, 1]]))
    with pytest.raises(ShapeError, match="zero quaternion"):
        Rotation3.from_quat_wxyz([[1.0, 0, 0, 0], [0, 0, 0, 0]])


def test_single_ones_are_stacked(rng: np.random.Generator) -> None:
    motions = [Rigid3.exp(xi) for xi in rng.normal(size=(3, 6))]
    together = Rigid3.stack(motions)
    assert together.batch_shape() == (3,)
    for one, same in zip(motions, together):
        np.testing.assert_array_equal(one.as_matrix(), same.as_matrix())
    assert Rigid3.stack([together, together]).batch_shape() == (2, 3)
    assert Similarity3.stack([Similarity3.identity()]).batch_shape() == (1,)
    for wrong in ([], [motions[0], together]):
        with pytest.raises(ShapeError):
            Rigid3.stack(wrong)
    with pytest.raises(ShapeError, match="a batch is needed"):
        len(motions[0])


def test_matrices_there_and_back(rng: np.random.Generator) -> None:
    motion = Rigid3.exp(rng.normal(size=(3, 2, 6)))
    for matrix in (motion.as_matrix(), motion.as_matrix()[..., :3, :]):
        back = Rigid3.from_matrix(matrix)
        np.testing.assert_array_equal(back.as_matrix(), motion.as_matrix())
        assert back.rotation.flags.c_contiguous and not np.shares_memory(back.rotation, matrix)
    for wrong in (np.eye(3), np.zeros((2, 2, 4)), np.eye(5), np.zeros(4)):
        with pytest.raises(ShapeError, match="matrix must have shape"):
            Rigid3.from_matrix(wrong)


def test_from_quaternion_and_translation(rng: np.random.Generator) -> None:
    motion = Rigid3.exp(rng.normal(size=(5, 6)))
    quat, translation = Rotation3(motion.rotation).as_quat_wxyz(), motion.translation.copy()
    back = Rigid3.from_quat_wxyz(quat, translation)
    np.testing.assert_allclose(back.as_matrix(), motion.as_matrix(), atol=1e-14)
    translation[:] = 7.0
    np.testing.assert_array_equal(back.translation, motion.translation)


def test_products_read_as_cancellation() -> None:
    body_from_world = Rigid3.from_quat_wxyz([1.0, 0, 0, 0], [0.0, 0, 5.0])
    cam_from_body = Rigid3(Rotation3.exp([0.0, np.pi / 2, 0.0]).matrix, np.array([1.0, 0.0, 0.0]))
    cam_from_world = cam_from_body @ body_from_world
    np.testing.assert_allclose(cam_from_world.apply([0.0, 0, 0]), [6.0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(cam_from_world.apply(cam_from_world.centers()), 0.0, atol=1e-15)


def test_batches_broadcast_against_points(rng: np.random.Generator) -> None:
    motions, points = Rigid3.exp(rng.normal(size=(4, 1, 6))), rng.normal(size=(7, 3))
    moved = motions.apply(points)
    assert moved.shape == (4, 7, 3)
    for i in range(4):
        np.testing.assert_allclose(moved[i], points @ motions.rotation[i, 0].T + motions.translation[i, 0])
    similar = Similarity3.exp(rng.normal(size=(4, 1, 7))).apply(points)
    assert similar.shape == (4, 7, 3)


def test_selection_and_length() -> None:
    motions = Rigid3.exp(np.arange(18.0).reshape(3, 6) / 10)
    assert len(motions) == 3 and len(motions[1:]) == 2 and len(motions[np.zeros(0, int)]) == 0
    assert [m.translation.shape for m in motions] == [(3,)] * 3
    picked = motions[np.array([True, False, True])]
    np.testing.assert_array_equal(picked.translation, motions.translation[[0, 2]])
    similarities = Similarity3.exp(np.zeros((3, 7)))
    assert float(similarities[2].scale) == 1.0 and similarities[:2].scale.shape == (2,)
    assert Rotation3.identity(4)[1].matrix.shape == (3, 3)


def test_a_single_scale_stays_an_array() -> None:
    similarity = Similarity3(np.float64(2.0), np.eye(3), np.zeros(3))
    results = [similarity, similarity.inverse(), similarity @ similarity, Similarity3.exp(np.zeros(7))]
    results.append(Similarity3.identity(3)[0])
    assert all(isinstance(s.scale, np.ndarray) and s.scale.shape == () for s in results)
    assert [float(s.scale) for s in results] == [2.0, 0.5, 4.0, 1.0, 1.0]


def test_scale_rotates_then_scales_then_moves() -> None:
    similarity = Similarity3(
        np.array(2.0), Rotation3.exp([0.0, 0.0, np.pi / 2]).matrix, np.array([0.0, 0.0, 1.0])
    )
    np.testing.assert_allclose(similarity.apply([1.0, 0.0, 3.0]), [0.0, 2.0, 7.0], atol=1e-15)


def test_frozen_and_not_written_to() -> None:
    motion = Rigid3.identity(2)
    with pytest.raises(AttributeError):
        motion.translation = np.ones((2, 3))  # type: ignore[misc]
    xi = np.full((2, 6), 0.1)
    before = xi.copy()
    (Rigid3.exp(xi) @ motion).inverse().log()
    np.testing.assert_array_equal(xi, before)
    np.testing.assert_array_equal(motion.translation, 0.0)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("phi_rad", lambda: Rotation3.exp(np.zeros(4))),
        ("xi", lambda: Rigid3.exp(np.zeros((2, 3)))),
        ("xi", lambda: Similarity3.exp(np.zeros(6))),
        ("quat_wxyz", lambda: Rotation3.from_quat_wxyz([1.0, 0.0])),
        ("points", lambda: Rigid3.identity().apply(np.zeros((3, 2)))),
        ("vectors", lambda: skew("word")),
    ],
)
def test_wrong_shapes_are_named(name: str, call: object) -> None:
    with pytest.raises(ShapeError, match=f"^{name} must"):
        call()  # type: ignore[operator]


def test_text_tells_the_batch_or_the_values_of_a_single_one() -> None:
    assert repr(Rigid3.identity(2, 3)) == "Rigid3(batch of 2 x 3)"
    assert repr(Rotation3.identity(5)) == "Rotation3(batch of 5)"
    assert repr(Rotation3.identity()) == "Rotation3(0 degrees)"
    quarter = Rigid3(Rotation3.exp([0.0, 0.0, -np.pi / 2]).matrix, np.array([1.0, -0.25, 1e6]))
    words = "90 degrees about (0, 0, -1), translation (1, -0.25, 1e+06)"
    assert repr(quarter) == f"Rigid3({words})"
    assert (
        repr(Similarity3(np.array(2.0), quarter.rotation, quarter.translation))
        == f"Similarity3(scale 2, {words})"
    )
    assert repr(Rigid2(np.array(0.1), np.ones(2))) == "Rigid2(5.73 degrees, translation (1, 1))"
    assert repr(Rigid3(np.full((3, 3), np.nan), np.zeros(3))) == "Rigid3(unknown)"


@pytest.mark.parametrize("kind", [Rotation3, Rigid2, Rigid3, Similarity3])
def test_a_single_one_has_no_length_and_no_rows(kind: type) -> None:
    single, three = kind.identity(), kind.identity(3)
    assert len(three) == 3 and len(list(three)) == 3 and three[1].batch_shape() == ()
    for wrong in (len, iter, list):
        with pytest.raises(TypeError, match=f"got a single {kind.__name__}"):
            wrong(single)
    for index in (0, slice(2), np.array([0])):
        with pytest.raises(IndexError):
            single[index]
    assert single[None].batch_shape() == (1,) and single[...].batch_shape() == ()
    assert single and three and not kind.identity(0)


@pytest.mark.parametrize("target", [[0.0, 0, 1], [0.0, 0, -1], [1.0, 0, 0], [0.6, 0, 0.8], [1e-9, 0, -5.0]])
def test_the_smallest_rotation_between_two_directions(target: list[float]) -> None:
    source = np.array([0.0, 0.0, 2.0])
    found, unit = Rotation3.from_two_vectors(source, target), np.array(target) / np.linalg.norm(target)
    np.testing.assert_allclose(found.apply(source), 2.0 * unit, atol=1e-8)
    assert float(found.angle_rad()) == pytest.approx(np.arccos(unit[2]), abs=1e-8)
    assert np.linalg.det(found.matrix) == pytest.approx(1.0)


@pytest.mark.parametrize("source", [[0.0, 0, 0], [np.nan, 0, 1], [[1.0, 0, 0]]])
def test_a_rotation_needs_two_directions(source: list[float]) -> None:
    with pytest.raises(ShapeError):
        Rotation3.from_two_vectors(source, [0.0, 0.0, 1.0])
