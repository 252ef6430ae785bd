"""Tracking of a single camera in pure rotation: directions are the landmarks, and only the orientation is estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3, skew
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.pipelines.slam.tracking.patches import align_to_reference_patch
from epipole.pipelines.slam.tracking.points import Tracks, predict_pixels
from epipole.pipelines.slam.tracking.redetection import redetect

AGREEING_PX = 0.7
"""Largest error of an inlier. The position error is then below AGREEING_PX / f of the scene depth. Pure rotation gives errors of
0.1 px; translation exceeds the limit at the second frame."""
AGREEING_FRACTION = 0.8
"""Smallest fraction of inliers for which a rotation explains a frame."""
LEAST_POINTS = 40
"""Fewest inliers for which a rotation explains a frame."""
SCALES_PX = (15.0, 5.0, 2.0, 2.0, 2.0)
"""Scales of the Cauchy loss, round by round."""
KEYFRAME_FRACTION, KEYFRAME_SHIFT = 0.7, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class RotationEstimate:
    """A frame of a rotating camera."""

    keyframe: Keyframe
    """The rotation-only keyframe to which the frame is relative."""
    cam_from_world: Rigid3
    covariance: np.ndarray
    """(6, 6); infinite for the translation, which is unobservable without depth."""
    num_points: int
    is_keyframe: bool


class RotationTracker:
    """Tracks directions from a first frame with a given pose.

    Points lie on a unit sphere with all keyframes at its center, so that re-detection works as in any other map.
    """

    def __init__(
        self, frame: Frame, number: int, camera: Camera, config: OdometryConfig, cam_from_world: Rigid3
    ) -> None:
        self.camera, self.config, self.start = camera, config, cam_from_world
        self.keyframes: list[Keyframe] = []
        """The keyframes in the world frame, without points."""
        self._sphere = SlamMap()
        self._tracks = Tracks.none()
        self._cam_from_sphere = Rigid3.identity()
        self._before = frame
        self._num_at_keyframe = 0
        self._insert_keyframe(frame, number)

    @property
    def is_rich(self) -> bool:
        """Whether there are enough points to track."""
        return len(self._tracks) >= LEAST_POINTS

    def track(self, frame: Frame, number: int) -> RotationEstimate | None:
        """The frame's orientation; None if a rotation does not explain it."""
        tracks, camera, position = self._tracks, self.camera, self._cam_from_sphere
        guess = predict_pixels(tracks.pixels, self._sphere.xyz[tracks.point], position, position, camera)
        tracks.track(self._before.gray, frame.gray, guess, self.config, and_back=True)
        tracks.keep(frame.is_used(tracks.pixels))
        self._before = frame
        if not self.is_rich:
            return None
        rays = _unit(camera.unproject(tracks.pixels))
        rotated, _, _ = _fit_rotation(
            self._sphere.xyz[tracks.point], rays, position.rotation, camera.focal_px
        )
        aligned, is_same, _ = align_to_reference_patch(
            self._sphere, camera, frame.gray, Rigid3(rotated, np.zeros(3)), tracks.point, tracks.pixels
        )
        tracks.pixels = aligned
        tracks.keep(is_same)
        return self._answer(frame, number, rotated)

    def _answer(self, frame: Frame, number: int, rotated: np.ndarray) -> RotationEstimate | None:
        tracks, camera = self._tracks, self.camera
        directions, rays = self._sphere.xyz[tracks.point], _unit(camera.unproject(tracks.pixels))
        rotated, off_px, information = _fit_rotation(directions, rays, rotated, camera.focal_px)
        agrees = off_px <= AGREEING_PX
        if agrees.sum() < max(LEAST_POINTS, AGREEING_FRACTION * len(tracks)):
            return None
        tracks.keep(off_px <= self.config.max_error_px)
        self._cam_from_sphere = Rigid3(rotated, np.zeros(3))
        moved = tracks.shift_px() > KEYFRAME_SHIFT * camera.width
        is_keyframe = moved or len(tracks) < KEYFRAME_FRACTION * self._num_at_keyframe
        if is_keyframe:
            self._insert_keyframe(frame, number)
        covariance = np.full((6, 6), np.inf)
        covariance[3:] = covariance[:, 3:] = 0.0
        covariance[3:, 3:] = np.linalg.inv(information)
        position = self._cam_from_sphere @ self.start
        return RotationEstimate(self.keyframes[-1], position, covariance, int(agrees.sum()), is_keyframe)

    def _insert_keyframe(self, frame: Frame, number: int) -> None:
        tracks, camera, sphere = self._tracks, self.camera, self._sphere
        position = self._cam_from_sphere
        tracks.add(*redetect(sphere, camera, frame.gray, position, tracks.point))
        corners = new_corners(frame.gray, tracks.pixels, self.config, frame.ignored_mask)
        directions = _unit(camera.unproject(corners)) @ position.rotation
        fresh = sphere.add_points(directions, corners, len(sphere.keyframes))
        pixels = np.concatenate([tracks.pixels, corners])
        points = np.concatenate([tracks.point, fresh])
        none = np.full(len(points), np.nan)
        seen = Observations(pixels, none, points)
        sphere.keyframes.append(Keyframe(number, frame.timestamp_s, frame.gray, position, seen))
        nothing = Observations(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
        self.keyframes.append(Keyframe(number, frame.timestamp_s, frame.gray, position @ self.start, nothing))
        self._tracks = Tracks(pixels.copy(), points, pixels.copy())
        self._num_at_keyframe = len(points)


def _fit_rotation(
    directions: np.ndarray, rays: np.ndarray, start: np.ndarray, focal_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rotation, errors in pixels, information) that minimizes the sum of Cauchy(f |ray - R direction|).

    Wahba's problem (SIAM Review 1965) solved by SVD (Markley 1988), iteratively reweighted.
    """
    rotated, weight = start, np.ones(len(rays))
    for scale in SCALES_PX:
        off = focal_px * np.linalg.norm(rays - directions @ rotated.T, axis=1)
        weight = 1.0 / (1.0 + (off / scale) ** 2)
        u, _, vt = np.linalg.svd((rays * weight[:, None]).T @ directions)
        rotated = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    off = focal_px * np.linalg.norm(rays - directions @ rotated.T, axis=1)
    jacobian = skew(directions @ rotated.T)
    information = focal_px**2 * np.einsum("n,nki,nkj->ij", weight, jacobian, jacobian)
    return rotated, off, information


def _unit(rays: np.ndarray) -> np.ndarray:
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
