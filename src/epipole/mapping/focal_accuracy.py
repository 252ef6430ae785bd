"""How well a model determines the focal lengths of its cameras: it is adjusted again with more of each lens free.

The covariance of an adjustment knows nothing of what its lenses lack: a principal point off the middle, a further distortion
term, rows that are read one after another. Where these matter, the focal length moves once they are free. Its standard deviation
is taken as GROWTH times both together: the formal one (Triggs et al. 2000, section 9, clustered by points) and that move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from epipole._declared import checked
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
"""On two facades, and a kitchen with a rolling shutter, whose focal lengths are known (0.04, 0.06, and 3 to 4 % off), errors were 0.5 to 5
times the formal deviation and the move together."""
MAX_SIGMA = 0.02
"""Of a focal length that counts as determined, in units of itself."""
MAX_SHIFT_SIGMAS = 3.0
"""Between a known focal length and the one that the images agree with."""
MIN_SIGMA = 0.005
"""Assumed at least for that comparison, in units of the focal length."""
MAX_IMAGES, MIN_VIEWS, MIN_OBSERVATIONS = 100, 2, 100
"""Images looked at (evenly, of each camera), images that see a point, and observations of a camera."""
MAX_OBSERVATIONS = 12_000
"""Looked at: of more, every so-many-th point."""
ITERATIONS = 60
_OPENCV_LIKE = (
    CameraModel.SIMPLE_PINHOLE,
    CameraModel.PINHOLE,
    CameraModel.SIMPLE_RADIAL,
    CameraModel.RADIAL,
)


@dataclass(frozen=True, slots=True)
class FocalAccuracy:
    """The focal length that a model's images agree with best, and how well they determine it."""

    model_px: float
    """Of the model."""
    focal_px: float
    """Once it is free; near the model's, unless that was known and is wrong."""
    sigma_px: float
    """Standard deviation; infinite where it is not determined at all."""

    @property
    def is_determined(self) -> bool:
        """Whether the images determine the focal length, to MAX_SIGMA."""
        return self.sigma_px <= MAX_SIGMA * self.focal_px

    @property
    def contradicts_model(self) -> bool:
        """Whether the images agree with another focal length than the model's."""
        sigma_px = max(self.sigma_px, MIN_SIGMA * self.focal_px)
        return abs(self.focal_px - self.model_px) > MAX_SHIFT_SIGMAS * sigma_px


@checked
def focal_accuracies(model: Reconstruction) -> dict[int, FocalAccuracy]:
    """How well a model determines the focal length of each camera that took some of its images.

    Cameras with fewer than MIN_OBSERVATIONS observations in the images that are looked at are left out.
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
    """Focal length and formal deviation of each camera (NaN, infinite where it fails), adjusted with its distortion.

    With `is_wide` the principal point and a second distortion term are free, too. The problem at its minimum comes with it.
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
    """The same camera with at least two terms of distortion."""
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
    """The model with at most MAX_IMAGES of its images, as many of each camera in turn, and an even part of their points."""
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
    """Images in turn of each camera, evenly spread within it, until there are MAX_IMAGES."""
    order = []
    for c in np.unique(camera):
        own = images[camera == c]
        # Halves, quarters and so on: the first few are spread as evenly as all.
        spread = np.argsort([int(f"{k:020b}"[::-1], 2) for k in range(len(own))], kind="stable")
        order += [
            (rotation, int(c), int(own[k])) for rotation, k in enumerate(np.argsort(spread, kind="stable"))
        ]
    return np.array([image for _, _, image in sorted(order)[:MAX_IMAGES]])
