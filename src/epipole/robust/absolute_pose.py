"""Robust absolute pose of a camera or a camera rig from known points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, as_points, check_indices, checked, require_same_length
from epipole._checks.arrays import as_array
from epipole.cameras import Camera
from epipole.config import RansacConfig, options_of
from epipole.errors import ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.robust._absolute_pose_kernels import ROWS, AbsolutePoseProblem, pack_rays
from epipole.robust._focal_pose_kernels import FOCAL, FocalPoseProblem
from epipole.robust._rig_pose_kernels import RigPoseProblem, UprightPoseProblem
from epipole.robust.estimate import Estimate, Found, checked_quality, random_order, run_loop, usable_rows


@checked
def estimate_absolute_pose(
    points_in_world: Any,
    pixels: Any,
    camera: Camera,
    config: RansacConfig | None = None,
    *,
    quality: Any = None,
) -> Estimate[Rigid3]:
    """Pose of a calibrated camera: P3P (Ding et al., CVPR 2023), then truncated reprojection error.

    The error is that of the actual camera model, including fisheye, to first order. Points behind the camera are outliers.

    Args:
        points_in_world: (n, 3); rows with NaN or infinity are outliers.
        pixels: their observations in the camera, (n, 2).
        camera: intrinsics, of any model.
        config: threshold in pixels.
        quality: (n,), higher is better; good matches are then sampled first (PROSAC).

    Returns:
        `model` = cam_from_world; `covariance` (6, 6) of xi in exp(xi) @ cam_from_world, xi = (translation, rotation).

    Raises:
        ShapeError: array sizes do not match.
    """
    config = options_of(RansacConfig, config)
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    n = require_same_length(points_in_world=points, pixels=pixels)
    order, items = _pack([camera], Rigid3.identity(1), np.zeros(n, np.int64), points, pixels, config)
    found = run_loop(AbsolutePoseProblem(items), order, n, 1.0, config, checked_quality(quality, n))
    return found.estimate(_motion(found))


@checked
def estimate_rig_pose(
    points_in_world: Any,
    pixels: Any,
    camera_index: Any,
    cameras: Sequence[Camera],
    cams_from_rig: Rigid3,
    config: RansacConfig | None = None,
) -> Estimate[Rigid3]:
    """Pose of a rig of calibrated cameras: three rays of any cameras (gP3P), then truncated reprojection error.

    Args:
        points_in_world: (n, 3); rows with NaN or infinity are outliers.
        pixels: their observations in a camera of the rig, (n, 2).
        camera_index: (n,), camera of each observation.
        cameras: intrinsics, of any models.
        cams_from_rig: batch shape (len(cameras),).
        config: threshold in pixels.

    Returns:
        `model` = rig_from_world; `covariance` (6, 6) of xi in exp(xi) @ rig_from_world.

    Raises:
        ShapeError: array sizes do not match, or an index refers to a missing camera.
    """
    config = options_of(RansacConfig, config)
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    if len(cams_from_rig.batch_shape()) != 1:
        raise ShapeError(f"cams_from_rig must have a batch of one axis, got {cams_from_rig.batch_shape()}")
    index = as_array(camera_index, "camera_index", np.dtype(np.int64))
    if index.ndim != 1:
        raise ShapeError(f"camera_index must be (n,), got {index.shape}")
    n = require_same_length(points_in_world=points, pixels=pixels, camera_index=index)
    if len(cameras) != len(cams_from_rig):
        raise ShapeError(
            f"cams_from_rig must have one row per camera ({len(cameras)}), got {len(cams_from_rig)}"
        )
    check_indices(index, "camera_index", len(cameras))
    order, items = _pack(cameras, cams_from_rig, index, points, pixels, config)
    found = run_loop(RigPoseProblem(items), order, n, 1.0, config, None)
    return found.estimate(_motion(found))


@checked
def estimate_upright_pose(
    points_in_world: Any,
    pixels: Any,
    camera: Camera,
    down_in_cam: Any,
    down_in_world: Any = (0.0, 0.0, -1.0),
    config: RansacConfig | None = None,
) -> Estimate[Rigid3]:
    """Pose of a calibrated camera with a known vertical: two points (uP2P), then truncated reprojection error.

    The vertical (from an accelerometer) is used for sampling only; the refined pose is free of it, so an error of a degree
    costs no accuracy.

    Args:
        points_in_world: (n, 3); rows with NaN or infinity are outliers.
        pixels: their observations in the camera, (n, 2).
        camera: intrinsics, of any model.
        down_in_cam: (3,), gravity in camera coordinates.
        down_in_world: (3,), gravity in world coordinates.
        config: threshold in pixels.

    Returns:
        `model` = cam_from_world; `covariance` (6, 6) of xi in exp(xi) @ cam_from_world.

    Raises:
        ShapeError: array sizes do not match, or a direction is zero.
    """
    config = options_of(RansacConfig, config)
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    n = require_same_length(points_in_world=points, pixels=pixels)
    cam_from_upright = Rotation3(rotate_upright(down_in_cam, "down_in_cam").T)
    upright_from_world = rotate_upright(down_in_world, "down_in_world")
    rotated = Rigid3(cam_from_upright.matrix[None], np.zeros((1, 3)))
    order, items = _pack(
        [camera], rotated, np.zeros(n, np.int64), points @ upright_from_world.T, pixels, config
    )
    found = run_loop(UprightPoseProblem(items), order, n, 1.0, config, None)
    world = Rigid3(upright_from_world, np.zeros(3))
    cam = Rigid3(cam_from_upright.matrix, np.zeros(3))
    adjoint = cam.adjoint()
    covariance = found.covariance
    if np.isfinite(covariance).all():
        covariance = adjoint @ covariance @ adjoint.T
    return found.estimate(cam @ _motion(found) @ world, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class FocalPose:
    """Pose and focal length of a camera."""

    cam_from_world: Rigid3
    focal_px: float


def estimate_pose_and_focal(
    points_in_world: Any, pixels: Any, principal_point: Any, config: RansacConfig | None = None
) -> Estimate[FocalPose]:
    """Pose and focal length of a camera without distortion: four points (P4Pf), then reprojection error.

    Four coplanar points seldom give a solution, so a planar scene may fail with `Reason.NO_MODEL`; a plane parallel to the
    image does not determine the focal length and always fails.

    Args:
        points_in_world: (n, 3); rows with NaN or infinity are outliers.
        pixels: their observations in the camera, (n, 2).
        principal_point: (2,), the image center if nothing better is known.
        config: threshold in pixels.

    Returns:
        `model` = cam_from_world and focal length; `covariance` (7, 7) of xi in exp(xi) @ cam_from_world and the log of the
        focal length.

    Raises:
        ShapeError: array sizes do not match.
    """
    config = options_of(RansacConfig, config)
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    n = require_same_length(points_in_world=points, pixels=pixels)
    center = as_float_array(principal_point, "principal_point", 2, finite=True)
    order = random_order(usable_rows(points, pixels), config)
    middle, size, spread = np.zeros(3), 1.0, 1.0
    if len(order):
        middle = np.median(points[order], axis=0)
        size = float(np.median(np.linalg.norm(points[order] - middle, axis=1))) or 1.0
        spread = float(np.median(np.linalg.norm(pixels[order] - center, axis=1))) or 1.0
    rows = np.concatenate([(points[order] - middle) / size, (pixels[order] - center) / spread], axis=1)
    problem = FocalPoseProblem(np.ascontiguousarray(rows.T))
    found = run_loop(problem, order, n, spread, config, None)
    inner = _motion(found)
    # The loop used (X - middle) / size, so x = R (X - middle) / size + t: multiply by size.
    motion = Rigid3(inner.rotation, size * inner.translation - inner.rotation @ middle)
    # exp(xi) from the left moves camera coordinates, which were divided by size.
    units = np.array([size, size, size, 1.0, 1.0, 1.0, 1.0])
    covariance = units[:, None] * found.covariance * units
    return found.estimate(FocalPose(motion, float(spread * found.raw[FOCAL])), covariance)


def rotate_upright(down: Any, name: str) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that maps `down` to the y axis.

    Raises:
        ShapeError: it is not a single nonzero direction.
    """
    down = as_float_array(down, name, 3, finite=True)
    if down.ndim != 1 or not np.linalg.norm(down) > 0:
        raise ShapeError(f"{name} must be one nonzero direction (3,), got {down}")
    return Rotation3.from_two_vectors(down, np.array([0.0, 1.0, 0.0])).matrix


def _motion(found: Found) -> Rigid3:
    return Rigid3(found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())


def _pack(
    cameras: Sequence[Camera],
    cams_from_rig: Rigid3,
    index: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    config: RansacConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """(order, items): the usable points in random order, in kernel layout."""
    usable = usable_rows(points, pixels)
    order = random_order(usable, config)
    items = np.empty((ROWS, len(order)))
    for c, camera in enumerate(cameras):
        columns = np.flatnonzero(index[order] == c)
        part = items if len(columns) == len(order) else np.empty((ROWS, len(columns)))
        position = np.concatenate([cams_from_rig.rotation[c].ravel(), cams_from_rig.translation[c]])
        pack_rays(int(camera.model), camera.padded_params(), position, points, pixels, order[columns], part)
        if part is not items:
            items[:, columns] = part
    seen = np.isfinite(items).all(axis=0)
    if not seen.all():
        order, items = order[seen], np.ascontiguousarray(items[:, seen])
    return order, items
