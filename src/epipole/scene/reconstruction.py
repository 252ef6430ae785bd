"""A reconstruction: cameras, rigs, frames, images, points and their tracks, as immutable columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from epipole import _parallel
from epipole._checks import check_fields, check_indices, check_offsets, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Similarity3
from epipole.scene.cameras import Cameras
from epipole.scene.frames import Frames, Rigs
from epipole.scene.georeference import Georeference
from epipole.scene.images import Images
from epipole.scene.notebook import table_html
from epipole.scene.points import Points, Tracks


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A model of a scene. Rows refer to each other by index; -1 means none."""

    cameras: Cameras
    rigs: Rigs
    frames: Frames
    images: Images
    points: Points
    tracks: Tracks
    georeference: Georeference | None = None
    """Position on Earth of the world's origin, if the world coordinates are meters east, north and up; else None."""

    def __post_init__(self) -> None:
        """Check the references between rows.

        Raises:
            ShapeError: an index is out of range, or columns differ in length.
        """
        check_fields(self)
        images, tracks = self.images, self.tracks
        check_offsets(self.rigs.sensor_offsets, "rigs.sensor_offsets", len(self.rigs.sensor_camera))
        check_indices(self.rigs.sensor_camera, "rigs.sensor_camera", len(self.cameras))
        check_indices(self.frames.rig, "frames.rig", len(self.rigs))
        check_indices(images.frame, "images.frame", len(self.frames))
        check_indices(images.sensor, "images.sensor", len(self.rigs.sensor_camera))
        check_offsets(images.keypoint_offsets, "images.keypoint_offsets", len(images.keypoints_px))
        check_offsets(tracks.offsets, "tracks.offsets", len(tracks.image))
        check_indices(tracks.image, "tracks.image", len(images))
        counts = np.diff(images.keypoint_offsets)[tracks.image]
        if not ((tracks.keypoint >= 0) & (tracks.keypoint < counts)).all():
            raise ShapeError("tracks.keypoint refers to a keypoint that does not exist")
        for name, found, wanted in (
            ("points", len(self.points), len(tracks)),
            ("rigs.cam_from_rig", len(self.rigs.cam_from_rig), len(self.rigs.sensor_camera)),
            ("frames.rig_from_world", len(self.frames.rig_from_world), len(self.frames)),
            ("images.frame", len(images.frame), len(images)),
            ("images.keypoint_offsets", len(images.keypoint_offsets), len(images) + 1),
        ):
            if found != wanted:
                raise ShapeError(f"{name} must have {wanted} rows, got {found}")

    @staticmethod
    @checked
    def from_observations(
        cams_from_world: Rigid3,
        cameras: Camera | Sequence[Camera],
        points_in_world: Float64[np.ndarray, "p 3"],
        image: Int64[np.ndarray, " k"],
        point: Int64[np.ndarray, " k"],
        pixels: Float64[np.ndarray, "k 2"],
        names: Sequence[str] | None = None,
    ) -> Reconstruction:
        """Build a model of single images, such as one for `write_colmap_model`.

        Args:
            cams_from_world: pose of each image.
            cameras: one for all images, or one per image.
            points_in_world: points.
            image: image index of each observation, in any order.
            point: point index of each observation.
            pixels: pixel coordinates of each observation.
            names: file names of the images; None: 00000.png, 00001.png and so on.

        Raises:
            ShapeError: array sizes do not match, or an observation refers to a missing image or point.
            ConfigError: the number of cameras is neither one nor that of images, or the number of names differs.
        """
        shape, own = (
            cams_from_world.batch_shape(),
            [cameras] if isinstance(cameras, Camera) else list(cameras),
        )
        if len(shape) != 1:
            raise ShapeError(f"cams_from_world must have a batch of one axis, got {shape}")
        n, files = shape[0], tuple(f"{k:05d}.png" for k in range(shape[0])) if names is None else tuple(names)
        if len(own) not in (1, n) or len(files) != n:
            raise ConfigError(
                f"cameras must be one, or one per image, and names one per image ({n}), "
                f"got {len(own)} and {len(files)}"
            )
        check_indices(image, "image", n)
        check_indices(point, "point", len(points_in_world))
        camera = np.zeros(n, np.int32) if len(own) == 1 else np.arange(n, dtype=np.int32)
        frames = Frames(camera, cams_from_world, np.full(n, np.nan))
        rows = np.lexsort((np.arange(len(image)), image))  # keypoints are sorted by image
        first = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=n))]).astype(np.int64)
        images = Images(files, np.arange(n, dtype=np.int32), camera, first, pixels[rows])
        keypoint = np.empty(len(image), np.int32)
        keypoint[rows] = np.arange(len(image)) - first[image[rows]]
        rows = np.argsort(point, kind="stable")
        seen = np.bincount(point, minlength=len(points_in_world))
        offsets = np.concatenate([[0], np.cumsum(seen)]).astype(np.int64)
        tracks = Tracks(offsets, image[rows].astype(np.int32), keypoint[rows])
        gray = np.full((len(seen), 3), 128, np.uint8)
        points = Points(points_in_world, gray, np.full(len(seen), np.nan))
        rigs = Rigs.of_single_cameras(len(own))
        model = Reconstruction(Cameras.from_list(own), rigs, frames, images, points, tracks)
        total = np.bincount(point[rows], np.nan_to_num(model.reprojection_errors_px()), len(seen))
        error_px = total / np.where(seen > 0, seen, np.nan)
        return replace(model, points=replace(points, error_px=error_px))

    @property
    def camera_of_image(self) -> Int32[np.ndarray, " n"]:
        """Camera row of each image."""
        return self.rigs.sensor_camera[self.images.sensor]

    def is_registered(self) -> Bool[np.ndarray, " n"]:
        """Mask of images with a known pose."""
        return self.frames.is_registered()[self.images.frame]

    def cams_from_world(self) -> Rigid3:
        """cam_from_world = cam_from_rig @ rig_from_world for each image; NaN where not registered."""
        return self.rigs.cam_from_rig[self.images.sensor] @ self.frames.rig_from_world[self.images.frame]

    def camera_centers_in_world(self) -> Float64[np.ndarray, "n 3"]:
        """Center of each image's camera; NaN where not registered."""
        return self.cams_from_world().centers()

    def observed_pixels(self) -> Float64[np.ndarray, "k 2"]:
        """The keypoint of every observation, in track order."""
        return self.images.keypoints_px[self.keypoint_rows()]

    def keypoint_rows(self) -> Int64[np.ndarray, " k"]:
        """Row in `images.keypoints_px` of every observation, in track order."""
        return self.images.keypoint_offsets[self.tracks.image] + self.tracks.keypoint

    def point_of_keypoint(self) -> Int32[np.ndarray, " m"]:
        """The point of each keypoint row, -1 for none."""
        out = np.full(len(self.images.keypoints_px), -1, np.int32)
        out[self.keypoint_rows()] = self.tracks.point_of_observation()
        return out

    def reprojection_errors_px(self) -> Float64[np.ndarray, " k"]:
        """Distance between keypoint and projected point for every observation, in track order.

        NaN where the camera cannot see the point, such as behind it.
        """
        cams_from_world, camera_of_image = self.cams_from_world(), self.camera_of_image
        point, keypoint = self.tracks.point_of_observation(), self.tracks.keypoint
        out = np.full(len(point), np.nan)
        order = np.argsort(self.tracks.image, kind="stable")
        bounds = np.searchsorted(self.tracks.image[order], np.arange(len(self.images) + 1))
        observing = np.flatnonzero(np.diff(bounds)).tolist()

        def measure(index: int) -> None:
            image = observing[index]
            rows = order[bounds[image] : bounds[image + 1]]
            in_cam = cams_from_world[image].apply(self.points.xyz_in_world[point[rows]])
            projected = self.cameras[int(camera_of_image[image])].project(in_cam)
            out[rows] = np.linalg.norm(projected - self.images.keypoints_of(image)[keypoint[rows]], axis=1)

        _parallel.map_items(measure, len(observing))
        return out

    def mean_reprojection_error_px(self) -> float:
        """Mean over all observations except invisible ones; NaN for a model without points."""
        errors = self.reprojection_errors_px()
        errors = errors[np.isfinite(errors)]
        return float(errors.mean()) if len(errors) else float("nan")

    @checked
    def transformed(self, target_from_world: Similarity3) -> Reconstruction:
        """The same model in other coordinates, including the scale of its rigs; without its position on Earth."""
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
            georeference=None,
        )

    def __repr__(self) -> str:
        # Use the stored errors of the points: projecting all of them would make printing slow.
        seen = np.diff(self.tracks.offsets)
        known = np.isfinite(self.points.error_px) & (seen > 0)
        error = ""
        if known.any():
            mean = np.average(self.points.error_px[known], weights=seen[known])
            error = f", mean error {mean:.2f} px"
        return (
            f"Reconstruction({int(self.is_registered().sum())} of {len(self.images)} images registered, "
            f"{len(self.points)} points, {len(self.tracks.image)} observations{error}, "
            f"{len(self.cameras)} cameras)"
        )

    def _repr_html_(self) -> str:
        rows = {
            "images": f"{int(self.is_registered().sum())} of {len(self.images)} registered",
            "points": f"{len(self.points):,}",
            "observations": f"{len(self.tracks.image):,}",
            "cameras": ", ".join(repr(self.cameras[k]) for k in range(min(3, len(self.cameras)))),
        }
        return table_html("Reconstruction", rows)
