"""Which frames become keyframes: those in which few of the points are left, or which see them from elsewhere."""

from __future__ import annotations

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.points import Tracks, parallax_px

WHILE_BEHIND = 0.5
"""Factor of the limits of lost points at which a frame becomes a keyframe, while mapping is behind."""


class KeyframeChoice:
    """Compares a frame with the one from which its points are tracked.

    A rotation adds no parallax to the points that stay in the image. It may count only by those that leave it
    (`OdometryConfig.keyframe_rotation`), but not for one camera, whose new points have no depth before a second keyframe sees them,
    and not with an IMU, which is aligned by rotations and motions between near keyframes.

    Attributes:
        counts_rotation: whether motion in the image by rotation counts.
        num_points: triangulated points at the start.
    """

    def __init__(self, config: OdometryConfig, sensor: SlamCamera) -> None:
        self.config, self.camera = config, sensor.camera_or_rig
        self.counts_rotation = config.keyframe_rotation or not sensor.measures_depth
        self.num_points, self._from_keyframe = 1, Rigid3.identity()

    def start(self, model: SlamMap, tracks: Tracks, cam_from_world: Rigid3) -> None:
        """Compare later frames with this one, by its tracks and pose."""
        self.count(model, tracks)
        if not self.counts_rotation:  # relative to the newest keyframe, which moves with the map
            self._from_keyframe = cam_from_world @ _newest_pose(model, cam_from_world).inverse()

    def count(self, model: SlamMap, tracks: Tracks) -> None:
        """Take the number of tracked points, triangulated ones only, for that at the start."""
        self.num_points = max(int(model.is_triangulated(tracks.point).sum()), 1)

    def reason(
        self,
        model: SlamMap,
        tracks: Tracks,
        cam_from_world: Rigid3,
        num_agreeing: int,
        age: int,
        *,
        is_mapping_behind: bool = False,
    ) -> str:
        """Why a frame, `age` frames after the last keyframe, should become one; empty if it need not.

        While mapping is behind, points of new keyframes are not adjusted yet, and tracking them loses points: only a loss of
        about twice as many makes a keyframe, so that keyframes do not cause each other.
        """
        part = WHILE_BEHIND if is_mapping_behind else 1.0
        if num_agreeing < part * self.config.keyframe_fraction * self.num_points:
            return "fewer points in sight"
        if num_agreeing < part * self.config.keyframe_points and age >= 3:
            return "few points in sight"
        if is_mapping_behind:
            return ""
        if self.counts_rotation:
            moved_px = tracks.shift_px()
        else:
            start = self._from_keyframe @ _newest_pose(model, cam_from_world)
            moved_px = parallax_px(model.xyz[tracks.point], tracks.pixels, start, cam_from_world, self.camera)
        if moved_px > self.config.keyframe_motion * self.camera.width:
            return "the points have moved"
        return "time has passed" if age >= self.config.keyframe_gap else ""


def _newest_pose(model: SlamMap, otherwise: Rigid3) -> Rigid3:
    """Pose of the newest keyframe with points; a blank wall gives none."""
    return next((k.cam_from_world for k in reversed(model.keyframes) if len(k.point)), otherwise)
