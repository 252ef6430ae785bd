"""Resection: the pose of an image from known points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.mapping.model_builder import ModelBuilder
from epipole.optim import BundleConfig, BundleProblem, Loss, adjust_bundle, free_params_mask
from epipole.robust import Estimate, estimate_absolute_pose, estimate_pose_and_focal

MIN_FOCAL_FACTOR = 0.3  # estimated focal lengths below this multiple of the guess are implausible
MAX_FOCAL_FACTOR = 3.3  # likewise, above this multiple


@checked
def resect_image(
    model: ModelBuilder, image: int, config: RansacConfig, *, search_focal: bool
) -> tuple[Estimate, Camera, np.ndarray]:
    """Estimate cam_from_world of an image from the points of its tracks.

    Args:
        model: the growing model; not modified.
        image: index of the image.
        config: threshold in pixels and minimum number of inliers.
        search_focal: estimate the focal length, too: it is a guess that no registered image supports yet.

    Returns:
        The estimate, the camera (with the estimated focal length) and the rows of the correspondences.
    """
    rows, points = model.points_in_sight(image)
    camera = model.camera(int(model.camera_of_image[image]))
    pixels, xyz = model.row_pixel[rows], model.points[points]
    if search_focal:
        return *resect_with_focal(xyz, pixels, camera, config), rows
    return estimate_absolute_pose(xyz, pixels, camera, config), camera, rows


@checked
def resect_with_focal(
    points_in_world: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
    camera: Camera,
    config: RansacConfig,
) -> tuple[Estimate, Camera]:
    """Estimate cam_from_world and the focal length of an image from known points.

    Args:
        points_in_world: the points.
        pixels: their observations.
        camera: intrinsics with a guessed focal length.
        config: threshold in pixels and minimum number of inliers.

    Returns:
        The estimate, and the camera with the estimated focal length; the guess if it cannot be estimated.
    """
    center = camera.params[list(camera.model.principal_point_indices)]
    found = estimate_pose_and_focal(points_in_world, pixels, center, config)
    factor = found.model.focal_px / camera.focal_px
    if found.success and MIN_FOCAL_FACTOR < factor < MAX_FOCAL_FACTOR:
        camera = camera_with_focal(camera, factor)
    estimate = estimate_absolute_pose(points_in_world, pixels, camera, config)
    if not estimate.success:
        return estimate, camera
    focal_only = refine_resection(points_in_world, pixels, estimate, camera, focal=True)
    if focal_only is not None:
        camera = focal_only[1]
        estimate = estimate_absolute_pose(points_in_world, pixels, camera, config)
    return estimate, camera


@checked
def refine_resection(
    points_in_world: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
    estimate: Estimate,
    camera: Camera,
    *,
    focal: bool,
) -> tuple[Rigid3, Camera] | None:
    """Refine a resection (and its focal length) on its inliers with a Cauchy loss; None if it diverges.

    Raises:
        ShapeError: the arrays differ in length.
        ConfigError: the estimate is not one of a pose.
    """
    if not (len(pixels),) == (len(points_in_world),) == np.shape(estimate.inlier_mask):
        raise ShapeError("points_in_world, pixels and estimate.inlier_mask must have the same length")
    if not isinstance(estimate.model, Rigid3):
        raise ConfigError(f"estimate.model must be a Rigid3, got a {type(estimate.model).__name__}")
    inliers = np.flatnonzero(estimate.inlier_mask)
    n = len(inliers)
    start = Rigid3(estimate.model.rotation[None], estimate.model.translation[None])
    zeros = np.zeros(n, np.int32)
    problem = BundleProblem(
        start,
        Rigid3.identity(1),
        np.array([int(camera.model)], np.int32),
        camera.padded_params()[None],
        points_in_world[inliers],
        np.arange(n + 1, dtype=np.int64),
        zeros,
        zeros,
        zeros,
        pixels[inliers],
        np.ones((1, 6)),
        free_params_mask(np.array([int(camera.model)], np.int32), focal=focal, distortion=False),
        np.zeros(n),
    )
    result = adjust_bundle(problem, BundleConfig(loss=Loss.CAUCHY, loss_scale_px=2.0, max_iterations=20))
    params = result.camera_params[0, : camera.model.num_params]
    ratio = params[0] / camera.params[0]
    if not (np.isfinite(result.final_cost) and 0.3 < ratio < 3.0):
        return None
    return result.rig_from_world[0], replace(camera, params=params)


@checked
def camera_with_focal(camera: Camera, factor: float) -> Camera:
    """The camera with its focal lengths multiplied by a factor.

    Raises:
        ConfigError: the factor is not positive.
    """
    if not factor > 0:
        raise ConfigError(f"factor must be positive, got {factor}")
    params = camera.params.copy()
    params[list(camera.model.focal_indices)] *= factor
    return replace(camera, params=params)
