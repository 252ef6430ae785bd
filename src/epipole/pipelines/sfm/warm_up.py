"""Compile, or load from disk, every kernel of `reconstruct` while images are still being read."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from functools import cache

import numpy as np

from epipole import _jit, _parallel
from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.features import Features, detect_features, match_descriptors, match_near_pixels
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1, fundamental_from_essential
from epipole.mapping import ModelBuilder, connect_matches
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.global_mapper import map_globally
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.robust import PairKind, verify_pair
from epipole.scene import Cameras, ViewGraph

NUM_POINTS = 120
PAIRS = ((0, 1), (0, 2), (1, 2))
_ALONE = "from epipole.pipelines.sfm.warm_up import warm_up_verification; warm_up_verification()"


@cache
def warm_up() -> None:
    """Call every kernel with the types it will see; once per process.

    Without cached kernels, a second process compiles those of two-view geometry at the same time, because Numba
    compiles one function at a time per process. If that fails, they are compiled here.
    """
    helper = None
    if (
        _jit.compiles_on_all_threads()
        and not _jit.is_compiled()
        and _parallel.num_threads() > 1
        and sys.executable
    ):
        with suppress(OSError):
            helper = subprocess.Popen(
                [sys.executable, "-c", _ALONE],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
    warm_up_features()
    warm_up_mapping()
    if helper is not None:
        helper.wait()
    warm_up_verification()
    _jit.mark_compiled()


def warm_up_features() -> None:
    """Features and matching, on noise and on a synthetic scene of three cameras."""
    random = np.random.default_rng(0)
    detect_features(random.integers(0, 255, (48, 64)).astype(np.uint8))
    _camera, _poses, keypoints = _made_up_scene()
    descriptors = random.integers(0, 90, (NUM_POINTS, 128)).astype(np.uint8)
    ones = np.ones(NUM_POINTS, np.float32)
    features = Features(keypoints[0].astype(np.float32), ones, ones, descriptors)
    match_descriptors(descriptors, descriptors)
    match_near_pixels(keypoints[0], descriptors, features, 3.0)


def warm_up_verification() -> None:
    """Essential and fundamental matrices, homographies and rotations, on two views of the synthetic scene."""
    camera, _poses, keypoints = _made_up_scene()
    config = RansacConfig(max_iterations=50)
    for is_calibrated in (False, True):
        verify_pair(keypoints[0], keypoints[1], camera, camera, is_calibrated=is_calibrated, config=config)


def warm_up_mapping() -> None:
    """Both mappers, on the synthetic scene."""
    camera, poses, keypoints = _made_up_scene()
    view_graph = _view_graph(camera, poses)
    components = connect_matches(view_graph, np.arange(4, dtype=np.int64) * NUM_POINTS)
    model = ModelBuilder(Cameras.from_list([camera]), np.zeros(3, np.int32), keypoints, components)
    mapper = IncrementalMapper(model, view_graph, MapperConfig())
    map_globally(mapper, np.ones(3, bool))
    mapper.run(np.ones(3, bool))


def _made_up_scene() -> tuple[Camera, Rigid3, list[np.ndarray]]:
    """A camera, three poses (cam_from_world), and projections of points."""
    random = np.random.default_rng(0)
    camera = Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([500.0, 319.5, 239.5, 0.0]))
    points = random.uniform([-2, -1.5, 4], [2, 1.5, 7], (NUM_POINTS, 3))
    poses = Rigid3.exp(np.array([[-0.8 * k, 0.0, 0.0, 0.0, 0.1 * k, 0.0] for k in range(3)]))
    return camera, poses, [camera.project(poses[k].apply(points)) for k in range(3)]


def _view_graph(camera: Camera, poses: Rigid3) -> ViewGraph:
    n = len(PAIRS)
    i, j = np.array(PAIRS, np.int32).T
    motions = poses[j] @ poses[i].inverse()
    motions = Rigid3(
        motions.rotation, motions.translation / np.linalg.norm(motions.translation, axis=1, keepdims=True)
    )
    essential = essential_from_cam2_from_cam1(motions)
    rows = np.tile(np.arange(NUM_POINTS, dtype=np.int32), n)
    return ViewGraph(
        i.copy(),
        j.copy(),
        np.full(n, int(PairKind.GENERAL), np.int32),
        np.full(n, NUM_POINTS, np.int32),
        np.arange(n + 1, dtype=np.int64) * NUM_POINTS,
        rows,
        rows.copy(),
        motions,
        essential,
        fundamental_from_essential(essential, camera.K, camera.K),
        np.tile(np.eye(3), (n, 1, 1)),
        np.full(n, 0.1),
    )
