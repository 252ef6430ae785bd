"""Rectification of two pinhole views to the part that both see, with the reference view on the left."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole.cameras import Camera
from epipole.dense.view import DenseView
from epipole.errors import DegenerateGeometryError

WIDEST = 2.0
"""Tangent of the largest angle from the rectified axis: a plane cannot show 90 degrees."""
LEAST_SIDEWAYS = 0.35
"""Smallest sine of the angle between the baseline and both optical axes."""
MOST_DISPARITIES = 384
"""Larger ranges are matched at a lower resolution."""
MOST_GROWTH = 2.0
"""Largest ratio of rectified to original pixels."""
LEAST_SIDE_PX = 32
BORDER = 17
"""Rays along each side of an image."""

Matrix3 = Float64[np.ndarray, "3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedPair(Declared):
    """Homographies to a pair of images with common rows, in which disparities start at zero.

    A point at inverse depth q = 1/z of the reference view is at disparity d = q / (n . r) - d0 of the rectified pair, with the ray
    r = (x, y, 1) of its pixel in the reference camera.
    """

    reference_from_rectified: Matrix3
    """Maps rectified pixels (x, y, 1) to pixels of the reference image."""
    source_from_rectified: Matrix3
    size: tuple[int, int]
    """Width and height."""
    num_disparities: int
    first_disparity_px: float
    """d0: disparity of zero in the cropped images."""
    inverse_depth_of_ray: Float64[np.ndarray, " 3"]
    """n: the inverse depth of a pixel is (d + d0) (n . r)."""

    def apply(self, reference: np.ndarray, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both images (gray, 8 bits), resampled; the border is replicated outside the original images."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        one, two = (
            cv2.warpPerspective(image, matrix, self.size, None, flags, cv2.BORDER_REPLICATE)
            for image, matrix in (
                (reference, self.reference_from_rectified),
                (source, self.source_from_rectified),
            )
        )
        return np.asarray(one), np.asarray(two)


@checked
def rectify_views(
    reference: DenseView, source: DenseView, depths: tuple[float, float], phase_px: float = 0.0
) -> RectifiedPair:
    """Rectify two views for depths within a range (Fusiello, Trucco and Verri 2000, with the mean of both optical axes).

    The x axis is along the baseline, from the reference to the source, whatever the direction: rectified images may be upside down.

    Args:
        reference: the view whose depth is wanted.
        source: the other view.
        depths: smallest and largest depth in the reference view.
        phase_px: fraction of a pixel by which disparities are shifted. Errors of subpixel positions are periodic in the disparity, so
            sources with different phases do not share them.

    Raises:
        DegenerateGeometryError: there is no baseline, it is along the viewing direction, or the views have no part in common.
    """
    source_from_reference = source.cam_from_world @ reference.cam_from_world.inverse()
    toward = -source_from_reference.rotation.T @ source_from_reference.translation
    baseline = float(np.linalg.norm(toward))
    if not baseline > 1e-9 * depths[0]:
        raise DegenerateGeometryError("both views are at the same position")
    x = toward / baseline
    rotation = _rectifying_rotation(x, source_from_reference.rotation)
    rotations = rotation, rotation @ source_from_reference.rotation.T
    one, two = (_extent(view.camera, own) for view, own in zip((reference, source), rotations))
    # Depth along the rectified axis differs from that along the reference's; the corners of the image bound it.
    ratios = _axis_ratios(reference.camera, rotation)
    near, far = depths[0] * ratios[0], depths[1] * ratios[1]
    shifts = baseline / far, baseline / near  # disparities on the plane z = 1
    # Both images have the same width, so the left border leaves room for the match of the first pixel at the largest disparity.
    left = max(one[0] - (shifts[1] - shifts[0]), two[0] + shifts[0])
    right = min(one[1], two[1] + shifts[1])
    top, bottom = max(one[2], two[2]), min(one[3], two[3])
    if right <= left or bottom <= top:
        raise DegenerateGeometryError("the views have no part in common")
    focal = _focal(reference.camera, (right - left) * (bottom - top), shifts)
    size = round(focal * (right - left)), round(focal * (bottom - top))
    if min(size) < LEAST_SIDE_PX:
        raise DegenerateGeometryError("the views have no part in common")
    first = focal * shifts[0] - phase_px
    K = np.array([[focal, 0.0, -focal * left - 0.5], [0.0, focal, -focal * top - 0.5], [0.0, 0.0, 1.0]])
    shifted = K + np.array([[0.0, 0.0, first], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    homographies = [
        view.camera.K @ own.T @ np.linalg.inv(matrix)
        for view, own, matrix in zip((reference, source), rotations, (K, shifted))
    ]
    return RectifiedPair(
        homographies[0],
        homographies[1],
        size,
        int(np.ceil(focal * (shifts[1] - shifts[0]) + phase_px)) + 1,
        first,
        rotation[2] / (focal * baseline),
    )


def _rectifying_rotation(x: np.ndarray, source_rotation: np.ndarray) -> np.ndarray:
    """Rows: the axes of the rectified cameras in the reference's frame."""
    axes = np.array([0.0, 0.0, 1.0]), source_rotation[2]
    if min(np.linalg.norm(np.cross(x, axis)) for axis in axes) < LEAST_SIDEWAYS:
        raise DegenerateGeometryError("the baseline is along the viewing direction")
    z = axes[0] + axes[1]
    z = z - (z @ x) * x
    if np.linalg.norm(z) < LEAST_SIDEWAYS:
        raise DegenerateGeometryError("the views look in opposite directions")
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _border_rays(camera: Camera) -> np.ndarray:
    """(n, 3) rays along the border of an image, with z = 1."""
    x, y = np.linspace(-0.5, camera.width - 0.5, BORDER), np.linspace(-0.5, camera.height - 0.5, BORDER)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    border = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    rays = camera.unproject(border)
    return np.asarray(rays / rays[:, 2:])


def _extent(camera: Camera, rectified_from_cam: np.ndarray) -> tuple[float, float, float, float]:
    """(smallest x, largest x, smallest y, largest y) of an image on the plane z = 1."""
    rays = _border_rays(camera) @ rectified_from_cam.T
    if not (rays[:, 2] > 0).any():
        raise DegenerateGeometryError("the views have no part in common")
    bounded = np.clip(rays[:, :2] / np.maximum(rays[:, 2:], 1e-9), -WIDEST, WIDEST)
    (low_x, low_y), (high_x, high_y) = bounded.min(axis=0), bounded.max(axis=0)
    return float(low_x), float(high_x), float(low_y), float(high_y)


def _axis_ratios(camera: Camera, rotation: np.ndarray) -> tuple[float, float]:
    """Smallest and largest ratio of depth along the rectified axis to depth along the camera's."""
    ratios = _border_rays(camera) @ rotation[2]
    return float(max(ratios.min(), 0.2)), float(max(ratios.max(), 0.2))


def _focal(camera: Camera, area: float, shifts: tuple[float, float]) -> float:
    """The reference's focal length, less if the images or the range of disparities would become too large."""
    most = np.sqrt(MOST_GROWTH * camera.width * camera.height / area)
    return float(min(camera.focal_px, most, MOST_DISPARITIES / (shifts[1] - shifts[0])))
