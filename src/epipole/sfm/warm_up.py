"""Compile, or load from disk, every kernel of the main job while pictures are still being read."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.config import MapperConfig, RansacConfig
from epipole.features import Features, match_along_epipolar_lines, match_descriptors
from epipole.geometry import Rigid3
from epipole.mapping import ModelBuilder, connect_matches
from epipole.robust import PairGeometry, verify_pair
from epipole.scene import Cameras, ViewGraph
from epipole.sfm.incremental import IncrementalMapper

NUM_POINTS = 120


def warm_up() -> None:
    """Run the stages on a made-up scene of three cameras: each kernel is called with the types it will see."""
    random = np.random.default_rng(0)
    camera = Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([500.0, 319.5, 239.5, 0.0]))
    points = random.uniform([-2, -1.5, 4], [2, 1.5, 7], (NUM_POINTS, 3))
    cams_from_world = Rigid3.exp(np.array([[-0.8 * k, 0.0, 0.0, 0.0, 0.1 * k, 0.0] for k in range(3)]))
    keypoints = [camera.project(cams_from_world[k].apply(points)) for k in range(3)]
    descriptors = random.integers(0, 90, (NUM_POINTS, 128)).astype(np.uint8)
    ones = np.ones(NUM_POINTS, np.float32)
    features = [Features(k.astype(np.float32), ones, ones, descriptors) for k in keypoints]
    match_descriptors(descriptors, descriptors)
    config = RansacConfig(max_iterations=50)
    pairs, found = [(0, 1), (0, 2), (1, 2)], []
    for i, j in pairs:
        verify_pair(keypoints[i], keypoints[j], camera, camera, is_calibrated=False, config=config)
        found.append(
            verify_pair(keypoints[i], keypoints[j], camera, camera, is_calibrated=True, config=config)
        )
    match_along_epipolar_lines(features[0], features[1], found[0].fundamental, 8.0)
    components = connect_matches(_view_graph(pairs, found), np.arange(4, dtype=np.int64) * NUM_POINTS)
    model = ModelBuilder(Cameras.from_list([camera]), np.zeros(3, np.int32), keypoints, components)
    IncrementalMapper(model, _view_graph(pairs, found), MapperConfig()).run(np.ones(3, bool))


def _view_graph(pairs: list[tuple[int, int]], found: list[PairGeometry]) -> ViewGraph:
    n = len(pairs)
    rows = np.tile(np.arange(NUM_POINTS, dtype=np.int32), n)
    return ViewGraph(
        np.array([i for i, _ in pairs], np.int32),
        np.array([j for _, j in pairs], np.int32),
        np.array([int(g.kind) for g in found], np.int32),
        np.full(n, NUM_POINTS, np.int32),
        np.arange(n + 1, dtype=np.int64) * NUM_POINTS,
        rows,
        rows.copy(),
        Rigid3(
            np.stack([g.cam2_from_cam1.rotation for g in found]),
            np.stack([g.cam2_from_cam1.translation for g in found]),
        ),
        np.stack([g.essential for g in found]),
        np.stack([g.fundamental for g in found]),
        np.stack([g.homography for g in found]),
        np.array([g.median_angle_rad for g in found]),
    )
