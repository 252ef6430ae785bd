"""Triangulation of rows of points against the interpreter."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.robust import PointReason, triangulate, triangulate_points
from epipole.robust import _triangulation_kernels as kernels
from kernel_references import assert_same_as_python, record_calls, reference_of

PINHOLE = Camera(CameraModel.PINHOLE, 1280, 960, np.array([800.0, 810.0, 639.5, 479.5]))
LENSES = {
    "radial": Camera(CameraModel.RADIAL, 1280, 960, np.array([700.0, 650.0, 470.0, -0.08, 0.01])),
    "fisheye": Camera(
        CameraModel.OPENCV_FISHEYE, 1280, 960, np.array([400.0, 410.0, 640.0, 480.0, 0.01, 0, 0, 0])
    ),
    "none": PINHOLE,
}


def pixels_of(rng: np.random.Generator, cams: Rigid3, cameras: list[Camera], count: int) -> np.ndarray:
    """Noisy pixels, of which some are NaN, at infinity, wrong, or of a point so far that rays are parallel."""
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    points[3:4] = (1.0, 2.0, 1e9)
    pixels = np.stack([c.project(cams[k].apply(points)) for k, c in enumerate(cameras)])
    pixels += 0.7 * rng.normal(size=pixels.shape)
    pixels[:, 3:4] -= 0.7
    pixels[0, 1:2], pixels[-1, 2:3], pixels[0, 4:5] = np.nan, np.inf, 1e9
    pixels[-1, 5:6] += [-400.0, 300.0]
    return pixels


@pytest.mark.parametrize("camera", list(LENSES))
@reference_of(kernels.triangulate_two_views)
def test_two_views(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, camera: str) -> None:
    calls = record_calls(monkeypatch, triangulate, kernels.triangulate_two_views)
    cams = Rigid3.exp(np.array([[0.1, 0, 0, 0, 0.05, 0], [-1, 0.1, 0.05, 0.02, 0.1, 0.0]]))
    cameras = [LENSES[camera], PINHOLE]
    reasons = []
    for count in (9, 1):
        pixels = pixels_of(rng, cams, cameras, count)
        reasons += triangulate_points(cams, cameras, pixels).reason.tolist()
        reasons += triangulate_points(cams, cameras, pixels, min_angle_rad=0.2).reason.tolist()
    triangulate_points(cams[[0, 0]], cameras, pixels_of(rng, cams, cameras, 2))  # no motion
    assert {PointReason.OK, PointReason.TOO_FEW_VIEWS, PointReason.SMALL_ANGLE} <= set(reasons)
    for *before, start, stop, out in calls:
        for part in ((start, stop), (start, start)):
            assert_same_as_python(kernels.triangulate_two_views, *before, *part, out)


@pytest.mark.parametrize("camera", list(LENSES))
@reference_of(kernels.triangulate_many_views)
def test_many_views(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, camera: str) -> None:
    calls = record_calls(monkeypatch, triangulate, kernels.triangulate_many_views)
    cams = Rigid3.exp(np.column_stack([np.linspace(-1, 1, 4), 0.05 * rng.normal(size=(4, 5))]))
    cameras = [LENSES[camera], PINHOLE, PINHOLE, LENSES[camera]]
    pixels = pixels_of(rng, cams, cameras, 9)
    pixels[1:, 6], pixels[:, 7] = np.nan, np.nan  # one view; none
    pixels[:, 8] = rng.uniform(0, 900, (4, 2))
    reasons = []
    for bounds in ({}, {"max_error_px": 3.0}, {"max_error_px": 3.0, "min_angle_rad": 0.2}):
        reasons += triangulate_points(cams, cameras, pixels, **bounds).reason.tolist()
    triangulate_points(cams[[0, 0, 0, 0]], cameras, pixels)
    assert len(set(reasons)) >= 4
    for rows, views, offsets, start, stop, *rest in calls:
        for part in ((start, stop), (2, 4), (stop, stop)):
            assert_same_as_python(kernels.triangulate_many_views, rows, views, offsets, *part, *rest)
