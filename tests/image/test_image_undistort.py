"""Undistortion: every pixel of the result has one in the image, for weak, strong and very wide lenses of every model."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError
from epipole.image import undistort_image, undistorted_camera
from epipole.image.undistort import largest_rectangle

W, H = 96, 64


def distorted(camera: Camera, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the rays (a, b, 1), written out anew with NumPy."""
    names = dict(zip(camera.model.param_names, camera.params))
    fx, fy = names.get("f", names.get("fx")), names.get("f", names.get("fy"))
    k1, k2 = names.get("k", names.get("k1", 0.0)), names.get("k2", 0.0)
    k3, k4, k5, k6 = (names.get(k, 0.0) for k in ("k3", "k4", "k5", "k6"))
    p1, p2 = names.get("p1", 0.0), names.get("p2", 0.0)
    r = np.hypot(a, b)
    if camera.model == CameraModel.OPENCV_FISHEYE:
        t = np.arctan(r)
        scale = np.where(
            r > 0, (t + k1 * t**3 + k2 * t**5 + k3 * t**7 + k4 * t**9) / np.where(r > 0, r, 1), 1
        )
        u, v = a * scale, b * scale
    else:
        scale = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        u = a * scale + 2 * p1 * a * b + p2 * (r**2 + 2 * a**2)
        v = b * scale + 2 * p2 * a * b + p1 * (r**2 + 2 * b**2)
    return fx * u + names["cx"], fy * v + names["cy"]


def has_source(camera: Camera, pinhole: Camera) -> np.ndarray:
    """Of each pixel of the pinhole, whether it lies inside the image, and before the fold on its way from the axis."""
    u, v = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    a, b = (u - pinhole.K[0, 2]) / pinhole.K[0, 0], (v - pinhole.K[1, 2]) / pinhole.K[1, 1]
    x, y = distorted(camera, a, b)
    inside = (x > -0.51) & (x < camera.width - 0.49) & (y > -0.51) & (y < camera.height - 0.49)
    far = -np.inf
    for fraction in np.linspace(
        0.05, 1.0, 40
    ):  # farther from the axis is farther from the middle of the image
        x, y = distorted(camera, fraction * a, fraction * b)
        near, far = far, np.hypot(x - camera.K[0, 2], y - camera.K[1, 2])
        inside &= far > near - 1e-3
    return inside


def cameras():
    middle = ((W - 1) / 2 + 3, (H - 1) / 2 - 2)
    for f in (0.25 * W, 0.5 * W, 1.2 * W):
        yield Camera("SIMPLE_PINHOLE", W, H, [f, *middle])
        yield Camera("PINHOLE", W, H, [f, 1.1 * f, *middle])
        for k in (-2.0, -0.5, -0.28, -0.15, -0.05, 0.0, 0.1, 1.0):
            yield Camera("SIMPLE_RADIAL", W, H, [f, *middle, k])
            yield Camera("RADIAL", W, H, [f, *middle, k, -0.5 * k])
            yield Camera("OPENCV", W, H, [f, 0.9 * f, *middle, k, 0.1 * k, 2e-3, -1e-3])
            yield Camera("OPENCV_FISHEYE", W, H, [f, f, *middle, 0.1 * k, 0.02 * k, 0, 0])
            yield Camera("FULL_OPENCV", W, H, [f, f, *middle, k, 0.1, 1e-3, 1e-3, 0.0, 0.2, 0.05, 0])


@pytest.mark.parametrize("camera", list(cameras()), ids=repr)
def test_every_pixel_has_a_source(camera, unchecked):
    pinhole = undistorted_camera(camera)
    np.testing.assert_allclose([pinhole.K[0, 0], pinhole.K[1, 1]], [camera.K[0, 0], camera.K[1, 1]])
    assert min(pinhole.width / W, pinhole.height / H) > 0.1
    assert pinhole.width * pinhole.height <= 4 * W * H
    assert has_source(camera, pinhole).all()


@pytest.mark.parametrize(
    ("camera", "least", "most"),
    [
        (Camera("OPENCV_FISHEYE", 512, 512, [150, 150, 255.5, 255.5, 0, 0, 0, 0]), (500, 500), (1024, 1024)),
        (Camera("SIMPLE_RADIAL", 640, 480, [330, 319.5, 239.5, -0.28]), (450, 450), (640, 640)),
        (Camera("SIMPLE_RADIAL", 1280, 720, [330, 639.5, 359.5, -0.28]), (450, 450), (1280, 720)),
        (Camera("SIMPLE_RADIAL", 1920, 1080, [960, 959.5, 539.5, -0.15]), (1900, 1000), (3000, 1500)),
        (Camera("SIMPLE_RADIAL", 1920, 1080, [960, 959.5, 539.5, -0.3]), (1500, 1000), (3000, 1500)),
    ],
)
def test_wide_lenses_keep_a_sensible_area(camera, least, most):
    size = np.array([(pinhole := undistorted_camera(camera)).width, pinhole.height])
    assert (size >= least).all()
    assert (size <= most).all()


def test_a_distortion_that_describes_nearly_nothing_is_refused():
    with pytest.raises(DegenerateGeometryError, match=r"covers only \d+x\d+ pixels"):
        undistorted_camera(Camera("SIMPLE_RADIAL", 1920, 1080, [960, 959.5, 539.5, -500.0]))


def test_what_lies_beyond_the_fold_is_black():
    camera = Camera(
        "SIMPLE_RADIAL", W, H, [W, (W - 1) / 2, (H - 1) / 2, -2.0]
    )  # folds over at a radius of 0.41
    wide = Camera("PINHOLE", 2 * W, H, [W, W, W - 0.5, (H - 1) / 2])
    rgb = undistort_image(np.full((H, W, 3), 200, np.uint8), camera, wide)
    radius = np.abs(np.arange(2 * W) - (W - 0.5)) / W
    row = rgb[H // 2, :, 0]
    assert (row[radius < 0.38] > 150).all()
    assert (row[radius > 0.45] == 0).all()


def test_the_largest_rectangle_is_that_of_all_rectangles(rng):
    for _ in range(40):
        mask = rng.random((7, 9)) < 0.75
        (c0, c1), (r0, r1) = largest_rectangle(mask)
        every = [
            (j1 - j0) * (i1 - i0)
            for i0 in range(7)
            for i1 in range(i0, 7)
            for j0 in range(9)
            for j1 in range(j0, 9)
            if mask[i0 : i1 + 1, j0 : j1 + 1].all()
        ]
        assert mask[r0 : r1 + 1, c0 : c1 + 1].all()
        assert (c1 - c0) * (r1 - r0) == max(every)
