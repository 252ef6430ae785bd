"""Bundle adjustment of a growing model: the full model, or the neighborhood of one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, check_index, checked
from epipole.cameras import CameraModel
from epipole.geometry import Rigid3
from epipole.mapping.match_components import rows_of_groups
from epipole.mapping.model_builder import ModelBuilder
from epipole.mapping.point_sample import sample_points
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    BundleResult,
    adjust_bundle,
    free_params_mask,
    with_fixed_gauge,
)
from epipole.scene import Cameras

TRUSTED_FOCAL_SIGMA = (
    0.3  # relative standard deviation of an initial focal length from EXIF, which can be 40 % wrong
)
GUESSED_FOCAL_SIGMA = 0.6  # relative standard deviation of a guessed initial focal length
DISTORTION_SIGMA = 0.1
MOST_SAMPLED = 0.5
"""Fraction of the observations in a sample of the points above which all points are adjusted."""
LARGE = 1_000_000
"""Observations above which the eliminated points are stored in single precision: steps are rounded, the minimum is the same, and these
arrays, the largest of an adjustment, take 100 instead of 200 bytes for each observation."""
POINT_ITERATIONS = 5
"""Steps for the points that are not in the sample, which have three unknowns each."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionPriors(Declared):
    """Prior positions of images (GPS), in the model's world coordinates; NaN rows if unknown."""

    positions_in_world: Float64[np.ndarray, "n 3"]
    sigma: Float64[np.ndarray, "n 3"]
    """Standard deviation of each coordinate."""
    down_in_cams: Float64[np.ndarray, "n 3"] | None = None
    """Unit vectors that point down, in camera coordinates; NaN rows if unknown. Needed if the positions lie on a line:
    they do not determine the rotation about it, along which steps are then too large, and most are rejected."""
    down_sigma_rad: float = 0.02

    def of_bundle(self) -> BundlePriors:
        """The terms of an adjustment: Cauchy's loss of the distances, and the squared errors of the directions."""
        return BundlePriors(
            position_in_world=self.positions_in_world,
            position_sigma=self.sigma,
            down_in_rig=self.down_in_cams,
            down_sigma_rad=self.down_sigma_rad,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PosePriors(Declared):
    """Prior poses of images, in the model's world coordinates; NaN rows if unknown."""

    cams_from_world: Rigid3
    sigma: float
    """Standard deviation of each coordinate of a position, in the model's unit."""
    sigma_rad: float
    """Standard deviation of a rotation about each axis."""

    def of_bundle(self) -> BundlePriors:
        """The term of an adjustment: the squared error of log(pose prior^-1), whose translation is the camera's own shift."""
        is_known = np.isfinite(self.cams_from_world.translation).all(axis=1)
        each = np.repeat([self.sigma**-2, self.sigma_rad**-2], 3)
        return BundlePriors(
            rig_from_world=self.cams_from_world.or_identity(),
            rig_information=is_known[:, None, None] * np.diag(each),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Freedom(Declared):
    """Which intrinsics an adjustment may change, of cameras that are not constant."""

    focal: bool = True
    principal_point: bool = False
    distortion: bool = True


@checked
def free_params_of(cameras: Cameras, freedom: Freedom) -> Float64[np.ndarray, "c 12"]:
    """1 where a camera's parameter may change, else 0."""
    params_free = free_params_mask(
        cameras.model,
        focal=freedom.focal,
        principal_point=freedom.principal_point,
        distortion=freedom.distortion,
    )
    params_free[cameras.is_constant] = 0.0
    return params_free


@checked
def adjust_all(
    model: ModelBuilder,
    config: BundleConfig,
    freedom: Freedom,
    priors: PositionPriors | PosePriors | None = None,
) -> BundleResult:
    """Adjust every registered image, all points, and the intrinsics that are not constant."""
    order, _ = model.rows_by_point()
    images = np.flatnonzero(model.registered)
    return _adjust(model, order, images, np.arange(model.num_points), config, freedom, priors)


@checked
def adjust_sample(
    model: ModelBuilder,
    config: BundleConfig,
    freedom: Freedom,
    priors: PositionPriors | PosePriors | None = None,
) -> None:
    """Adjust as `adjust_all`, with a sample of the points if it is much smaller; then the other points with fixed images.

    Points that show the same parts of the same images as others cost time, and change the images little. The result is for models
    that are adjusted again.
    """
    is_chosen = sample_points(model)
    order, _ = model.rows_by_point()
    is_sampled = is_chosen[model.row_point[order]]
    if is_sampled.sum() > MOST_SAMPLED * len(order):
        adjust_all(model, config, freedom, priors)
        return
    images, every = np.flatnonzero(model.registered), np.arange(model.num_points)
    _adjust(model, order[is_sampled], images, every, config, freedom, priors)
    rest = replace(config, max_iterations=POINT_ITERATIONS)
    none = np.zeros(0, np.int64)
    _adjust(model, order[~is_sampled], none, every, rest, Freedom(focal=False, distortion=False), None)


@checked
def adjust_around(
    model: ModelBuilder, image: int, num_images: int, config: BundleConfig, freedom: Freedom
) -> BundleResult:
    """Adjust an image, those with most points in common, and their points; everything else is fixed.

    Observations of these points in other images are used with fixed poses. Intrinsics are also fixed if images outside
    the neighborhood use them.
    """
    check_index(image, "image", len(model.rows_of_image))
    near = _rows_with_points(model, [image])
    own = model.row_point[model.rows_of_image[image]]
    rows = near[np.isin(model.row_point[near], own[own >= 0])]
    shared = np.bincount(model.row_image[rows], minlength=len(model.registered))
    shared[image] = 0
    neighbors = np.argsort(-shared, kind="stable")[: num_images - 1]
    free = np.concatenate([[image], neighbors[shared[neighbors] > 0]])
    near = _rows_with_points(model, free.tolist())
    seen = model.row_point[np.concatenate([model.rows_of_image[i] for i in free])]
    members = np.unique(seen[seen >= 0])
    rows = near[np.isin(model.row_point[near], members)]
    order = rows[np.argsort(model.row_point[rows], kind="stable")]
    return _adjust(model, order, free, members, config, freedom, None)


def _rows_with_points(model: ModelBuilder, images: Sequence[int]) -> np.ndarray:
    """Rows that have a point, of all components of the images' keypoints, in order: those of the images' points are among them."""
    own = np.concatenate([model.rows_of_image[i] for i in images])
    rows = rows_of_groups(model.components.offsets, np.unique(model.row_component[own]))
    return np.asarray(rows[model.row_point[rows] >= 0])


def _adjust(
    model: ModelBuilder,
    rows: np.ndarray,
    free_images: np.ndarray,
    free_points: np.ndarray,
    config: BundleConfig,
    freedom: Freedom,
    priors: PositionPriors | PosePriors | None,
) -> BundleResult:
    point = model.row_point[rows]
    used, local = np.unique(point, return_inverse=True)
    counts = np.bincount(local, minlength=len(used))
    n = len(model.registered)
    frame_free = np.zeros((n, 6))
    frame_free[free_images] = 1.0
    camera = model.camera_of_image[model.row_image[rows]]
    params_free = free_params_of(model.cameras, freedom)
    serves_others = model.camera_of_image[np.setdiff1d(np.flatnonzero(model.registered), free_images)]
    params_free[np.unique(serves_others)] = 0.0
    positions = Rigid3(model.motion[:, :9].reshape(-1, 3, 3), model.motion[:, 9:]).or_identity()
    expected, sigma = expected_params(model)
    problem = BundleProblem(
        positions,
        Rigid3.identity(1),
        model.cameras.model,
        model.params,
        model.points[used].copy(),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        model.row_image[rows],
        np.zeros(len(rows), np.int32),
        camera,
        model.row_pixel[rows],
        frame_free,
        params_free,
        np.isin(used, free_points).astype(np.float64),
        priors=replace(
            BundlePriors() if priors is None else priors.of_bundle(),
            params_expected=expected,
            params_sigma=sigma,
        ),
    )
    if len(rows) > LARGE:
        config = replace(config, single_precision=True)
    result = adjust_bundle(with_fixed_gauge(problem), config)
    model.set_poses(free_images, result.rig_from_world[free_images])
    model.set_points(used, result.points_in_world, rows)
    model.set_params(result.camera_params)
    return result


@checked
def expected_params(model: ModelBuilder) -> tuple[np.ndarray, np.ndarray]:
    """Prior of the intrinsics, with sigmas: focal length near the initial guess, little distortion.

    It matters only for cameras that see few points.
    """
    cameras = model.cameras
    expected, sigma = cameras.params.copy(), np.full(cameras.params.shape, np.inf)
    for c in range(len(cameras)):
        kind = CameraModel(int(cameras.model[c]))
        for index in kind.focal_indices:
            fraction = TRUSTED_FOCAL_SIGMA if cameras.is_focal_trusted[c] else GUESSED_FOCAL_SIGMA
            sigma[c, index] = fraction * cameras.params[c, index]
        sigma[c, list(kind.distortion_indices)] = DISTORTION_SIGMA
    return expected, sigma
