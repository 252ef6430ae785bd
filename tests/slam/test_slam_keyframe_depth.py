"""Depth of frames for the mesh: sensors with distortion and an offset to the color camera, stereo pairs with a shift."""

import numpy as np
import pytest
from slam_rides import BASELINE, CAMERA, ride

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Rotation3
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.output.keyframe_depth import depth_reader

COLOR = Camera("PINHOLE", 320, 240, [260.0, 260.0, 159.5, 119.5])
SENSOR = Camera("OPENCV", 200, 150, [150.0, 150.0, 99.5, 74.5, 0.2, -0.1, 0.001, -0.001])
DEPTH_FROM_COLOR = Rigid3(Rotation3.exp(np.array([0.01, -0.02, 0.005])).matrix, np.array([0.025, 0.0, 0.01]))
PLANE = np.array([0.1, -0.15, 1.0, 3.0])
"""n . x = d in the depth camera's frame."""


def plane_depth(camera):
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    rays /= rays[:, 2:]
    return (PLANE[3] / (rays @ PLANE[:3])).reshape(v.shape)


def colors_of(frame):
    """Three channels that differ."""
    return np.stack([frame.gray, frame.gray // 2, frame.gray // 4], axis=2)


def sensor_frame(mask=None):
    color_from_depth = DEPTH_FROM_COLOR.inverse()
    u = np.mgrid[:240, :320][1].astype(float)
    gray = np.where(u < 160, 40, 200).astype(np.uint8)
    return Frame(0.0, gray, None, plane_depth(SENSOR).astype(np.float32), mask), color_from_depth


def test_a_distorted_sensor_gives_the_plane_and_the_colors_of_its_points():
    reader = depth_reader(SlamCamera(COLOR, None, DepthCamera(SENSOR, DEPTH_FROM_COLOR, 1.02)), 0.0, 0.0)
    frame, color_from_depth = sensor_frame()
    depth, sigma, rgb = reader.read(frame, colors_of(frame))
    known = np.isfinite(depth)
    assert known.mean() > 0.95 and depth.shape == (reader.camera.height, reader.camera.width)
    np.testing.assert_allclose(
        depth[known], 1.02 * plane_depth(reader.camera)[known], rtol=2e-3
    )  # nearest pixels
    np.testing.assert_allclose(sigma[known], 0.0016 * depth[known] ** 2, rtol=1e-5)
    v, u = np.nonzero(known)
    rays = reader.camera.unproject(np.stack([u, v], axis=1).astype(float))
    points = rays / rays[:, 2:] * depth[known][:, None]
    column, row = COLOR.project(color_from_depth.apply(points)).T
    clear = (np.abs(column - 160) > 2) & (column > 0) & (column < 319) & (row > 0) & (row < 239)
    wanted = np.where(column[clear, None] < 160, [40, 20, 10], [200, 100, 50])
    assert (rgb[known][clear] == wanted).all(axis=1).mean() > 0.99
    np.testing.assert_array_equal(reader.depth_from_cam.rotation, DEPTH_FROM_COLOR.rotation)


def test_masked_pixels_of_the_color_image_are_masked_in_the_depth():
    reader = depth_reader(SlamCamera(COLOR, None, DepthCamera(SENSOR, DEPTH_FROM_COLOR)), 0.0, 0.0)
    frame, _ = sensor_frame(mask=np.mgrid[:240, :320][1] < 160)
    depth, _, rgb = reader.read(frame, colors_of(frame))
    known = np.isfinite(depth)
    assert 0.3 < known.mean() < 0.6 and (rgb[known][:, 0] != 40).all()


def test_a_shift_of_the_right_image_is_undone():
    camera, frame = SlamCamera(CAMERA, BASELINE), ride(count=2).frames("stereo")[0]
    plain = depth_reader(camera, 60.0, 0.0).read(frame, colors_of(frame)).depth
    shifted = Frame(
        0.0, frame.gray, np.roll(frame.right_gray, 2, axis=1)
    )  # disparities are two pixels smaller
    undone = depth_reader(camera, 60.0, 2.0).read(shifted, colors_of(frame)).depth
    both = np.isfinite(plain) & np.isfinite(undone)
    both[:, :8] = False
    assert both.mean() > 0.15 and np.median(np.abs(undone / plain - 1.0)[both]) < 2e-3


def test_a_single_camera_measures_no_depth():
    with pytest.raises(ConfigError, match="does not measure depth"):
        depth_reader(SlamCamera(CAMERA), 50.0, 0.0)
