"""Uncertainty of the focal lengths of a model, from adjustments with more intrinsics free.

The covariance of an adjustment ignores what its camera model lacks: an off-center principal point, further distortion,
rolling shutter. Where these matter, the focal length moves once they are free. Its calibrated uncertainty, to be used as a
standard deviation, is GROWTH times the root sum of squares of the formal standard deviation (Triggs et al. 2000, section 9,
clustered by points) and that move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError
from epipole.mapping.readjustment import bundle_problem_of
from epipole.optim import (
    BundleConfig,
    BundleProblem,
    Loss,
    adjust_bundle,
    bundle_covariance,
    with_fixed_gauge,
    with_result,
)
from epipole.scene import Cameras, Points, Reconstruction, Tracks

GROWTH = 3.0
"""Calibrated on two facades and a rolling-shutter kitchen with known focal lengths (0.04, 0.06, and 3 to 4 % off): errors were
0.5 to 5 times the formal deviation and the move together."""
MAX_SIGMA = 0.02
"""Largest relative uncertainty of a focal length that counts as determined."""
MAX_SHIFT_SIGMAS = 3.0
"""Largest accepted difference between a known focal length and the estimated one."""
MIN_SIGMA = 0.005
"""Lower bound of the relative uncertainty in that comparison."""
MAX_IMAGES = 100  # images used, evenly spread over each camera
MIN_VIEWS = 2  # images that must see a point
MIN_OBSERVATIONS = 100  # per camera
MAX_OBSERVATIONS = 12_000  # used; points are subsampled above this number
ITERATIONS = 60
_OPENCV_LIKE = (
    CameraModel.SIMPLE_PINHOLE,
    CameraModel.PINHOLE,
    CameraModel.SIMPLE_RADIAL,
    CameraModel.RADIAL,
)


@dataclass(frozen=True, slots=True)
class FocalAccuracy:
    """The focal length that fits a model's images best, and its uncertainty."""

    model_px: float
    """Of the model, in pixels."""
    focal_px: float
    """Estimated with a free focal length; close to the model's, unless that was given and is wrong."""
    sigma_px: float
    """Calibrated uncertainty (a standard deviation that includes model errors); infinite if undetermined."""

    @property
    def is_determined(self) -> bool:
        """Whether the images determine the focal length, to within MAX_SIGMA."""
        return self.sigma_px <= MAX_SIGMA * self.focal_px

    @property
    def contradicts_model(self) -> bool:
        """Whether the images contradict the model's focal length."""
        sigma_px = max(self.sigma_px, MIN_SIGMA * self.focal_px)
        return abs(self.focal_px - self.model_px) > MAX_SHIFT_SIGMAS * sigma_px


@checked
def focal_accuracies(model: Reconstruction) -> dict[int, FocalAccuracy]:
    """Focal length uncertainty of each camera of a model that took some of its images.

    Cameras with fewer than MIN_OBSERVATIONS observations in the subsampled model are omitted.
    """
    thin = _thinned(model)
    seen = np.bincount(thin.camera_of_image[thin.tracks.image], minlength=len(model.cameras))
    cameras = np.flatnonzero(seen >= MIN_OBSERVATIONS).tolist()
    if not cameras:
        return {}
    problem = _extended_problem(thin)
    all_extended = [_extended(thin.cameras[c]) for c in range(len(thin.cameras))]
    narrow, problem = _adjusted(problem, all_extended, is_wide=False)
    wide, _ = _adjusted(problem, all_extended, is_wide=True)
    out = {}
    for c in cameras:
        focal_px, formal = narrow[c]
        moved_px, also_formal = wide[c]
        sigma_px = GROWTH * float(np.sqrt(max(formal, also_formal) ** 2 + (moved_px - focal_px) ** 2))
        is_valid = np.isfinite([focal_px, sigma_px]).all() and focal_px > 0
        model_px = model.cameras[c].focal_px
        out[c] = FocalAccuracy(
            model_px, focal_px if is_valid else model_px, sigma_px if is_valid else float("inf")
        )
    return out


def _adjusted(
    problem: BundleProblem, all_extended: list[Camera], *, is_wide: bool
) -> tuple[list[tuple[float, float]], BundleProblem]:
    """Adjust with distortion free; focal length and formal deviation of each camera (NaN and infinite on failure).

    With `is_wide` the principal point and a second distortion term are free, too. Also returns the problem at its minimum.
    """
    free = np.zeros_like(problem.params_free)
    for c, extended in enumerate(all_extended):
        distortion = extended.model.distortion_indices
        free[c, [*extended.model.focal_indices, *distortion[: 2 if is_wide else 1]]] = 1.0
        if is_wide:
            free[c, list(extended.model.principal_point_indices)] = 1.0
    problem = with_fixed_gauge(replace(problem, params_free=free))
    config = BundleConfig(loss=Loss.CAUCHY, max_iterations=ITERATIONS, function_tolerance=1e-5)
    result = adjust_bundle(problem, config)
    there = with_result(problem, result)
    try:
        found = bundle_covariance(there, result, config, clustered=True)
    except DegenerateGeometryError:
        return [(float("nan"), float("inf"))] * len(all_extended), there
    out = []
    for c, extended in enumerate(all_extended):
        rows = list(extended.model.focal_indices)
        variance = float(np.mean(found.camera_params[c][rows, rows]))
        sigma = float(np.sqrt(variance)) if variance >= 0 else float("inf")
        out.append((float(np.mean(result.camera_params[c, rows])), sigma))
    return out, there


def _extended_problem(model: Reconstruction) -> BundleProblem:
    all_extended = [_extended(model.cameras[c]) for c in range(len(model.cameras))]
    return bundle_problem_of(replace(model, cameras=Cameras.from_list(all_extended)))


def _extended(camera: Camera) -> Camera:
    """The same camera with at least two distortion terms."""
    if camera.model not in _OPENCV_LIKE:
        return camera
    center = camera.params[list(camera.model.principal_point_indices)]
    terms = np.zeros(2)
    own = camera.params[list(camera.model.distortion_indices)]
    terms[: len(own)] = own
    if len(camera.model.focal_indices) == 1:
        return Camera("RADIAL", camera.width, camera.height, [camera.focal_px, *center, *terms])
    focal = camera.params[list(camera.model.focal_indices)]
    return Camera("OPENCV", camera.width, camera.height, [*focal, *center, *terms, 0.0, 0.0])


def _thinned(model: Reconstruction) -> Reconstruction:
    """The model with at most MAX_IMAGES images, spread evenly over the cameras, and subsampled points."""
    registered = np.flatnonzero(model.is_registered())
    if len(registered) <= MAX_IMAGES and len(model.tracks.image) <= MAX_OBSERVATIONS:
        return model
    of_point = model.tracks.point_of_observation()
    used = np.isin(model.tracks.image, _even_images(model.camera_of_image[registered], registered))
    count = np.bincount(of_point[used], minlength=len(model.points))
    rows = np.flatnonzero(count >= MIN_VIEWS)
    rows = rows[:: max(1, -(-int(count[rows].sum()) // MAX_OBSERVATIONS))]
    used &= np.isin(of_point, rows)
    offsets = np.concatenate([[0], np.cumsum(count[rows])]).astype(np.int64)
    return replace(
        model,
        points=Points(model.points.xyz_in_world[rows], model.points.rgb[rows], model.points.error_px[rows]),
        tracks=Tracks(offsets, model.tracks.image[used], model.tracks.keypoint[used]),
    )


def _even_images(camera: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Images of each camera in turn, evenly spread within the camera, up to MAX_IMAGES."""
    order = []
    for c in np.unique(camera):
        own = images[camera == c]
        # Bit-reversed order: any first few images are spread evenly.
        spread = np.argsort([int(f"{k:020b}"[::-1], 2) for k in range(len(own))], kind="stable")
        order += [(rank, int(c), int(own[k])) for rank, k in enumerate(np.argsort(spread, kind="stable"))]
    return np.array([image for _, _, image in sorted(order)[:MAX_IMAGES]])
