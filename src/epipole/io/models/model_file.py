"""A model as read from a file, and the parts of which readers put it together."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from epipole._checks import check_fields, checked
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


@dataclass(frozen=True, slots=True, eq=False)
class ModelFile:
    """The content of a model's file."""

    path: Path
    reconstruction: Reconstruction
    warnings: tuple[str, ...] = ()
    """Content of the file that is not part of the reconstruction."""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ConfigError: a field has the wrong type.
        """
        check_fields(self)

    def warned(self) -> Reconstruction:
        """The reconstruction; issues a Python warning for each of the warnings, at the caller of a checked reader."""
        for warning in self.warnings:
            warnings.warn(f"epipole: {self.path}: {warning}", RuntimeWarning, stacklevel=4)
        return self.reconstruction


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Keypoints of images, and the points of which they are images; rows in any order."""

    image: Int64[np.ndarray, " k"]
    feature: Int64[np.ndarray, " k"]
    """Determines the order of an image's keypoints."""
    point: Int64[np.ndarray, " k"]
    """-1 if the keypoint has no point."""
    pixels: Float64[np.ndarray, "k 2"]

    def __post_init__(self) -> None:
        """Check the columns.

        Raises:
            ShapeError: a column has the wrong type or shape.
        """
        check_fields(self)

    @staticmethod
    def none() -> Observations:
        """No observations."""
        empty = np.empty(0, np.int64)
        return Observations(empty, empty, empty, np.empty((0, 2)))


@checked
def model_of_single_images(
    names: Sequence[str],
    cameras: Sequence[Camera],
    camera_rows: Sequence[int],
    cams_from_world: Rigid3,
    points: Points,
    observations: Observations,
) -> Reconstruction:
    """A model without rigs.

    Args:
        names: of the images.
        cameras: the cameras.
        camera_rows: camera of each image.
        cams_from_world: pose of each image.
        points: the points; their errors are computed.
        observations: the keypoints of the images.
    """
    rows = np.array(camera_rows, np.int32)
    frames = Frames(rows, cams_from_world, np.full(len(rows), np.nan))
    images = Images(
        tuple(names),
        np.arange(len(rows), dtype=np.int32),
        rows,
        np.zeros(len(rows) + 1, np.int64),
        np.empty((0, 2)),
    )
    model = Reconstruction(
        Cameras.from_list(cameras),
        Rigs.of_single_cameras(len(cameras)),
        frames,
        images,
        points,
        no_tracks(len(points)),
    )
    return with_observations(model, observations)


def distinct_cameras(cameras: Sequence[Camera]) -> tuple[list[Camera], list[int]]:
    """The different cameras, in the order of their first use, and the row of each camera in that list."""
    rows: dict[tuple[CameraModel, int, int, bytes], int] = {}
    out: list[Camera] = []
    row_of_each = []
    for camera in cameras:
        key = camera.model, camera.width, camera.height, camera.params.tobytes()
        if key not in rows:
            rows[key] = len(out)
            out.append(camera)
        row_of_each.append(rows[key])
    return out, row_of_each


def no_points() -> Points:
    """A cloud without points."""
    return Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0))


def no_tracks(num_points: int) -> Tracks:
    """Empty tracks of points."""
    empty = np.empty(0, np.int32)
    return Tracks(np.zeros(num_points + 1, np.int64), empty, empty)


@checked
def with_observations(model: Reconstruction, observations: Observations) -> Reconstruction:
    """The model with other keypoints and tracks, and with the errors of its points.

    Args:
        model: cameras, poses and points.
        observations: the keypoints of its images.
    """
    num_images, num_points = len(model.images), len(model.points)
    order = np.lexsort((observations.feature, observations.image))
    counts = np.bincount(observations.image, minlength=num_images)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    keypoint = np.empty(len(order), np.int64)
    keypoint[order] = np.arange(len(order)) - offsets[observations.image[order]]
    seen = np.flatnonzero(observations.point >= 0)
    seen = seen[np.lexsort((observations.image[seen], observations.point[seen]))]
    lengths = np.bincount(observations.point[seen], minlength=num_points)
    tracks = Tracks(
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        observations.image[seen].astype(np.int32),
        keypoint[seen].astype(np.int32),
    )
    images = replace(model.images, keypoint_offsets=offsets, keypoints_px=observations.pixels[order])
    out = replace(model, images=images, tracks=tracks)
    with np.errstate(over="ignore", invalid="ignore"):
        total = np.bincount(tracks.point_of_observation(), out.reprojection_errors_px(), num_points)
        error_px = total / np.where(lengths > 0, lengths, np.nan)
    error_px[~np.isfinite(error_px)] = np.nan
    return replace(out, points=replace(out.points, error_px=error_px))
