"""Tracked points, and the pose of a frame from them."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.features.flow import track_points
from epipole.geometry import Rigid3
from epipole.mapping import Disparities, RefinedPose, refine_pose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.tracking.pose_search import search_pose
from epipole.pipelines.slam.tracking.projection import depth_of, points_at_depth, project_as
from epipole.scene import CameraRig

COARSE_PX = 15.0
"""Scale of the loss in the first refinement: with the final one a poor prediction ends in a local minimum."""
LEAST_PROVEN = 40
FEW = 2
"""Below this multiple of the minimum number of points, the orientation's uncertainty is checked."""
LARGEST_ROTATION_DEG = 0.75
"""Its largest standard deviation, for a noise of one pixel; beyond it the pose is rejected."""
AGREEING_FRACTION = 0.7
"""With a smaller fraction of inliers the predicted pose is not trusted, and RANSAC searches a new one."""


class Tracks:
    """The tracked points.

    Attributes:
        pixels: (n, 2) in the last image.
        point: (n,) rows of the map's points.
        start_px: (n, 2) in the last keyframe.
    """

    def __init__(self, pixels: np.ndarray, point: np.ndarray, start_px: np.ndarray) -> None:
        self.pixels, self.point, self.start_px = pixels, point, start_px

    def __len__(self) -> int:
        return len(self.point)

    @staticmethod
    def none() -> Tracks:
        """No points."""
        return Tracks(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 2)))

    def keep(self, mask: np.ndarray) -> None:
        """Drop the other points."""
        self.pixels, self.point, self.start_px = self.pixels[mask], self.point[mask], self.start_px[mask]

    def add(self, pixels: np.ndarray, point: np.ndarray) -> None:
        """Start tracking more points."""
        self.join(Tracks(pixels, point, pixels))

    def join(self, others: Tracks) -> None:
        """Add tracks of other points."""
        self.pixels = np.concatenate([self.pixels, others.pixels])
        self.point = np.concatenate([self.point, others.point])
        self.start_px = np.concatenate([self.start_px, others.start_px])

    def keep_first(self, camera: Camera | CameraRig) -> None:
        """Drop duplicate tracks of a point in one camera."""
        keys = [self.point, camera.camera_of(self.pixels)] if isinstance(camera, CameraRig) else [self.point]
        _, first = np.unique(np.stack(keys), axis=1, return_index=True)
        self.keep(np.isin(np.arange(len(self.point)), first))

    def track(
        self,
        before: np.ndarray,
        now: np.ndarray,
        guess: np.ndarray,
        config: OdometryConfig,
        *,
        and_back: bool,
    ) -> None:
        """Find the points in the next image; those that are not found are dropped."""
        pixels, found = track_points(before, now, self.pixels, guess, config, and_back=and_back)
        self.pixels = pixels
        self.keep(found)

    def shift_px(self) -> float:
        """Median motion since the last keyframe, in pixels."""
        return (
            float(np.median(np.linalg.norm(self.pixels - self.start_px, axis=1))) if len(self.pixels) else 0.0
        )


class SeenFrame:
    """A frame's observations of the map.

    Attributes:
        number: frame number.
        timestamp_s: time of the frame.
        pixels: (n, 2) of the inliers.
        point: (n,) their rows.
        disparity_px: (n,) from a depth sensor, NaN for none; None without a sensor.
        motion: (12,) of a rolling-shutter camera, from the neighboring frames; None until these are known.
    """

    def __init__(
        self, timestamp_s: float, pixels: np.ndarray, point: np.ndarray, disparity_px: np.ndarray | None
    ) -> None:
        self.number, self.timestamp_s = -1, timestamp_s
        self.pixels, self.point, self.disparity_px = pixels, point, disparity_px
        self.motion: np.ndarray | None = None


def predict_pixels(
    pixels: np.ndarray, points_in_world: np.ndarray, before: Rigid3, now: Rigid3, camera: Camera | CameraRig
) -> np.ndarray:
    """(n, 2) pixels of points after a motion; untriangulated points are assumed at the median depth of the others."""
    in_cam = now.apply(points_in_world)
    localized = np.isfinite(in_cam[:, 0]) & (depth_of(camera, in_cam, pixels) > 0)
    then = depth_of(camera, before.apply(points_in_world[localized]), pixels[localized])
    depth = np.full(len(pixels), np.median(then) if localized.any() else 1.0)
    motion = now @ before.inverse()
    far = project_as(camera, motion.apply(points_at_depth(camera, pixels, depth, pixels)), pixels)
    known = project_as(camera, np.where(localized[:, None], in_cam, 1.0), pixels)
    guess = np.where(localized[:, None], known, far)
    return np.where(np.asarray(np.isfinite(guess)).all(axis=1, keepdims=True), guess, pixels)


def parallax_px(
    points_in_world: np.ndarray, pixels: np.ndarray, then: Rigid3, now: Rigid3, camera: Camera | CameraRig
) -> float:
    """Median motion of points in the image because the camera has moved between two poses, without that by its rotation; 0 without points."""
    in_cam = now.apply(points_in_world)
    as_from_then = in_cam + now.rotation @ (now.inverse().translation - then.inverse().translation)
    shift = project_as(camera, in_cam, pixels) - project_as(camera, as_from_then, pixels)
    length = np.linalg.norm(shift, axis=1)
    known = length[np.isfinite(length)]
    return float(np.median(known)) if len(known) else 0.0


def locate(
    points_in_world: np.ndarray,
    pixels: np.ndarray,
    camera: Camera | CameraRig,
    predicted: Rigid3,
    disparities: Disparities | None,
    config: OdometryConfig,
    is_proven: np.ndarray | None = None,
) -> tuple[RefinedPose, np.ndarray] | None:
    """The pose of a frame and its inliers; None if there are too few.

    Robust least squares from the predicted pose; if too few points agree, P3P in RANSAC. If there are enough proven points, they
    alone determine the pose: new points may lie on a moving object and outnumber them.
    """
    if is_proven is None or is_proven.sum() < LEAST_PROVEN or is_proven.all():
        return _search(points_in_world, pixels, camera, predicted, disparities, config)
    some = disparities and disparities.rows(is_proven)
    found = _search(points_in_world[is_proven], pixels[is_proven], camera, predicted, some, config)
    if found is None:
        return None
    at = project_as(camera, found[0].cam_from_world.apply(points_in_world), pixels)
    agrees = np.linalg.norm(at - pixels, axis=1) <= config.max_error_px
    some = disparities and disparities.rows(agrees)
    refined = refine_pose(
        points_in_world[agrees], pixels[agrees], camera, found[0].cam_from_world, disparities=some
    )
    agrees[agrees] = refined.error_sq <= config.max_error_px**2
    return (refined, agrees) if agrees.sum() >= config.min_tracked else None


def _search(
    points_in_world: np.ndarray,
    pixels: np.ndarray,
    camera: Camera | CameraRig,
    predicted: Rigid3,
    disparities: Disparities | None,
    config: OdometryConfig,
) -> tuple[RefinedPose, np.ndarray] | None:
    if len(pixels) < config.min_tracked:
        return None
    limit = config.max_error_px**2
    coarse = refine_pose(
        points_in_world, pixels, camera, predicted, disparities=disparities, loss_scale=COARSE_PX
    )
    found = refine_pose(points_in_world, pixels, camera, coarse.cam_from_world, disparities=disparities)
    agrees = found.error_sq <= limit
    if agrees.mean() < AGREEING_FRACTION:
        ransac = RansacConfig(
            max_error_px=config.max_error_px, min_inliers=config.min_tracked, seed=config.seed
        )
        sought = search_pose(points_in_world, pixels, camera, ransac)
        if sought is not None:
            again = refine_pose(points_in_world, pixels, camera, sought, disparities=disparities)
            if (again.error_sq <= limit).sum() > agrees.sum():
                found, agrees = again, again.error_sq <= limit
    return (found, agrees) if agrees.sum() >= config.min_tracked else None


def is_certain(refined: RefinedPose, agrees: np.ndarray, config: OdometryConfig) -> bool:
    """Whether there are many inliers, or few that constrain the orientation well."""
    if agrees.sum() >= FEW * config.min_tracked:
        return True
    variance = np.linalg.eigvalsh(refined.covariance()[3:, 3:])[-1]
    return bool(variance <= np.radians(LARGEST_ROTATION_DEG) ** 2)
