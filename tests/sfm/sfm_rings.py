"""Rings of images with exact tracks, the pairs that see the same points, and mappers of them."""

from dataclasses import replace

import numpy as np

from epipole.geometry import Rigid3, Rotation3, align_points, essential_from_cam2_from_cam1
from epipole.geometry import fundamental_from_essential as fundamental_of
from epipole.mapping import ModelBuilder, connect_matches
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.robust import PairKind
from epipole.scene import Reconstruction, ViewGraph

EXACT = MapperConfig(refine_distortion=False)


def shared_keypoints(model: Reconstruction, i: int, j: int) -> np.ndarray:
    """Rows (keypoint in i, keypoint in j) of the points that both see."""
    point = model.tracks.point_of_observation()
    own = [
        dict(zip(point[rows], model.tracks.keypoint[rows]))
        for rows in (model.tracks.image == i, model.tracks.image == j)
    ]
    common = sorted(own[0].keys() & own[1].keys())
    return np.array([(own[0][p], own[1][p]) for p in common], np.int32).reshape(-1, 2)


def view_graph_of(model: Reconstruction, least: int = 30) -> ViewGraph:
    """All pairs that share points, with their true motions; wide angles for near pairs of the ring."""
    cams, K = model.cams_from_world(), model.cameras[0].K
    pairs, matches, motions, angles = [], [], [], []
    for i in range(len(cams)):
        for j in range(i + 1, len(cams)):
            shared = shared_keypoints(model, i, j)
            if len(shared) >= least:
                motion = cams[j] @ cams[i].inverse()
                motions.append(
                    Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
                )
                pairs.append((i, j))
                matches.append(shared)
                a, b = cams.centers()[[i, j]]
                angles.append(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    flat, n = np.concatenate(matches), len(pairs)
    essential = np.array([essential_from_cam2_from_cam1(m) for m in motions])
    return ViewGraph(
        *np.array(pairs, np.int32).T.copy(),
        kind=np.full(n, PairKind.GENERAL, np.int32),
        num_putative=np.array([len(m) for m in matches], np.int32),
        match_offsets=np.concatenate([[0], np.cumsum([len(m) for m in matches])]).astype(np.int64),
        keypoint1=flat[:, 0].copy(),
        keypoint2=flat[:, 1].copy(),
        cam2_from_cam1=Rigid3(
            np.array([m.rotation for m in motions]), np.array([m.translation for m in motions])
        ),
        essential=essential,
        fundamental=np.array([fundamental_of(E, K, K) for E in essential]),
        homography=np.full((n, 3, 3), np.nan),
        median_angle_rad=np.array(angles),
    )


def mapper_of(model: Reconstruction, graph: ViewGraph, config: MapperConfig = EXACT) -> IncrementalMapper:
    offsets = model.images.keypoint_offsets
    keypoints = [model.images.keypoints_of(i) for i in range(len(model.images))]
    components = connect_matches(graph, offsets)
    cameras = replace(model.cameras, is_constant=np.ones(1, bool))
    return IncrementalMapper(
        ModelBuilder(cameras, model.camera_of_image, keypoints, components), graph, config
    )


def errors_of(mapper: IncrementalMapper, truth: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Distance and turn of each registered image from its true place, up to a similarity."""
    registered = mapper.model.registered
    found, expected = mapper.model.registered_poses(), truth.cams_from_world()[np.flatnonzero(registered)]
    truth_from_found = align_points(found.centers(), expected.centers())
    off = np.linalg.norm(truth_from_found.apply(found.centers()) - expected.centers(), axis=1)
    rotated = expected.rotation @ truth_from_found.rotation @ np.swapaxes(found.rotation, 1, 2)
    return off, Rotation3(rotated).angle_rad()
