"""Focal lengths from fundamental matrices: exact geometry gives them back, flat votes leave the guess."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.pipelines.sfm.focal import estimate_focals, singular_value_disagreement
from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph

GUESS = 1000.0


def camera(focal=GUESS):
    return Camera(CameraModel.SIMPLE_RADIAL, 800, 600, np.array([focal, 399.5, 299.5, 0.0]))


def motions(rng, count):
    """Cameras around a scene at (0, 0, 5), each looking a little beside it: no shared point on all axes."""
    out = []
    for _ in range(count):
        rotation = Rigid3.exp(np.concatenate([np.zeros(3), rng.normal(0, 0.25, 3)]))
        away = Rigid3(np.eye(3), np.array([0, 0, 5.0]) + rng.normal(0, 0.5, 3))
        out.append(away @ rotation @ Rigid3(np.eye(3), np.array([0, 0, -5.0])))
    return out


def view_graph(positions, focals, pairs, inliers):
    fundamental = []
    for i, j in pairs:
        essential = essential_from_cam2_from_cam1(positions[j] @ positions[i].inverse())
        f = np.linalg.inv(camera(focals[j]).K).T @ essential @ np.linalg.inv(camera(focals[i]).K)
        fundamental.append(f / np.linalg.norm(f))
    n, nan = len(pairs), np.full((len(pairs), 3, 3), np.nan)
    offsets = np.concatenate([[0], np.cumsum(inliers)]).astype(np.int64)
    keypoints = np.zeros(offsets[-1], np.int32)
    ends = np.array(pairs, np.int32)
    kind = np.full(n, int(PairKind.UNCALIBRATED), np.int32)
    return ViewGraph(
        *(ends[:, 0].copy(), ends[:, 1].copy(), kind, np.array(inliers, np.int32), offsets),
        *(keypoints, keypoints.copy(), Rigid3(nan, np.full((n, 3), np.nan)), nan, np.array(fundamental)),
        *(nan, np.full(n, np.nan)),
    )


def all_pairs(n):
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def test_disagreement_is_that_of_the_singular_values(rng):
    F = rng.normal(size=(3, 2)) @ rng.normal(size=(2, 3))
    K = camera().K
    s = np.linalg.svd(K.T @ F @ K, compute_uv=False)
    np.testing.assert_allclose(singular_value_disagreement(F, K, K, np.ones(1), np.ones(1)), 1 - s[1] / s[0])


def test_each_of_six_cameras_gets_its_own_focal_length(rng):
    focals = GUESS * np.array([0.6, 0.8, 1.0, 1.4, 2.0, 0.7])
    graph = view_graph(motions(rng, 6), focals, all_pairs(6), [300] * 15)
    cameras, found = estimate_focals(
        Cameras.from_list([camera()] * 6, is_focal_trusted=[False] * 6), np.arange(6, dtype=np.int32), graph
    )
    assert sorted(found) == list(range(6))
    np.testing.assert_allclose(cameras.params[:, 0], focals, rtol=0.07)
    assert cameras.is_focal_trusted.all()


@pytest.mark.parametrize("focal", [0.5, 1.0, 2.2])
def test_one_camera_of_many_images(rng, focal):
    graph = view_graph(motions(rng, 5), np.full(5, GUESS * focal), all_pairs(5), [200] * 10)
    cameras, found = estimate_focals(
        Cameras.from_list([camera()], is_focal_trusted=[False]), np.zeros(5, np.int32), graph
    )
    assert list(found) == [0]
    np.testing.assert_allclose(cameras.params[0, 0], GUESS * focal, rtol=0.07)


def test_a_trusted_camera_stays_and_helps_the_others(rng):
    focals = GUESS * np.array([1.0, 1.7, 0.6])
    graph = view_graph(motions(rng, 3), focals, all_pairs(3), [300] * 3)
    cameras, found = estimate_focals(
        Cameras.from_list([camera()] * 3, is_focal_trusted=[True, False, False]),
        np.arange(3, dtype=np.int32),
        graph,
    )
    assert sorted(found) == [1, 2]
    np.testing.assert_allclose(cameras.params[:, 0], focals, rtol=0.07)
    assert cameras.params[0, 0] == GUESS


def test_few_wrong_pairs_do_not_decide(rng):
    focals = GUESS * np.array([0.6, 0.8, 1.3, 1.4, 2.0])
    graph = view_graph(motions(rng, 5), focals, all_pairs(5), [300] * 10)
    for edge in (1, 7):
        graph.fundamental[edge] = rng.normal(size=(3, 2)) @ rng.normal(size=(2, 3))
    cameras, _ = estimate_focals(
        Cameras.from_list([camera()] * 5, is_focal_trusted=[False] * 5), np.arange(5, dtype=np.int32), graph
    )
    np.testing.assert_allclose(cameras.params[:, 0], focals, rtol=0.07)


def test_parallel_views_tell_nothing_and_the_guess_stays():
    positions = [Rigid3(np.eye(3), np.array([0.3 * k, 0.1 * k * k, 0.0])) for k in range(4)]
    graph = view_graph(positions, np.full(4, 1.8 * GUESS), all_pairs(4), [300] * 6)
    cameras, found = estimate_focals(
        Cameras.from_list([camera()], is_focal_trusted=[False]), np.zeros(4, np.int32), graph
    )
    assert found == {}
    assert cameras.params[0, 0] == GUESS


def test_too_few_matches_do_not_vote(rng):
    graph = view_graph(motions(rng, 3), np.full(3, 2 * GUESS), all_pairs(3), [20] * 3)
    unchanged = Cameras.from_list([camera()], is_focal_trusted=[False])
    _, found = estimate_focals(unchanged, np.zeros(3, np.int32), graph)
    assert found == {}
