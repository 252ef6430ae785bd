"""Two calibrated, rigidly mounted cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import check_fields, checked
from epipole.cameras import MAX_PARAMS, Camera
from epipole.cameras.image_fit import fitted_camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3

RIG_UNKNOWNS = 2 * MAX_PARAMS + 6
_LEAST_BASELINE = 1e-12  # rounding errors of a zero baseline


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """A left and a right camera, of any models and relative pose."""

    left: Camera
    right: Camera
    right_from_left: Rigid3
    """A single motion; its unit of length is that of all depths."""
    covariance: Float64[np.ndarray, "30 30"] | None = None
    """Of (left parameters, right parameters, both padded to 12; xi in exp(xi) @ right_from_left); None: unknown."""

    def __post_init__(self) -> None:
        """Check the shapes, the motion and the baseline.

        Raises:
            ShapeError: the motion is not a single one, or the covariance has the wrong shape.
            ConfigError: the motion is not finite, its rotation is invalid, or the baseline is zero.
        """
        check_fields(self)
        if self.right_from_left.translation.shape != (3,):
            raise ShapeError("right_from_left must be a single motion")
        if self.covariance is not None and self.covariance.shape != (RIG_UNKNOWNS, RIG_UNKNOWNS):
            raise ShapeError(f"covariance must be ({RIG_UNKNOWNS}, {RIG_UNKNOWNS})")
        if self.covariance is not None and not _is_covariance(self.covariance):
            raise ConfigError(
                "covariance is not a covariance matrix: not finite, not symmetric or with negative variances"
            )
        rotation, translation = self.right_from_left.rotation, self.right_from_left.translation
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ConfigError("right_from_left must be finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
            raise ConfigError("right_from_left.rotation is not a rotation matrix: R R^T is not the identity")
        if not self.baseline > _LEAST_BASELINE:
            raise ConfigError("the baseline is zero: both cameras are at the same position")

    @property
    def baseline(self) -> float:
        """Distance between the camera centers."""
        return float(np.linalg.norm(self.right_from_left.translation))

    @checked
    def check_image_sizes(self, left: np.ndarray, right: np.ndarray) -> None:
        """Check the sizes of two images, (h, w) or (h, w, c), against the calibration.

        Raises:
            ShapeError: a size differs.
        """
        for name, image, camera in (("left", left, self.left), ("right", right, self.right)):
            if image.ndim < 2:
                raise ShapeError(f"{name} must be an image (h, w) or (h, w, c), got shape {image.shape}")
            height, width = image.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise ShapeError(
                    f"{name} is {width} x {height} pixels, but its calibration is for {camera.width} x {camera.height}"
                )

    @checked
    def perturbed(self, change: Float64[np.ndarray, " 30"]) -> StereoRig:
        """The rig after a change of its unknowns, in the order of `covariance`."""
        n, m = len(self.left.params), len(self.right.params)
        left = Camera(self.left.model, self.left.width, self.left.height, self.left.params + change[:n])
        right = Camera(
            self.right.model,
            self.right.width,
            self.right.height,
            self.right.params + change[MAX_PARAMS : MAX_PARAMS + m],
        )
        return StereoRig(left, right, Rigid3.exp(change[2 * MAX_PARAMS :]) @ self.right_from_left)

    @checked
    def scaled_to(self, left_size: tuple[int, int], right_size: tuple[int, int]) -> StereoRig:
        """The rig for images resampled to these sizes, with its covariance; itself if they are its own.

        Raises:
            ConfigError: the aspect ratio of an image does not match its camera.
        """
        left, right = fitted_camera(self.left, *left_size), fitted_camera(self.right, *right_size)
        if left is self.left and right is self.right:
            return self
        covariance = self.covariance
        if covariance is not None:
            factors = np.concatenate([_factors(self.left, left), _factors(self.right, right), np.ones(6)])
            covariance = covariance * np.outer(factors, factors)
        return StereoRig(left, right, self.right_from_left, covariance)

    def swapped(self) -> StereoRig:
        """The same rig with left and right exchanged; without covariance."""
        return StereoRig(self.right, self.left, self.right_from_left.inverse())

    def __repr__(self) -> str:
        return f"StereoRig(baseline {self.baseline:.6g}, left {self.left!r}, right {self.right!r})"


def _factors(camera: Camera, scaled: Camera) -> np.ndarray:
    """Scale factor of each parameter's changes when images are scaled, padded."""
    out = np.ones(MAX_PARAMS)
    for index in camera.model.focal_indices:
        out[index] = scaled.params[index] / camera.params[index]
    cx, cy = camera.model.principal_point_indices
    out[cx], out[cy] = scaled.width / camera.width, scaled.height / camera.height
    return out


def _is_covariance(matrix: np.ndarray) -> bool:
    if not np.isfinite(matrix).all() or (np.diag(matrix) < 0).any():
        return False
    size = np.sqrt(np.diag(matrix))
    scaled = matrix / np.maximum(np.outer(size, size), 1e-300)
    kept = size > 0
    if matrix[~kept].any() or np.abs(scaled - scaled.T).max() > 1e-6:
        return False
    return not kept.any() or bool(np.linalg.eigvalsh(scaled[np.ix_(kept, kept)])[0] > -1e-6)
