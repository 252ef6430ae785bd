"""Tracking of a frame in a map: optical flow, alignment to reference patches, and pose estimation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.features.flow import track_points
from epipole.geometry import Rigid3
from epipole.mapping import Disparities, RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame, MovingThing, SlamCamera
from epipole.pipelines.slam.loops.recognition import Recognition
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.shutter.motion import points_by_depth, shutter_shifts, straighten_recent
from epipole.pipelines.slam.shutter.recent_motion import RecentMotion
from epipole.pipelines.slam.shutter.shutter import PREDICTED_SIGMA, UNKNOWN_SIGMA
from epipole.pipelines.slam.tracking.depth import disparities_of
from epipole.pipelines.slam.tracking.frame_quality import shows_something
from epipole.pipelines.slam.tracking.keyframe_choice import KeyframeChoice
from epipole.pipelines.slam.tracking.moving_objects import (
    LEAST_POINTS,
    find_moving_object,
    find_moving_object_in_image,
    off_px_of_scene,
)
from epipole.pipelines.slam.tracking.patches import align_to_reference_patch
from epipole.pipelines.slam.tracking.points import SeenFrame, Tracks, is_certain, locate, predict_pixels
from epipole.pipelines.slam.tracking.projection import stay_in_camera
from epipole.pipelines.slam.tracking.redetection import redetect, search_radius
from epipole.pipelines.slam.tracking.right_image import pose_from_right_image
from epipole.pipelines.slam.tracking.static_points import StaticPart, find_static_part
from epipole.scene import CameraRig

SHUTTER_ROUNDS = 3
"""Alternations between a frame's pose and its motion during the readout."""
STEP_PX = 0.7
"""A moving object moves at least this far from one frame to the next, in pixels."""
PROVEN_FRAMES = 3
"""Frames in which a point must have been an inlier before it determines the pose."""


class PointTracker:
    """Tracks points of one map.

    Attributes:
        tracks: the tracked points.
        stale: rows of those whose appearance has changed since they were first seen.
        moving: moving object in the last frame.
        static_part: the static part of the last image, if it contradicts the motion of the other points.
        waiting: frames whose poses are estimated again when the map has converged.
    """

    def __init__(
        self, model: SlamMap, sensor: SlamCamera, focal_baseline: float | None, config: OdometryConfig
    ) -> None:
        self.map, self.sensor, self.camera, self.config = model, sensor, sensor.camera_or_rig, config
        self.focal_baseline = focal_baseline
        self.tracks = Tracks.none()
        self.stale = np.zeros(0, np.int64)
        self.moving: MovingThing | None = None
        self.static_part: StaticPart | None = None
        self.choice = KeyframeChoice(config, sensor)
        self._pose_before: Rigid3 | None = None
        self._images = (np.zeros((0, 0), np.uint8),) * 2
        """Previous and present image."""
        self._is_checked = True
        """Whether the tracks of the present frame were checked by tracking them back."""
        self.waiting: list[SeenFrame] = []
        self._seen: SeenFrame | None = None

    def track_points(self, previous: Frame, frame: Frame, before: Rigid3, predicted: Rigid3) -> Tracks | None:
        """Find the points by optical flow and align them to their reference patches; those not found are dropped.

        Args:
            previous: the frame before.
            frame: the frame.
            before: cam_from_world of the previous frame.
            predicted: cam_from_world of the frame.

        Returns:
            the points as they were in the previous frame; None if it shows nothing that could be tracked.
        """
        tracks = self.tracks
        self._pose_before, self.map.recent = before, self.map.recent.start_at(previous.timestamp_s)
        last = Tracks(tracks.pixels, tracks.point, tracks.start_px)
        if not shows_something(previous.gray):
            tracks.keep(np.zeros(len(tracks), bool))
            return None
        points = self.map.xyz[tracks.point]
        guess = predict_pixels(tracks.pixels, points, before, predicted, self.camera)
        # With depth, the map's patches check nearly all points below.
        self._is_checked, self._images = self.focal_baseline is None, (previous.gray, frame.gray)
        tracks.track(*self._images, guess, self.config, and_back=self._is_checked)
        tracks.pixels, is_same, is_stale = align_to_reference_patch(
            self.map, self.camera, frame.gray, predicted, tracks.point, tracks.pixels
        )
        self.stale = tracks.point[is_stale]
        tracks.keep(is_same & stay_in_camera(self.camera, tracks.start_px, tracks.pixels))
        return last

    def redetect_points(
        self, previous: Frame, frame: Frame, predicted: Rigid3, tracked: np.ndarray
    ) -> tuple[RefinedPose, int] | None:
        """The pose from all points of the map that should be in sight; from the right image if the left one shows fewer than half of them.

        Args:
            previous: the frame before.
            frame: the frame.
            predicted: cam_from_world.
            tracked: rows of the points that were tracked up to the frame before.
        """
        tracks, near = self.tracks, predicted
        right = pose_from_right_image(
            self.map, self.sensor, (previous, frame), predicted, tracked, self.config
        )
        if right is not None:
            # It predicts the points in the left image to a pixel: near enough for their patches.
            near, seen = right[0].cam_from_world, right[1]
            pixels, is_same, _ = align_to_reference_patch(
                self.map, self.camera, frame.gray, near, seen.point, seen.pixels
            )
            tracks.keep(np.zeros(len(tracks), bool))
            tracks.add(pixels[is_same], seen.point[is_same])
        tracks.add(*redetect(self.map, self.camera, frame.gray, near, tracks.point))
        found = self.estimate_pose(frame, near, at_least=0 if right is None else len(right[1]) // 2)
        if found is not None or right is None:
            return found
        refined, self.tracks = right
        return refined, len(self.tracks)

    def redetect_near(
        self, frame: Frame, cam_from_world: Rigid3, covariance: np.ndarray
    ) -> tuple[RefinedPose, int] | None:
        """The pose from the points of the map in sight of an uncertain pose, searched as far as three standard deviations."""
        self._pose_before, self.tracks = None, Tracks.none()
        reach = search_radius(self.map, self.camera, cam_from_world, covariance)
        self.tracks.add(
            *redetect(self.map, self.camera, frame.gray, cam_from_world, self.tracks.point, reach)
        )
        self.start_from(self.tracks, cam_from_world)
        return self.estimate_pose(frame, cam_from_world)

    def take_up(self, frame: Frame, recognized: Recognition) -> tuple[RefinedPose, int] | None:
        """Start tracking from a relocalized frame; returns its pose."""
        self._pose_before = None
        found = Tracks(recognized.pixels, recognized.points, recognized.pixels)
        self.start_from(found, recognized.cam_from_world)
        return self.estimate_pose(frame, recognized.cam_from_world)

    def estimate_pose(
        self, frame: Frame, predicted: Rigid3, last: Tracks | None = None, *, at_least: int = 0
    ) -> tuple[RefinedPose, int] | None:
        """Estimate the frame's pose and drop outliers.

        Args:
            frame: the images.
            predicted: initial pose.
            last: the same points in the previous frame, if they were tracked from there; needed to detect motion of objects.
            at_least: number of inliers below which there is no pose; some patches match the noise of a dark image.
        """
        tracks, self.moving, self.static_part, self._seen = self.tracks, None, None, None
        tracks.keep(frame.is_used(tracks.pixels))
        localized = np.flatnonzero(self.map.is_triangulated(tracks.point))
        rows, pixels = tracks.point[localized], tracks.pixels[localized]
        deep, measured = None, None
        if frame.depth is not None and self.focal_baseline is not None:
            measured = disparities_of(frame, pixels, np.full(len(pixels), np.nan), self.sensor, self.config)
            deep = Disparities(measured, self.focal_baseline, self.config.depth_sigma_px)
        proven = self.map.num_agreed[rows] >= PROVEN_FRAMES
        found = locate(self.map.xyz[rows], pixels, self.camera, predicted, deep, self.config, proven)
        if found is None or not is_certain(*found, self.config) or found[1].sum() < at_least:
            return None
        if last is not None:
            found, self.static_part = self._unless_at_rest(found, rows, localized, predicted, deep)
        refined, agrees = found
        if self.sensor.shutter.is_rolling:
            refined, agrees = self._while_moving(frame, found, rows, pixels)
        measured = None if measured is None else measured[agrees]
        self._seen = SeenFrame(frame.timestamp_s, pixels[agrees], rows[agrees], measured)
        kept = ~np.isin(np.arange(len(tracks)), localized[~agrees])
        position = refined.cam_from_world
        self.moving = None if last is None else self._what_moves(last, rows, pixels, agrees, position)
        self.map.num_agreed[rows[agrees]] += 1
        tracks.keep(kept)
        return refined, int(agrees.sum())

    def _unless_at_rest(
        self,
        found: tuple[RefinedPose, np.ndarray],
        rows: np.ndarray,
        localized: np.ndarray,
        predicted: Rigid3,
        deep: Disparities | None,
    ) -> tuple[tuple[RefinedPose, np.ndarray], StaticPart | None]:
        """The pose, or that of a camera at rest if a large part of the image is static; and the static part."""
        pixels, pixels_before = self.tracks.pixels[localized], self.tracks.start_px[localized]
        if isinstance(self.camera, CameraRig):
            return found, None
        at = self.camera.project(found[0].cam_from_world.apply(self.map.xyz[rows]))
        errors_px = np.linalg.norm(at - pixels, axis=1)
        static = find_static_part(pixels_before, pixels, errors_px, self.camera)
        if static is None or not static.is_scene:
            return found, static
        points_at_rest, depth_at_rest = self.map.xyz[rows[static.mask]], deep and deep.rows(static.mask)
        at_rest = locate(
            points_at_rest, pixels[static.mask], self.camera, predicted, depth_at_rest, self.config
        )
        if at_rest is None:
            return found, replace(static, is_scene=False)
        agrees = np.zeros(len(rows), bool)
        agrees[static.mask] = at_rest[1]
        return (at_rest[0], agrees), static

    def _while_moving(
        self,
        frame: Frame,
        located: tuple[RefinedPose, np.ndarray],
        points: np.ndarray,
        pixels: np.ndarray,
    ) -> tuple[RefinedPose, np.ndarray]:
        """The pose in the middle of the readout, estimated with the motion, and its inliers; unchanged if these are too few."""
        refined, agreed = located
        shutter, position = self.sensor.shutter, refined.cam_from_world
        for _ in range(SHUTTER_ROUNDS):
            recent = self._recent_at(frame, position, self.map.xyz[points])
            position, motion, error_sq = shutter.refine(
                self.map.xyz[points],
                pixels,
                position,
                recent.newest(),
                sigma=PREDICTED_SIGMA if recent.steps else UNKNOWN_SIGMA,
            )
            self._straighten_start(recent)
        agrees = error_sq <= self.config.max_error_px**2
        if agrees.sum() < self.config.min_tracked:
            self.map.recent = RecentMotion()
            return refined, agreed
        self.map.recent = self._recent_at(frame, position, self.map.xyz[points])
        straighten_recent(self.map, shutter)
        motions = self.map.recent.final_motions()
        for one in self.waiting:
            one.motion = motions.get(one.timestamp_s, one.motion)
        self.map.motion = motion
        return replace(refined, cam_from_world=position), agrees

    def _straighten_start(self, recent: RecentMotion) -> None:
        """Triangulate the first keyframe's points again, now that its motion is known."""
        first, motions = self.map.keyframes[0], recent.final_motions()
        if len(self.map.keyframes) > 1 or self.focal_baseline is None or first.timestamp_s not in motions:
            return
        first.motion = motions[first.timestamp_s]
        seen = Observations(first.pixels, first.disparity_px, first.point)
        most = self.config.max_depth_baselines
        in_cam = points_by_depth(self.map, seen, first.motion, self.sensor, self.focal_baseline, most)
        self.map.xyz[first.point] = first.cam_from_world.inverse().apply(in_cam)
        first.shift_px = shutter_shifts(self.map, first, first.motion, self.sensor.shutter)

    def _recent_at(self, frame: Frame, position: Rigid3, points: np.ndarray) -> RecentMotion:
        """The motion up to a frame with this pose."""
        if self._pose_before is None:
            return RecentMotion().start_at(frame.timestamp_s)
        step, depth = position @ self._pose_before.inverse(), float(np.median(position.apply(points)[:, 2]))
        return self.map.recent.with_step(frame.timestamp_s, step, depth)

    def _what_moves(
        self, last: Tracks, points: np.ndarray, pixels: np.ndarray, agrees: np.ndarray, position: Rigid3
    ) -> MovingThing | None:
        """The moving object in the frame; None with a rolling shutter, whose distortion near the camera looks the same."""
        if self.sensor.shutter.is_rolling or isinstance(self.camera, CameraRig):
            return None
        fresh = ~agrees & (self.map.anchor[points] == len(self.map.keyframes) - 1)
        fresh = self._moving_now(fresh, last, points, pixels, position)
        found = find_moving_object(
            self.map.xyz[points[fresh]], pixels[fresh], self.camera, position, self.config
        )
        if found is None and self.focal_baseline is None:
            return self._image_motion(last, points[agrees], position)
        return found

    def _moving_now(
        self, mask: np.ndarray, last: Tracks, points: np.ndarray, pixels: np.ndarray, position: Rigid3
    ) -> np.ndarray:
        """(n,) masked points that moved independently of the scene since the previous frame; none if fewer than LEAST_POINTS.

        A point that was mismatched once, that an unmodeled distortion displaces, or that slips along the edge of something near,
        does not keep moving, or is not tracked back to where it was.
        """
        out, rows = np.zeros(len(points), bool), np.flatnonzero(mask)
        if self._pose_before is None or len(rows) < LEAST_POINTS:
            return out
        order = np.argsort(last.point)
        then = last.pixels[order[np.searchsorted(last.point, points[rows], sorter=order)]]
        localized = self.map.is_triangulated(points)
        depth = (
            float(np.median(position.apply(self.map.xyz[points[localized]])[:, 2]))
            if localized.any()
            else 1.0
        )
        step = position @ self._pose_before.inverse()
        out[rows] = off_px_of_scene(then, pixels[rows], self.sensor.camera, step, depth) > STEP_PX
        if out.any() and not self._is_checked:
            moved = out[rows]
            out[rows[moved]] = self._returns(pixels[rows[moved]], then[moved])
        return out

    def _returns(self, pixels: np.ndarray, pixels_before: np.ndarray) -> np.ndarray:
        """Whether points are tracked back to where they were in the previous frame."""
        before, now = self._images
        back, found = track_points(now, before, pixels, pixels_before, self.config, and_back=False)
        return found & (np.linalg.norm(back - pixels_before, axis=1) <= self.config.max_return_px)

    def _image_motion(self, last: Tracks, localized: np.ndarray, position: Rigid3) -> MovingThing | None:
        newest = len(self.map.keyframes) - 1
        lacking = ~self.map.is_triangulated(self.tracks.point) & (
            self.map.anchor[self.tracks.point] == newest
        )
        lacking = self._moving_now(lacking, last, self.tracks.point, self.tracks.pixels, position)
        points = self.tracks.point[lacking]
        now_from_then = position @ self.map.keyframes[newest].cam_from_world.inverse()
        depth = float(np.median(position.apply(self.map.xyz[localized])[:, 2]))
        then, now = self.map.anchor_px[points], self.tracks.pixels[lacking]
        return find_moving_object_in_image(
            then, now, self.sensor.camera, now_from_then, depth, self.config.seed
        )

    def remember(self, number: int) -> None:
        """Queue the last localized frame, under this number, for another pose estimate later."""
        if self._seen is not None:
            self._seen.number = number
            self.waiting.append(self._seen)
            self._seen = None

    def rename(self, into: np.ndarray) -> None:
        """Apply a merge of points; of two tracks of the same point, one is kept."""
        self.move_rows(into)
        self.tracks.keep_first(self.camera)

    def move_rows(self, into: np.ndarray) -> None:
        """Renumber points, given the new row of each."""
        self.tracks.point = into[self.tracks.point]
        for seen in self.waiting:
            seen.point = into[seen.point]

    def start_from(self, tracks: Tracks, cam_from_world: Rigid3) -> None:
        """Replace the tracks by those of a frame with this pose."""
        self.tracks, self.stale = tracks, np.zeros(0, np.int64)
        self.choice.start(self.map, tracks, cam_from_world)

    def start_from_keyframe(self, keyframe: Keyframe) -> None:
        """Track all points of a keyframe from its pixels."""
        tracks = Tracks(keyframe.pixels.copy(), keyframe.point.copy(), keyframe.pixels.copy())
        self.start_from(tracks, keyframe.cam_from_world)

    def track_added(self, added: Observations, last: Frame, cam_from_world: Rigid3) -> None:
        """Track points that the newest keyframe has received from there to the last frame, whose pose is given."""
        keyframe = self.map.keyframes[-1]
        tracks = Tracks(added.pixels, added.point, added.pixels)
        if last.timestamp_s > keyframe.timestamp_s:
            # With all points of the keyframe: untriangulated ones are assumed at the median depth of the others.
            points, then = self.map.xyz[keyframe.point], keyframe.cam_from_world
            guess = predict_pixels(keyframe.pixels, points, then, cam_from_world, self.camera)
            own = guess[len(guess) - len(tracks) :]  # the added ones are the last
            tracks.track(keyframe.gray, last.gray, own, self.config, and_back=True)
        self.tracks.join(tracks)
        self.tracks.keep_first(self.camera)  # some may have been detected again meanwhile
        self.choice.count(self.map, self.tracks)

    def track_points_in_sight(self, frame: Frame, position: Rigid3) -> None:
        """Start tracking all points of the map that are in sight."""
        tracks = self.tracks
        tracks.add(*redetect(self.map, self.camera, frame.gray, position, tracks.point))
        self.start_from(Tracks(tracks.pixels, tracks.point, tracks.pixels.copy()), position)

    def remove_outliers(self) -> None:
        """Stop tracking points whose observation in the newest keyframe was removed as an outlier."""
        newest, tracks = self.map.keyframes[-1], self.tracks
        if not isinstance(self.camera, CameraRig):
            tracks.keep(np.isin(tracks.point, newest.point))
            return
        count = len(self.camera.cameras)
        seen = count * newest.point + self.camera.camera_of(newest.pixels)
        tracks.keep(np.isin(count * tracks.point + self.camera.camera_of(tracks.pixels), seen))
