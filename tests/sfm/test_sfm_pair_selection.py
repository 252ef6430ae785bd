"""Pairs that contradict the others: dropped, unless a plane allows another motion that does not."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3
from epipole.geometry.planes import decompose_homography
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.matching.pair_selection import consistent_pairs
from epipole.robust import PairKind
from epipole.scene import Cameras
from epipole.synthetic import look_at
from mapping_graphs import graph_of_rotations

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))
PAIRS = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (0, 3)]


@pytest.fixture
def wall(rng):
    """Four images of a wall: keypoints, true motions of all pairs, and the homographies."""
    points = np.c_[rng.uniform(-0.3, 0.3, 60), np.zeros(60), rng.uniform(-0.3, 0.3, 60)]
    centers = ((-1.2, -3.0, 0.6), (-0.4, -2.2, -0.5), (0.4, -3.4, 0.7), (1.3, -2.5, -0.3))
    poses = [look_at(center, (0.0, 0.0, 0.0)) for center in centers]
    keypoints = [CAMERA.project(pose.apply(points)) for pose in poses]
    motions, homographies = [], []
    for i, j in PAIRS:
        motion = poses[j] @ poses[i].inverse()
        normal, distance = poses[i].rotation @ np.array([0.0, 1.0, 0.0]), poses[i].apply(np.zeros((1, 3)))[0]
        plane = normal / (normal @ distance)  # n . X = 1 in camera i
        homographies.append(
            CAMERA.K @ (motion.rotation + np.outer(motion.translation, plane)) @ np.linalg.inv(CAMERA.K)
        )
        motions.append(motion)
    return keypoints, motions, np.array(homographies)


def graph_of(motions, homographies, kind):
    graph = graph_of_rotations(PAIRS, np.array([m.rotation for m in motions]), [60] * len(PAIRS))
    unit = np.array([m.translation / np.linalg.norm(m.translation) for m in motions])
    return replace(
        graph,
        kind=np.full(len(PAIRS), kind, np.int32),
        cam2_from_cam1=Rigid3(np.array([m.rotation for m in motions]), unit),
        homography=homographies,
    )


def selected(keypoints, graph):
    return consistent_pairs(
        graph, keypoints, Cameras.from_list([CAMERA]), np.zeros(4, np.int32), MapperConfig()
    )


def other_motion(keypoints, motions, homographies, pair):
    """The second motion that the homography of a pair allows."""
    found = decompose_homography(homographies[pair], CAMERA.K, CAMERA.K, keypoints[PAIRS[pair][0]])
    away = Rotation3(found.cam2_from_cam1.rotation @ motions[pair].rotation.T).angle_rad()
    assert away.min() < 1e-6 and away.max() > np.deg2rad(15)
    return found.cam2_from_cam1[int(np.argmax(away))]


def test_a_plane_gets_the_motion_that_the_other_pairs_confirm(wall):
    keypoints, motions, homographies = wall
    given = list(motions)
    given[5] = other_motion(keypoints, motions, homographies, 5)
    used, contradiction_rad = selected(keypoints, graph_of(given, homographies, PairKind.PLANAR))
    assert np.isnan(contradiction_rad).all() and len(used) == len(PAIRS)
    expected = Rigid3(motions[5].rotation, motions[5].translation / np.linalg.norm(motions[5].translation))
    np.testing.assert_allclose(used.cam2_from_cam1.rotation[5], expected.rotation, atol=1e-9)
    np.testing.assert_allclose(used.cam2_from_cam1.translation[5], expected.translation, atol=1e-9)
    line = np.c_[keypoints[0], np.ones(60)] @ np.linalg.inv(CAMERA.K).T @ used.essential[5].T
    np.testing.assert_allclose(
        (line * (np.c_[keypoints[3], np.ones(60)] @ np.linalg.inv(CAMERA.K).T)).sum(axis=1), 0, atol=1e-9
    )


@pytest.mark.parametrize("kind", [PairKind.PLANAR, PairKind.GENERAL])
def test_a_wrong_pair_without_another_motion_is_dropped(wall, kind):
    keypoints, motions, homographies = wall
    wrong = Rotation3.exp(np.array([0.0, 0.0, 2.0])).matrix
    given = list(motions)
    given[5] = Rigid3(wrong @ motions[5].rotation, motions[5].translation)
    homographies = homographies.copy()
    homographies[5] = CAMERA.K @ wrong @ np.linalg.inv(CAMERA.K)  # a rotation, or no plane
    used, contradiction_rad = selected(keypoints, graph_of(given, homographies, kind))
    assert len(used) == len(PAIRS) - 1
    np.testing.assert_array_equal(np.isfinite(contradiction_rad), np.arange(len(PAIRS)) == 5)
    assert contradiction_rad[5] > 1.0
