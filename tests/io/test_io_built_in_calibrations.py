"""Every built-in calibration against the published numbers, and every pixel of its images has a ray."""

import cv2
import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.io import read_sequence
from epipole.io.calibration import built_in as _built_in_calibrations

# TUM RGB-D: the benchmark's page on its file formats (color cameras, ROS' default distortion model); width, height,
# fx, fy, cx, cy, then k1, k2, p1, p2, k3.
PUBLISHED_TUM = {
    "freiburg1": (
        640,
        480,
        517.306408,
        516.469215,
        318.64304,
        255.313989,
        0.262383,
        -0.953104,
        -0.005358,
        0.002628,
        1.163314,
    ),
    "freiburg2": (
        640,
        480,
        520.90862,
        521.007327,
        325.141442,
        249.701764,
        0.231222,
        -0.784899,
        -0.003257,
        -0.000105,
        0.917205,
    ),
    "freiburg3": (640, 480, 535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}
# 7-Scenes: the set publishes the focal length and the principal point of its depth sensor.
PUBLISHED_SEVEN_SCENES_DEPTH = (640, 480, 585.0, 585.0, 320.0, 240.0)


def write_image(path, size):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros(size[::-1], np.uint8))


@pytest.fixture
def cameras(tmp_path):
    """Every built-in camera, as the reader gives it for a folder without a calibration."""
    out = {}
    for name in PUBLISHED_TUM:
        folder = tmp_path / f"rgbd_dataset_{name}_desk"
        write_image(folder / "rgb" / "1.png", (640, 480))
        (folder / "rgb.txt").write_text("1.0 rgb/1.png\n")
        out[name] = read_sequence(folder).camera
    folder = tmp_path / "kitchen"
    write_image(folder / "frame-000000.color.png", (640, 480))
    depth = np.tile(np.linspace(900, 3000, 640), (480, 1)).astype(np.uint16)
    cv2.imwrite(str(folder / "frame-000000.depth.png"), depth)
    found = read_sequence(folder)
    out["7-Scenes color"], out["7-Scenes depth"] = found.camera, found.depth.camera
    return out


def brown_conrady(params, a, b):
    """Pixels of (a, b) on the plane z = 1, as OpenCV documents its model, in plain NumPy."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = params
    r2 = a * a + b * b
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


@pytest.mark.parametrize("name", PUBLISHED_TUM)
def test_tum_cameras_are_the_published_ones(cameras, name):
    camera, (width, height, *params) = cameras[name], PUBLISHED_TUM[name]
    assert (camera.width, camera.height) == (width, height)
    a, b = (side.ravel() for side in np.meshgrid(np.linspace(-0.6, 0.6, 13), np.linspace(-0.45, 0.45, 11)))
    pixels = camera.project(np.stack([a, b, np.ones_like(a)], axis=1))
    np.testing.assert_allclose(pixels, brown_conrady(params, a, b), atol=1e-9)
    assert (camera.model is CameraModel.PINHOLE) == (name == "freiburg3")


def test_the_depth_camera_of_seven_scenes_is_the_published_one(cameras):
    camera = cameras["7-Scenes depth"]
    assert (camera.width, camera.height, *camera.params) == PUBLISHED_SEVEN_SCENES_DEPTH


def test_every_pixel_of_every_built_in_camera_has_a_ray(cameras):
    assert len(cameras) == 5
    for name, camera in cameras.items():
        columns, rows = (
            np.arange(-0.5, camera.width),
            np.arange(-0.5, camera.height),
        )  # the border of the image, too
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        rays = camera.unproject(pixels)
        assert np.isfinite(rays).all(), name
        np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-8, err_msg=name)


def test_no_built_in_camera_is_missing_here(cameras):
    """A camera that is added must be added to the published numbers."""
    assert set(_built_in_calibrations._TUM) == set(PUBLISHED_TUM)
    made = [value for value in vars(_built_in_calibrations).values() if isinstance(value, Camera)]
    assert not made and len(_built_in_calibrations.seven_scenes_cameras()) == 3
