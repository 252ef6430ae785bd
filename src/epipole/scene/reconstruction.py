"""A reconstruction: cameras, rigs, frames, images, points and their tracks, as frozen columns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from epipole.geometry import Rigid3, Similarity3
from epipole.scene.cameras import Cameras
from epipole.scene.frames import Frames, Rigs
from epipole.scene.images import Images
from epipole.scene.points import Points, Tracks


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Everything known about a scene. Rows refer to each other by position; -1 means none."""

    cameras: Cameras
    rigs: Rigs
    frames: Frames
    images: Images
    points: Points
    tracks: Tracks

    @property
    def camera_of_image(self) -> Int32[np.ndarray, " n"]:
        """Camera row of each image."""
        return self.rigs.sensor_camera[self.images.sensor]

    def is_registered(self) -> Bool[np.ndarray, " n"]:
        """Mask of images whose place is known."""
        return self.frames.is_registered()[self.images.frame]

    def cams_from_world(self) -> Rigid3:
        """cam_from_world = cam_from_rig @ rig_from_world for each image; NaN where not registered."""
        return self.rigs.cam_from_rig[self.images.sensor] @ self.frames.rig_from_world[self.images.frame]

    def camera_centers_in_world(self) -> Float64[np.ndarray, "n 3"]:
        """Centre of each image's camera; NaN where not registered."""
        return self.cams_from_world().centers()

    def observed_pixels(self) -> Float64[np.ndarray, "k 2"]:
        """The keypoint of every observation, in track order."""
        return self.images.keypoints_px[self.keypoint_rows()]

    def keypoint_rows(self) -> Int64[np.ndarray, " k"]:
        """Row in `images.keypoints_px` of every observation, in track order."""
        return self.images.keypoint_offsets[self.tracks.image] + self.tracks.keypoint

    def point_of_keypoint(self) -> Int32[np.ndarray, " m"]:
        """The point that each keypoint row sees, -1 for none."""
        out = np.full(len(self.images.keypoints_px), -1, np.int32)
        out[self.keypoint_rows()] = self.tracks.point_of_observation()
        return out

    def reprojection_errors_px(self) -> Float64[np.ndarray, " k"]:
        """Distance between keypoint and projected point for every observation, in track order.

        NaN where the camera cannot see the point, for one behind it.
        """
        cams_from_world, camera_of_image = self.cams_from_world(), self.camera_of_image
        points, pixels = self.points.xyz_in_world[self.tracks.point_of_observation()], self.observed_pixels()
        out = np.full(len(pixels), np.nan)
        for image in np.unique(self.tracks.image):
            rows = np.flatnonzero(self.tracks.image == image)
            in_cam = cams_from_world[image].apply(points[rows])
            projected = self.cameras[int(camera_of_image[image])].project(in_cam)
            out[rows] = np.linalg.norm(projected - pixels[rows], axis=1)
        return out

    def mean_reprojection_error_px(self) -> float:
        """Mean over all observations but those that the camera cannot see; NaN for a model without points."""
        errors = self.reprojection_errors_px()
        errors = errors[np.isfinite(errors)]
        return float(errors.mean()) if len(errors) else float("nan")

    def transformed(self, target_from_world: Similarity3) -> Reconstruction:
        """The same model in other coordinates. Rigs scale with it."""
        rig_from_target = target_from_world.move_cam_from_source(self.frames.rig_from_world)
        cam_from_rig = Rigid3(
            self.rigs.cam_from_rig.rotation,
            self.rigs.cam_from_rig.translation * float(target_from_world.scale),
        )
        return replace(
            self,
            rigs=replace(self.rigs, cam_from_rig=cam_from_rig),
            frames=replace(self.frames, rig_from_world=rig_from_target),
            points=replace(self.points, xyz_in_world=target_from_world.apply(self.points.xyz_in_world)),
        )

    def __repr__(self) -> str:
        # The points' own errors, which are there already: projecting all of them would make printing slow.
        seen = np.diff(self.tracks.offsets)
        known = np.isfinite(self.points.error_px) & (seen > 0)
        error = ""
        if known.any():
            mean = np.average(self.points.error_px[known], weights=seen[known])
            error = f", mean error {mean:.2f} px"
        return (
            f"Reconstruction({int(self.is_registered().sum())} of {len(self.images)} images placed, "
            f"{len(self.points)} points, {len(self.tracks.image)} observations{error}, "
            f"{len(self.cameras)} cameras)"
        )
