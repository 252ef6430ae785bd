"""Effect of calibration errors on depth.

A pixel of the rectified left image and its match are two measured pixels, whose rays intersect elsewhere under a different calibration.
In rectified axes the left ray is (a_l, b_l, 1) and the right one (a_r, b_r, 1) from the center C, so that
    1 / Z = (a_l - a_r) / (C_x - a_r C_z),
which is (d / f) / B for the true calibration. The change of f B / Z under each column of the covariance's root is a disparity error;
they add in quadrature. The error is common to all pixels of a region, so averaging does not reduce it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import map_coordinates

from epipole.disparity_search.rectification import Rectification
from epipole.errors import ShapeError
from epipole.scene import StereoRig

_COLUMNS, _ROWS, _STEPS = 17, 13, 5
_SMALL = 1e-2  # step of the finite differences, in standard deviations


def calibration_sigma(
    rig: StereoRig, rectification: Rectification, disparity_px: Float[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    """Standard deviation of each disparity, in pixels, due to the calibration's covariance; NaN where unknown.

    Interpolated from a grid over image and disparity.

    Raises:
        ShapeError: the rig has no covariance.
    """
    if rig.covariance is None:
        raise ShapeError("the rig has no covariance")
    known = np.isfinite(disparity_px)
    if not known.any():
        return np.full(disparity_px.shape, np.nan)
    width, height = rectification.size
    low, high = float(disparity_px[known].min()), float(disparity_px[known].max()) + 1e-3
    steps = np.linspace(low, high, _STEPS)
    x, y = np.linspace(0, width - 1, _COLUMNS), np.linspace(0, height - 1, _ROWS)
    d, v, u = np.meshgrid(steps, y, x, indexing="ij")
    sigma = _sigma_at(rig, rectification, u.ravel(), v.ravel(), d.ravel()).reshape(_STEPS, _ROWS, _COLUMNS)
    sigma = np.where(np.isfinite(sigma), sigma, np.nanmax(sigma))  # outside the image: the largest value
    rows, columns = np.nonzero(known)
    at = np.stack(
        [
            (disparity_px[known] - low) / (high - low) * (_STEPS - 1),
            rows * (_ROWS - 1) / max(height - 1, 1),
            columns * (_COLUMNS - 1) / max(width - 1, 1),
        ]
    )
    out = np.full(disparity_px.shape, np.nan)
    out[known] = map_coordinates(sigma, at, order=1, mode="nearest")
    return out


def _sigma_at(
    rig: StereoRig, rectification: Rectification, u: np.ndarray, v: np.ndarray, d: np.ndarray
) -> Float64[np.ndarray, " n"]:
    flat = rectification.rig
    left_rays = np.stack(
        [(u - flat.cx) / flat.focal_px, (v - flat.cy) / flat.focal_px, np.ones(len(u))], axis=1
    )
    right_rays = left_rays - np.stack([d / flat.focal_px, 0 * d, 0 * d], axis=1)
    left_px = rig.left.project(left_rays @ rectification.rectified_from_left)
    right_px = rig.right.project(right_rays @ rectification.rectified_from_right)
    usable = np.isfinite(left_px).all(axis=1) & np.isfinite(right_px).all(axis=1)
    covariance = np.asarray(rig.covariance)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    variance = np.zeros(len(u))
    for k in np.flatnonzero(values > 0):
        step = _SMALL * np.sqrt(values[k]) * vectors[:, k]
        ahead, behind = (
            _disparity(rig.perturbed(sign * step), rectification, left_px[usable], right_px[usable])
            for sign in (1.0, -1.0)
        )
        variance[usable] += ((ahead - behind) / (2.0 * _SMALL)) ** 2
    return np.where(usable & np.isfinite(variance), np.sqrt(variance), np.nan)


def _disparity(
    rig: StereoRig, rectification: Rectification, left_px: np.ndarray, right_px: np.ndarray
) -> Float64[np.ndarray, " n"]:
    """Disparity f B / Z of matching pixels, in the axes and with f and B of the rectification."""
    rectified_from_left = rectification.rectified_from_left
    left = rig.left.unproject(left_px) @ rectified_from_left.T
    to_left = rig.right_from_left.inverse()
    right = rig.right.unproject(right_px) @ to_left.rotation.T @ rectified_from_left.T
    center = rectified_from_left @ to_left.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        a_left, a_right = left[:, 0] / left[:, 2], right[:, 0] / right[:, 2]
        inverse_depth = (a_left - a_right) / (center[0] - a_right * center[2])
    return rectification.rig.focal_px * rectification.rig.baseline * inverse_depth
