"""Depth, standard deviation and colors of a frame, from its depth sensor or by stereo matching."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.disparity_search.config import DisparityConfig
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.image import undistorted_camera
from epipole.image.undistort import undistortion_map_px
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera

SENSOR_SIGMA = 0.0016
"""Standard deviation of a depth sensor's z is this times z^2, in meters (structured light; Khoshelham and Elberink, Sensors 2012)."""
EDGE = 0.05
"""Relative difference to a neighbor from which a sensor's pixel is at an edge, where it may show a mixture of both sides."""
MOST_SIGMA = 0.02
"""Largest standard deviation, relative to the depth."""


class DepthOfFrame(NamedTuple):
    """Arrays (h, w), and colors (h, w, 3), at the pixels of a pinhole camera; NaN where the depth is unknown."""

    depth: np.ndarray
    """Meters along the optical axis."""
    sigma: np.ndarray
    rgb: np.ndarray


def depth_reader(
    camera: SlamCamera, largest_disparity_px: float, right_shift_px: float
) -> SensorReader | PairReader:
    """The reader for a camera.

    Args:
        camera: the tracked camera, with a depth sensor or a second camera.
        largest_disparity_px: stereo: of the nearest surface.
        right_shift_px: stereo: added to disparities.

    Raises:
        ConfigError: the camera does not measure depth.
    """
    if camera.depth is not None:
        return SensorReader.of(camera.camera, camera.depth)
    if camera.baseline is None:
        raise ConfigError("the camera does not measure depth")
    return PairReader(camera.camera, camera.baseline, largest_disparity_px, right_shift_px)


@dataclass(frozen=True, slots=True, eq=False)
class SensorReader:
    """Depth of a sensor, whose image is undistorted without interpolation: it would mix both sides of edges."""

    color: Camera
    sensor: DepthCamera
    camera: Camera
    """Pinhole camera of the result."""
    source_px: np.ndarray
    """(h, w, 2) column and row in the sensor's image of each pixel, plus one; 0 and the last are outside."""
    rays: np.ndarray
    """(h * w, 3) with z = 1."""

    @staticmethod
    def of(color: Camera, sensor: DepthCamera) -> SensorReader:
        """Prepare the lookup of pixels."""
        raw, flat = sensor.camera, undistorted_camera(sensor.camera)
        at = np.nan_to_num(np.rint(undistortion_map_px(raw, flat)), nan=-1.0)
        inside = np.clip(at, -1, [raw.width, raw.height]).astype(np.int64) + 1
        v, u = np.mgrid[: flat.height, : flat.width].astype(np.float64)
        rays = flat.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        return SensorReader(color, sensor, flat, inside, rays / rays[:, 2:])

    @property
    def depth_from_cam(self) -> Rigid3:
        """From the tracked camera."""
        return self.sensor.depth_from_color

    def read(self, frame: Frame, rgb: np.ndarray) -> DepthOfFrame:
        """Depth of a frame; pixels whose point the mask of the color image `rgb` excludes are unknown."""
        assert frame.depth is not None
        framed = np.pad(frame.depth, 1, constant_values=np.nan)  # what is outside
        raw = framed[self.source_px[..., 1], self.source_px[..., 0]]
        with np.errstate(invalid="ignore"):
            depth = np.where(raw > 0, raw * np.float32(self.sensor.scale), np.float32(np.nan))
        sigma = np.float32(SENSOR_SIGMA) * depth * depth
        colors, is_used = self._colors(frame, rgb, depth)
        return _known(depth, sigma, colors, is_used & np.isfinite(depth) & ~_is_edge(depth))

    def _colors(self, frame: Frame, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 3) color of the point of each pixel in the color image, and whether its mask keeps it; true outside."""
        colors, is_used = np.full((*depth.shape, 3), 128, np.uint8), np.ones(depth.shape, bool)
        rows = np.flatnonzero(np.isfinite(depth))
        points = self.rays[rows] * depth.ravel()[rows, None].astype(np.float64)
        in_cam = self.depth_from_cam.inverse().apply(points)
        pixels = self.color.project(in_cam)
        height, width = rgb.shape[:2]
        inside = (
            (in_cam[:, 2] > 0)
            & (pixels > -0.5).all(axis=1)
            & (pixels < [width - 0.5, height - 0.5]).all(axis=1)
        )
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        colors.reshape(-1, 3)[rows[inside]] = rgb[row, column]
        if frame.ignored_mask is not None:
            is_used.ravel()[rows[inside]] = ~frame.ignored_mask[row, column]
        return colors, is_used


@dataclass(frozen=True, slots=True, eq=False)
class PairReader:
    """Depth of a rectified pair by semi-global matching."""

    camera: Camera
    baseline: float
    largest_disparity_px: float
    right_shift_px: float
    depth_from_cam: Rigid3 = field(default_factory=Rigid3.identity)

    def read(self, frame: Frame, rgb: np.ndarray) -> DepthOfFrame:
        """Depth of a frame with the colors `rgb`; masked pixels are unknown."""
        assert frame.right_gray is not None
        largest = min(int(np.ceil(self.largest_disparity_px)), frame.gray.shape[1] - 1)
        found = match_stereo(frame.gray, frame.right_gray, DisparityConfig(max_disparity_px=largest))
        disparity = found.disparity_px + np.float32(self.right_shift_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.float32(self.camera.focal_px * self.baseline) / disparity
            sigma = depth * found.sigma_px / disparity
            good = np.isfinite(depth) & (disparity > 0)
        if frame.ignored_mask is not None:
            good &= ~frame.ignored_mask
        return _known(depth, sigma, rgb, good)


def _known(depth: np.ndarray, sigma: np.ndarray, rgb: np.ndarray, good: np.ndarray) -> DepthOfFrame:
    nan = np.float32(np.nan)
    with np.errstate(invalid="ignore"):
        good = good & (sigma <= MOST_SIGMA * depth)
    return DepthOfFrame(
        np.where(good, depth, nan).astype(np.float32), np.where(good, sigma, nan).astype(np.float32), rgb
    )


def _is_edge(depth: np.ndarray) -> np.ndarray:
    window, known = np.ones((3, 3), np.uint8), np.isfinite(depth)
    largest = cv2.dilate(np.where(known, depth, np.float32(0.0)), window)
    smallest = cv2.erode(np.where(known, depth, np.float32(1e9)), window)
    return np.asarray(largest > (1.0 + EDGE) * smallest)
