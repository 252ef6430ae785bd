"""Loop detection at every keyframe: several keyframes must confirm a loop, and all candidates are logged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rotation3, Similarity3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.loops.recognition import (
    Recognition,
    describe_keyframe,
    is_same_position,
    most_alike,
    recognize,
    rival_of,
)
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.tracking.projection import depth_of
from epipole.scene import CameraRig

CANDIDATES = 3
CONFIRMATIONS = 3
"""Keyframes that must agree on the motion between the two visits."""
PATIENCE = 4
"""Keyframes without confirmation after which a candidate is dropped."""
LOCAL_POINTS = 10
"""Keyframes with this many points in common are neighbors, which are no loop candidates."""
MIN_APART = 10
"""Fewest keyframes between the two visits."""
LARGEST_SCALE = 3.0


@dataclass(frozen=True, slots=True)
class LoopCandidate:
    """Entry of the ledger: an image similar to an earlier one."""

    frame: int
    """Frame number."""
    keyframe: int
    """Frame number of the earlier image."""
    verdict: str
    """accepted, waiting (for confirmation by more keyframes), or rejected."""
    reason: str
    num_matches: int
    num_agreeing: int


@dataclass(frozen=True, slots=True, eq=False)
class LoopConstraint:
    """A confirmed loop: the same scene in one map or in two."""

    there: SlamMap
    keyframe: int
    """Index in `there`."""
    there_from_here: Similarity3
    found: Recognition


@dataclass(slots=True, eq=False)
class _Hypothesis:
    there: SlamMap
    keyframe: int
    there_from_here: Similarity3
    count: int
    age: int


class LoopCloser:
    """Searches loops at every keyframe, in the present map and in maps from before tracking was lost."""

    def __init__(self, camera: Camera | CameraRig, config: OdometryConfig, *, is_metric: bool) -> None:
        self.camera, self.config, self.is_metric = camera, config, is_metric
        self.ledger: list[LoopCandidate] = []
        self._waiting: list[_Hypothesis] = []

    def clear(self) -> None:
        """Drop candidates that wait for confirmation, after the map has changed."""
        self._waiting.clear()

    def move_candidates(self, before: SlamMap, now: SlamMap) -> None:
        """Let candidates in one map be candidates in another, its copy."""
        for hypothesis in self._waiting:
            hypothesis.there = now if hypothesis.there is before else hypothesis.there

    def search(
        self, here: SlamMap, maps: Sequence[SlamMap], is_closed: Callable[[LoopConstraint], bool]
    ) -> bool:
        """Search a loop of the newest keyframe in all maps, until `is_closed` could close one; whether it could."""
        for there in maps:
            constraint = self.consider(here, there)
            if constraint is not None and is_closed(constraint):
                self.clear()
                return True
        return False

    def reject_last(self, reason: str) -> None:
        """Mark the last accepted loop as rejected."""
        self.ledger[-1] = replace(self.ledger[-1], verdict="rejected", reason=reason)

    def consider(self, here: SlamMap, there: SlamMap) -> LoopConstraint | None:
        """The loop between the newest keyframe of `here` and `there`; None until it is confirmed."""
        newest = here.keyframes[-1]
        view = describe_keyframe(newest)
        excluded, unwanted = self._surroundings(here, there)
        for hypothesis in self._waiting:
            hypothesis.age += hypothesis.there is there
        self._waiting = [h for h in self._waiting if h.age <= PATIENCE]
        again = [h.keyframe for h in self._waiting if h.there is there and h.keyframe < len(there.keyframes)]
        alike = [k for k, _ in most_alike(view.descriptor, there, excluded, CANDIDATES)]
        found = [
            recognize(view, there, k, self.camera, self.config, unwanted)
            for k in dict.fromkeys([*alike, *again])
        ]
        plausible = []
        for one in found:
            reason = one.reason or self._implausible(here, there, one)
            if reason:
                self._note(newest, there, one, "rejected", reason)
            else:
                plausible.append(one)
        return self._believe(here, there, plausible)

    def _surroundings(self, here: SlamMap, there: SlamMap) -> tuple[np.ndarray, np.ndarray | None]:
        """Mask of the keyframes of `there` that are neighbors of the newest of `here`, and the points of these."""
        if there is not here:
            return np.zeros(len(there.keyframes), bool), None
        count = len(here.keyframes)
        near = here.num_shared([count - 1]) >= LOCAL_POINTS
        near[max(0, count - MIN_APART) :] = True
        local = [int(k) for k in np.flatnonzero(near)]
        points = np.unique(np.concatenate([here.keyframes[k].point for k in local]))
        excluded = near | (here.num_shared(local) >= LOCAL_POINTS)
        return excluded, points

    def _implausible(self, here: SlamMap, there: SlamMap, found: Recognition) -> str:
        """Why a loop is implausible: it would imply more drift than possible; empty if it is plausible."""
        if there is not here:
            return ""
        trajectory, rotation = _motion_since(here, found.keyframe)
        position = here.keyframes[-1].cam_from_world
        off = float(np.linalg.norm((position @ found.cam_from_world.inverse()).translation))
        rotated = float(
            np.degrees(Rotation3(position.rotation @ found.cam_from_world.rotation.T).angle_rad())
        )
        fraction, depth = (
            (0.06 if self.is_metric else 0.3),
            median_depth(here, here.keyframes[-1], self.camera),
        )
        if off > fraction * trajectory + 0.05 * depth:
            return f"the trajectory of length {trajectory:.3g} since then would have an error of {off:.3g}"
        if rotated > 5.0 + 0.04 * rotation:
            return f"the rotation of {rotation:.0f} degrees since then would have an error of {rotated:.0f}"
        return ""

    def _believe(self, here: SlamMap, there: SlamMap, plausible: list[Recognition]) -> LoopConstraint | None:
        newest = here.keyframes[-1]
        if not plausible:
            return None
        best = max(plausible, key=lambda f: len(f.points))
        if rival_of(best, plausible, there, self.camera) is not None:
            self._note(newest, there, best, "rejected", "two different poses match this image")
            return None
        motion = self._motion(newest, here, there, best)
        if not 1 / LARGEST_SCALE < float(motion.scale) < LARGEST_SCALE:
            self._note(
                newest, there, best, "rejected", f"the scale would change by {float(motion.scale):.3g}"
            )
            return None
        for hypothesis in self._waiting:
            given = hypothesis.there_from_here.move_cam_from_source(newest.cam_from_world)
            if hypothesis.there is there and is_same_position(given, best, there, self.camera):
                hypothesis.count, hypothesis.age = hypothesis.count + 1, 0
                hypothesis.keyframe, hypothesis.there_from_here = best.keyframe, motion
                break
        else:
            hypothesis = _Hypothesis(there, best.keyframe, motion, 1, 0)
            self._waiting.append(hypothesis)
        is_certain = hypothesis.count >= CONFIRMATIONS
        words = f"confirmed by {hypothesis.count} of {CONFIRMATIONS} keyframes"
        self._note(newest, there, best, "accepted" if is_certain else "waiting", words)
        return LoopConstraint(there, best.keyframe, motion, best) if is_certain else None

    def _motion(self, newest: Keyframe, here: SlamMap, there: SlamMap, found: Recognition) -> Similarity3:
        """Motion from the world of `here` to that of `there`; for a single camera the scale comes from the depths of common points."""
        scale = 1.0
        if not self.is_metric:
            rows = paired_rows(newest, found.pixels)
            rows[rows >= 0] = np.where(
                here.is_triangulated(newest.point[rows[rows >= 0]]), rows[rows >= 0], -1
            )
            both = np.flatnonzero(rows >= 0)
            now = newest.cam_from_world.apply(here.xyz[newest.point[rows[both]]])
            then = found.cam_from_world.apply(there.xyz[found.points[both]])
            now, then = (depth_of(self.camera, x, found.pixels[both]) for x in (now, then))
            scale = float(np.median(then / now)) if len(both) >= 5 else 1.0
        rotation, position = found.cam_from_world.rotation.T, newest.cam_from_world
        moved = rotation @ (scale * position.translation - found.cam_from_world.translation)
        return Similarity3(np.array(scale), rotation @ position.rotation, moved)

    def _note(self, newest: Keyframe, there: SlamMap, found: Recognition, verdict: str, reason: str) -> None:
        number = there.keyframes[found.keyframe].number
        self.ledger.append(
            LoopCandidate(newest.number, number, verdict, reason, found.num_matches, len(found.points))
        )


def paired_rows(keyframe: Keyframe, pixels: np.ndarray, radius_px: float = 2.0) -> np.ndarray:
    """(n,) the keyframe's observation nearest to each pixel; -1 if none is within the radius."""
    if not len(keyframe.pixels) or not len(pixels):
        return np.full(len(pixels), -1)
    apart = np.linalg.norm(keyframe.pixels[None] - pixels[:, None], axis=2)
    nearest = apart.argmin(axis=1)
    return np.where(apart[np.arange(len(pixels)), nearest] <= radius_px, nearest, -1)


def _motion_since(model: SlamMap, keyframe: int) -> tuple[float, float]:
    """Length of the trajectory from a keyframe to the newest, and the sum of its rotations in degrees."""
    positions = [k.cam_from_world for k in model.keyframes[keyframe:]]
    steps = [b @ a.inverse() for a, b in pairwise(positions)]
    trajectory = sum(float(np.linalg.norm(s.translation)) for s in steps)
    return trajectory, sum(float(np.degrees(Rotation3(s.rotation).angle_rad())) for s in steps)


def median_depth(model: SlamMap, keyframe: Keyframe, camera: Camera | CameraRig) -> float:
    """Median depth of a keyframe's points; zero if it has none."""
    seen = model.is_triangulated(keyframe.point)
    if not seen.any():
        return 0.0
    in_body = keyframe.cam_from_world.apply(model.xyz[keyframe.point[seen]])
    return float(np.median(depth_of(camera, in_body, keyframe.pixels[seen])))
