"""Loop closure: a pose graph distributes the drift over the trajectory, and duplicate points are merged."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from epipole.cameras import Camera
from epipole.geometry import Rigid2, Rigid3, Similarity3
from epipole.optim import PoseGraph, PoseGraphConfig, optimize_pose_graph_robustly
from epipole.pipelines.slam.loops.closing import LoopCloser, LoopConstraint, median_depth, paired_rows
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.map.triangulation import positions_of
from epipole.pipelines.slam.tracking.patches import align_to_reference_patch
from epipole.pipelines.slam.tracking.redetection import redetect
from epipole.scene import CameraRig

LOOP_ITERATIONS = 10
"""Iterations of global bundle adjustment after a loop; after the last frame there are more."""
EDGES_EACH = 5
"""Edges of a keyframe, to those with most points in common."""
EDGE_POINTS = 30
"""Fewest shared points of an edge."""
# Standard deviations of the edges. Drift is systematic and overlapping edges are redundant, so with the actual precision of single
# edges the graph would be too stiff. Drift grows with an edge's length, so its deviation must too: equal deviations would make the
# long edges forbid what the short ones allow.
LENGTH_FRACTION, DEPTH_FRACTION, ROTATION_RAD, SCALE = 0.03, 0.005, 0.01, 0.03
"""As a fraction of the edge's length; and per keyframe spanned, as a fraction of the scene depth, in rotation, and in log scale."""
CONFIDENCE = 1.0 - 1e-9
"""A loop that exceeds these deviations is rejected. The usual confidence is too low, since drift is not noise."""
LOOP_DEPTH_FRACTION, LOOP_ROTATION_RAD, LOOP_SCALE = 0.002, 0.002, 0.01


def close_in_map(mapper: LocalMapper, closer: LoopCloser, constraint: LoopConstraint) -> np.ndarray | None:
    """Correct a map that returns to where it has been; the new row of each point, or None if the pose graph contradicts."""
    if not correct_drift(mapper.map, constraint, mapper.camera, is_metric=mapper.sensor.is_metric):
        closer.reject_last("the pose graph contradicts the loop")
        return None
    return refine_closed(mapper)


def refine_closed(mapper: LocalMapper) -> np.ndarray:
    """After a correction: merge duplicate points and adjust the map; the new row of each point."""
    newest = len(mapper.map.keyframes) - 1
    into = fuse(mapper.map, mapper.window_of(newest)[0][::-1], mapper.camera)
    mapper.adjust_around(newest)
    mapper.adjust_all(max_iterations=LOOP_ITERATIONS)
    return into


def correct_drift(
    model: SlamMap, constraint: LoopConstraint, camera: Camera | CameraRig, *, is_metric: bool
) -> bool:
    """Correct keyframes and points so that the newest keyframe satisfies the loop constraint.

    Pose graph whose edges are the present motions between keyframes with points in common, and the loop, which graduated
    non-convexity may reject. Without metric scale the edges are similarities (Strasdat, Montiel and Davison, RSS 2010).

    Returns:
        whether the loop fits the edges; if not, nothing is changed.
    """
    positions = positions_of(model, range(len(model.keyframes)))
    world_from_cam = positions.inverse()
    first, second = _edges(model)
    newest = len(model.keyframes) - 1
    here = Similarity3(np.array(1.0), world_from_cam.rotation[newest], world_from_cam.translation[newest])
    then = Similarity3(
        np.array(1.0), positions.rotation[constraint.keyframe], positions.translation[constraint.keyframe]
    )
    loop = then @ constraint.there_from_here @ here
    between = positions[first] @ world_from_cam[second]
    depth = _median_depth(model, camera)
    length = np.linalg.norm(between.translation, axis=1)
    deviation = np.empty((len(length) + 1, 7))
    steps = np.minimum(second - first, EDGES_EACH)
    deviation[:-1, :3] = (LENGTH_FRACTION * length + DEPTH_FRACTION * depth * steps)[:, None]
    deviation[:-1, 3:] = steps[:, None] * [ROTATION_RAD, ROTATION_RAD, ROTATION_RAD, SCALE]
    deviation[-1, :3], deviation[-1, 3:] = LOOP_DEPTH_FRACTION * depth, [*3 * [LOOP_ROTATION_RAD], LOOP_SCALE]
    first, second = np.append(first, constraint.keyframe), np.append(second, newest)
    size = 6 if is_metric else 7
    information = np.eye(size) / deviation[:, :size, None] ** 2
    rotation = np.concatenate([between.rotation, loop.rotation[None]])
    translation = np.concatenate([between.translation, loop.translation[None]])
    scale = np.append(np.ones(len(between.translation)), loop.scale)
    is_loop = np.arange(len(first)) == len(first) - 1
    if is_metric:
        graph = PoseGraph(world_from_cam, first, second, Rigid3(rotation, translation), information)
    else:
        ones = Similarity3(np.ones(len(positions)), world_from_cam.rotation, world_from_cam.translation)
        graph = PoseGraph(ones, first, second, Similarity3(scale, rotation, translation), information)
    found = optimize_pose_graph_robustly(graph, is_loop, PoseGraphConfig(confidence=CONFIDENCE))
    if not found.kept_mask[-1]:
        return False
    assert not isinstance(found.world_from_body, Rigid2)
    _move(model, positions, found.world_from_body)
    return True


def _median_depth(model: SlamMap, camera: Camera | CameraRig) -> float:
    depths = [depth for k in model.keyframes if (depth := median_depth(model, k, camera))]
    return float(np.median(depths)) if depths else 1.0


def _edges(model: SlamMap) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (older, newer) of keyframes that are consecutive or share many points."""
    n = len(model.keyframes)
    point = np.concatenate([k.point for k in model.keyframes])
    view = np.repeat(np.arange(n), [len(k.point) for k in model.keyframes])
    seen = csr_array((np.ones(len(point), np.int64), (view, point)), shape=(n, model.num_points))
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    pairs = {(k, k + 1) for k in range(n - 1)}
    for k in range(n):
        best = np.argsort(-shared[k], kind="stable")[:EDGES_EACH]
        pairs |= {(min(k, int(b)), max(k, int(b))) for b in best if shared[k, b] >= EDGE_POINTS}
    first, second = np.array(sorted(pairs), np.int64).reshape(-1, 2).T
    return first, second


def _move(model: SlamMap, before: Rigid3, after: Rigid3 | Similarity3) -> None:
    """Set the keyframes' poses; each point moves with its anchor keyframe."""
    n = len(model.keyframes)
    scale = after.scale if isinstance(after, Similarity3) else np.ones(n)
    moved = Similarity3(scale, after.rotation, after.translation)
    then = Similarity3(np.ones(n), before.rotation, before.translation)
    new_from_old = moved @ then
    model.xyz[:] = new_from_old[model.anchor].apply(model.xyz)
    for k, keyframe in enumerate(model.keyframes):
        keyframe.cam_from_world = Rigid3(after.rotation[k], after.translation[k]).inverse()
        keyframe.unit *= float(scale[k])


def fuse(model: SlamMap, keyframes: list[int], camera: Camera | CameraRig) -> np.ndarray:
    """Add observations of all map points in sight of the keyframes, and merge duplicate points.

    Returns:
        (p,) new row of each of the map's points.
    """
    into = np.arange(model.num_points)
    for k in keyframes:
        keyframe = model.keyframes[k]
        position = keyframe.cam_from_world
        pixels, points = redetect(model, camera, keyframe.gray, position, keyframe.point)
        pixels, is_same, is_stale = align_to_reference_patch(
            model, camera, keyframe.gray, position, points, pixels
        )
        good = is_same & ~is_stale
        pixels, points = pixels[good], points[good]
        rows = paired_rows(keyframe, pixels)
        fresh = rows < 0
        keyframe.add(pixels[fresh], np.full(int(fresh.sum()), np.nan), points[fresh])
        # The older point stays.
        one, other = points[~fresh], keyframe.point[rows[~fresh]]
        pairs = np.stack([np.maximum(one, other), np.minimum(one, other)])
        _, firsts = np.unique(pairs[0], return_index=True)
        gone, kept = pairs[:, firsts]
        is_free = ~np.isin(kept, gone) & model.is_triangulated(kept)
        into = model.merge_points(gone[is_free], kept[is_free])[into]
    return into
