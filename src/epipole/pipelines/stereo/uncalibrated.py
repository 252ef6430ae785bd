"""Rectification of two images from unknown cameras by their fundamental matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from epipole.config import RansacConfig
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.features import detect_features, match_descriptors
from epipole.geometry import from_homogeneous, to_homogeneous
from epipole.geometry.rectification import rectifying_homographies
from epipole.robust import estimate_fundamental_matrix

_LEAST_INLIERS = 30  # images of different scenes reach fewer
_BEYOND_PX = 1.0  # smallest disparity of 99.5 % of the matches after the shift

Matrix3 = Float64[np.ndarray, "3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class UncalibratedRectification:
    """Homographies that align the rows of both images; they give no depth."""

    rectified_from_left_px: Matrix3
    rectified_from_right_px: Matrix3
    size: tuple[int, int]
    """Width and height of the rectified images."""
    vertical_px: Float64[np.ndarray, " n"]
    """Vertical offsets of the matches after rectification."""

    @property
    def left_valid(self) -> Bool[np.ndarray, "h w"]:
        """Pixels inside the left image."""
        return self._seen(self.rectified_from_left_px)

    @property
    def right_valid(self) -> Bool[np.ndarray, "h w"]:
        """Pixels inside the right image."""
        return self._seen(self.rectified_from_right_px)

    def _seen(self, rectified_from_px: Matrix3) -> Bool[np.ndarray, "h w"]:
        white = np.full(self.size[::-1], 255, np.uint8)
        return (
            np.asarray(cv2.warpPerspective(white, rectified_from_px, self.size, flags=cv2.INTER_NEAREST)) > 0
        )

    def apply(self, left: Any, right: Any) -> tuple[np.ndarray, np.ndarray]:
        """Both images, resampled (bilinear); black outside the original images."""
        warped = [
            cv2.warpPerspective(np.ascontiguousarray(image), matrix, self.size)
            for image, matrix in (
                (left, self.rectified_from_left_px),
                (right, self.rectified_from_right_px),
            )
        ]
        return warped[0], warped[1]

    def __repr__(self) -> str:
        offset = np.median(np.abs(self.vertical_px))
        return f"UncalibratedRectification({len(self.vertical_px)} matches, rows off by {offset:.2f} px (median))"


def rectify_uncalibrated(left: Any, right: Any, seed: int = 0) -> UncalibratedRectification:
    """Rectify two images from unknown cameras by their fundamental matrix (Hartley, IJCV 1999).

    F is estimated from feature matches; the homographies minimize the distortion around the image center. Without calibration the
    disparities determine depth only up to a projective transformation.

    Args:
        left: (h, w) or (h, w, 3), 8 bits.
        right: the same size.
        seed: random seed of RANSAC.

    Raises:
        DegenerateGeometryError: there are too few matches, or no homographies rectify them (forward motion, a plane,
            pure rotation).
        ShapeError: the images are not 8-bit images of the same size.
    """
    gray = []
    for name, image in (("left", left), ("right", right)):
        array = np.ascontiguousarray(image)
        if array.dtype != np.uint8 or array.ndim not in (2, 3):
            raise ShapeError(f"{name} must be an 8-bit image, got {array.shape} of {array.dtype}")
        gray.append(cv2.cvtColor(array, cv2.COLOR_RGB2GRAY) if array.ndim == 3 else array)
    if gray[0].shape != gray[1].shape:
        raise ShapeError("both images must have the same size")
    one, two = (detect_features(g) for g in gray)
    pairs = match_descriptors(one.descriptors, two.descriptors)
    x1, x2 = one.pixels[pairs[:, 0]].astype(np.float64), two.pixels[pairs[:, 1]].astype(np.float64)
    found = estimate_fundamental_matrix(x1, x2, RansacConfig(seed=seed))
    if not found.success:
        raise DegenerateGeometryError(f"the images give no fundamental matrix: {found.reason.value}")
    good = found.inlier_mask
    if good.sum() < _LEAST_INLIERS:
        raise DegenerateGeometryError(
            f"only {int(good.sum())} matches agree with a fundamental matrix, {_LEAST_INLIERS} are needed: "
            "do the images show the same scene?"
        )
    height, width = gray[0].shape
    left_px, right_px = rectifying_homographies(found.model, x1[good], x2[good], (width, height))
    moved = [
        from_homogeneous(to_homogeneous(x[good]) @ matrix.T) for x, matrix in ((x1, left_px), (x2, right_px))
    ]
    # Shift the left image to the right, so that disparities are positive.
    shift = max(float(np.percentile(moved[1][:, 0] - moved[0][:, 0], 99.5)), 0.0) + _BEYOND_PX
    left_px = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ left_px
    return UncalibratedRectification(left_px, right_px, (width, height), moved[1][:, 1] - moved[0][:, 1])
