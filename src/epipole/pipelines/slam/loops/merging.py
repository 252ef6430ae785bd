"""Merging of two finished maps that show the same area."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from epipole._checks import check_fields, checked
from epipole.errors import ConfigError
from epipole.geometry import Similarity3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.loops.closing import CONFIRMATIONS, LoopCloser, LoopConstraint
from epipole.pipelines.slam.loops.correction import EDGE_POINTS, LOOP_ITERATIONS, fuse
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.gauge import align_gauge
from epipole.pipelines.slam.map.local_mapping import LocalMapper, focal_baseline_of
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.map.triangulation import positions_of


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """Result of merging two maps."""

    success: bool
    reason: str
    """Why the maps could not be merged; empty if they were."""
    model: SlamMap
    """Both maps in the world of the first; if they could not be merged, a copy of the first."""
    first_from_second: Similarity3
    """From the world of the second map to that of the first; the identity without success."""
    number_offset: int
    """Added to the frame numbers of the second map's keyframes."""

    def __post_init__(self) -> None:
        """Check the types."""
        check_fields(self)

    def __repr__(self) -> str:
        return (
            f"MergedMaps({len(self.model.keyframes)} keyframes)"
            if self.success
            else f"MergedMaps({self.reason})"
        )


@checked
def merge_maps(
    first: SlamMap, second: SlamMap, camera: SlamCamera, config: SlamConfig | None = None
) -> MergedMaps:
    """Merge two maps of one camera, if three successive keyframes of the second are recognized in the first.

    The same tests as for loop closures: matching points, a pose that most of them agree with, patches that look alike there, and no
    other pose that explains the image nearly as well. Then points that both maps have are merged, and everything is adjusted.

    Args:
        first: gives the world and, with one camera, the unit; not changed.
        second: not changed.
        camera: of both maps.
        config: options of tracking and mapping.

    Raises:
        ConfigError: a map is empty, or its images do not have the camera's size.
    """
    for model in (first, second):
        if not any(len(keyframe.point) for keyframe in model.keyframes):
            raise ConfigError("both maps must have keyframes with points")
        if model.keyframes[-1].gray.shape != (camera.camera_or_rig.height, camera.camera_or_rig.width):
            raise ConfigError("the images of a map do not have the camera's size")
    options = (SlamConfig() if config is None else config).odometry
    one, other = first.copied(), second.copied()
    for model in (one, other):
        for keyframe in (k for k in model.keyframes if len(k.point)):
            describe_keyframe(keyframe)
    closer = LoopCloser(camera.camera_or_rig, options, is_metric=camera.is_metric)
    none, identity = (
        1 + max(k.number for k in one.keyframes),
        Similarity3(np.array(1.0), np.eye(3), np.zeros(3)),
    )
    offset = none - min(k.number for k in other.keyframes)
    constraint = _recognized(closer, other, one)
    if constraint is None:
        best = max((entry.num_agreeing for entry in closer.ledger), default=0)
        words = f"no {CONFIRMATIONS} successive keyframes of the second map were recognized in the first (at most {best} points agreed)"
        return MergedMaps(False, words, one, identity, 0)
    second_poses = positions_of(other, range(len(other.keyframes)))
    other.move(constraint.there_from_here)
    for keyframe in other.keyframes:
        keyframe.number += offset
    count = len(one.keyframes)
    one.absorb(other)
    mapper = LocalMapper(one, camera, focal_baseline_of(camera, options), options)
    added = list(range(count, len(one.keyframes)))
    fuse(one, added, camera.camera_or_rig)
    mapper.adjust_all(max_iterations=LOOP_ITERATIONS)
    fuse(one, added, camera.camera_or_rig)
    mapper.adjust_all()
    # The adjustment of one camera's map moves its world.
    if not camera.is_metric:
        one.move(align_gauge(positions_of(one, range(count)), positions_of(first, range(count))))
    shared = [int((np.isin(one.keyframes[k].point, _points_of(one, count))).sum()) for k in added]
    if sum(number >= EDGE_POINTS for number in shared) < CONFIRMATIONS:
        words = f"the maps have too few points in common after merging: at most {max(shared)} in a keyframe"
        return MergedMaps(False, words, first.copied(), identity, 0)
    moved = align_gauge(positions_of(one, added), second_poses).inverse()
    scale = np.array(1.0) if camera.is_metric else moved.scale
    return MergedMaps(True, "", one, Similarity3(scale, moved.rotation, moved.translation), offset)


def _recognized(closer: LoopCloser, here: SlamMap, there: SlamMap) -> LoopConstraint | None:
    """Where one map is first recognized in another; its keyframes are tried as if they came one after the other."""
    growing = copy(here)
    for index, keyframe in enumerate(here.keyframes):
        if not len(keyframe.point):
            continue
        growing.keyframes = here.keyframes[: index + 1]
        found = closer.consider(growing, there)
        if found is not None:
            return found
    return None


def _points_of(model: SlamMap, count: int) -> np.ndarray:
    """Triangulated points that the first keyframes observe."""
    return np.flatnonzero((model.counts(list(range(count))) > 0) & np.isfinite(model.xyz[:, 0]))
