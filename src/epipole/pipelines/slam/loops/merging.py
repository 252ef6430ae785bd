"""Merging of two finished maps that show the same area."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from epipole._checks import check_fields, checked
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.config import OdometryConfig, SlamConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.loops.closing import CONFIRMATIONS, LoopCandidate, LoopCloser
from epipole.pipelines.slam.loops.correction import EDGE_POINTS, LOOP_ITERATIONS, fuse
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.gauge import align_gauge
from epipole.pipelines.slam.map.local_mapping import LocalMapper, focal_baseline_of
from epipole.pipelines.slam.map.map_copy import OF_MAPPING
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap


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
    """Merge two maps of one camera, if three successive keyframes of one are recognized in the other.

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
    offset = 1 + max(k.number for k in one.keyframes) - min(k.number for k in other.keyframes)
    for keyframe in other.keyframes:
        keyframe.number += offset
    closer = LoopCloser(camera.camera_or_rig, options, is_metric=camera.is_metric)
    found = _merged(one, other, camera, closer)
    if isinstance(found, str):
        return MergedMaps(False, found, first.copied(), Similarity3(np.array(1.0), np.eye(3), np.zeros(3)), 0)
    return MergedMaps(True, "", one, found, offset)


def join_maps(
    first: SlamMap, second: SlamMap, camera: SlamCamera, config: OdometryConfig, ledger: list[LoopCandidate]
) -> str:
    """Move the keyframes and points of a separate map of the same run into the first one, if both show a common area.

    Args:
        first: gives the world and, with one camera, the unit.
        second: empty afterwards.
        camera: of both maps.
        config: options.
        ledger: receives the loop that joins the maps.

    Returns:
        why the maps cannot be merged; empty if they were.
    """
    one, other = first.copied(), second.copied()
    closer = LoopCloser(camera.camera_or_rig, config, is_metric=camera.is_metric)
    found = _merged(one, other, camera, closer)
    if isinstance(found, str):
        return found
    ledger += [entry for entry in closer.ledger if entry.verdict == "accepted"]
    first.absorb(second)
    for own, changed in zip(first.keyframes, one.keyframes, strict=True):
        for name in (*OF_MAPPING, "motion"):
            setattr(own, name, getattr(changed, name))
    for name in ("xyz", "anchor", "anchor_px", "num_agreed"):
        getattr(first, name)[:] = getattr(one, name)
    first.right_shift_px = one.right_shift_px
    return ""


def _merged(one: SlamMap, other: SlamMap, camera: SlamCamera, closer: LoopCloser) -> Similarity3 | str:
    """Move a map into another one, in place: the motion from its world, or why the maps have nothing in common."""
    config = closer.config
    for keyframe in (k for model in (one, other) for k in model.keyframes if len(k.point)):
        describe_keyframe(keyframe)
    one_from_other = _recognized(closer, other, one)
    if one_from_other is None and (back := _recognized(closer, one, other)) is not None:
        one_from_other = back.inverse()
    if one_from_other is None:
        best = max((entry.num_agreeing for entry in closer.ledger), default=0)
        return f"no {CONFIRMATIONS} successive keyframes of one map were recognized in the other (at most {best} points agreed)"
    ours, theirs = list(one.keyframes), list(other.keyframes)
    our_poses, their_poses = _poses(ours), _poses(theirs)
    other.move(one_from_other)
    one.absorb(other)
    row = {id(keyframe): k for k, keyframe in enumerate(one.keyframes)}
    added = [row[id(keyframe)] for keyframe in theirs]
    mapper = LocalMapper(one, camera, focal_baseline_of(camera, config), config)
    fuse(one, added, camera.camera_or_rig)
    mapper.adjust_all(max_iterations=LOOP_ITERATIONS)
    fuse(one, added, camera.camera_or_rig)
    mapper.adjust_all()
    # The adjustment fixes the earliest keyframe only, and nothing of one camera's map.
    if not camera.is_metric or one.keyframes[0] is not ours[0]:
        one.move(align_gauge(_poses(ours), our_poses, with_scale=not camera.is_metric))
    common = _points_of(one, [row[id(keyframe)] for keyframe in ours])
    shared = [int(np.isin(keyframe.point, common).sum()) for keyframe in theirs]
    if sum(number >= EDGE_POINTS for number in shared) < CONFIRMATIONS:
        return f"the maps have too few points in common after merging: at most {max(shared)} in a keyframe"
    moved = align_gauge(_poses(theirs), their_poses).inverse()
    scale = np.array(1.0) if camera.is_metric else moved.scale
    return Similarity3(scale, moved.rotation, moved.translation)


def _poses(keyframes: list[Keyframe]) -> Rigid3:
    return Rigid3.stack([keyframe.cam_from_world for keyframe in keyframes])


def _recognized(closer: LoopCloser, here: SlamMap, there: SlamMap) -> Similarity3 | None:
    """there_from_here, where one map is first recognized in another; its keyframes are tried as if they came one after the other."""
    growing = copy(here)
    for index, keyframe in enumerate(here.keyframes):
        if not len(keyframe.point):
            continue
        growing.keyframes = here.keyframes[: index + 1]
        found = closer.consider(growing, there)
        if found is not None:
            return found.there_from_here
    return None


def _points_of(model: SlamMap, keyframes: list[int]) -> np.ndarray:
    """Triangulated points that these keyframes observe."""
    return np.flatnonzero((model.counts(keyframes) > 0) & np.isfinite(model.xyz[:, 0]))
