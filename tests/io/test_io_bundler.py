"""Bundler: what is written projects, by Bundler's own formula, to what is measured."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.io import write_bundler
from epipole.scene import Cameras, Reconstruction
from io_models import mappable_model, small_model


def bundler_model(k1: float = 0.03, k2: float = -0.01) -> Reconstruction:
    """The mappable model with exact keypoints of a distorted, off-center camera, one image less."""
    model = mappable_model()
    camera = Camera(CameraModel.RADIAL, 640, 480, np.array([550.0, 310.0, 245.0, k1, k2]))
    keypoints = model.images.keypoints_px.copy()
    per_image = len(model.points) + 4
    for image in range(len(model.images)):
        in_cam = model.cams_from_world()[image].apply(model.points.xyz_in_world)
        keypoints[image * per_image + 4 : (image + 1) * per_image] = camera.project(in_cam)
    translation = model.frames.rig_from_world.translation.copy()
    translation[1] = np.nan
    frames = replace(
        model.frames, rig_from_world=replace(model.frames.rig_from_world, translation=translation)
    )
    images = replace(model.images, keypoints_px=keypoints)
    return replace(model, cameras=Cameras.from_list([camera]), frames=frames, images=images)


def test_measurements_agree_with_bundlers_own_projection(tmp_path: Path) -> None:
    """p = -P/P.z with P = R X + t, then f (1 + k1 |p|^2 + k2 |p|^4) p: x right, y up, from the middle."""
    model = bundler_model()
    write_bundler(model, tmp_path / "bundle.out")
    assert (tmp_path / "list.txt").read_text().split() == [
        "000.jpg",
        "002.jpg",
        "003.jpg",
        "004.jpg",
        "005.jpg",
    ]
    header, *lines = (tmp_path / "bundle.out").read_text().splitlines()
    assert header == "# Bundle file v0.3"
    num_cameras, num_points = map(int, lines[0].split())
    assert (num_cameras, num_points) == (5, len(model.points))
    cameras = np.array([line.split() for line in lines[1 : 1 + 5 * num_cameras]], float).reshape(5, 5, 3)
    assert cameras[:, 0].tolist() == [[550.0, 0.03, -0.01]] * 5
    points = lines[1 + 5 * num_cameras :]
    assert len(points) == 3 * num_points
    for j in range(0, num_points, 7):
        xyz = np.array(points[3 * j].split(), float)
        np.testing.assert_array_equal(xyz, model.points.xyz_in_world[j])
        count, *views = points[3 * j + 2].split()
        assert int(count) == 5 and len(views) == 20
        for camera, keypoint, x, y in np.array(views, float).reshape(-1, 4):
            f, k1, k2 = cameras[int(camera), 0]
            P = cameras[int(camera), 1:4] @ xyz + cameras[int(camera), 4]
            assert P[2] < 0
            p = -P[:2] / P[2]
            r2 = p @ p
            np.testing.assert_allclose(f * (1 + k1 * r2 + k2 * r2**2) * p, [x, y], atol=1e-9)
            assert keypoint == 4 + j


def test_the_origin_is_the_middle_of_the_picture_and_y_is_up(tmp_path: Path) -> None:
    model = mappable_model()
    write_bundler(model, tmp_path / "bundle.out")
    last = (tmp_path / "bundle.out").read_text().splitlines()[-1].split()
    keypoint = model.images.keypoints_of(0)[int(last[2])]
    np.testing.assert_allclose(
        [float(last[3]), float(last[4])], [keypoint[0] - 319.5, 239.5 - keypoint[1]], atol=1e-9
    )


def test_what_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot represent the distortion of OPENCV"):
        write_bundler(small_model(), tmp_path / "bundle.out")
    stretched = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 550.0, 320.0, 240.0]))
    with pytest.raises(ConfigError, match="single focal length"):
        write_bundler(
            replace(mappable_model(), cameras=Cameras.from_list([stretched])), tmp_path / "bundle.out"
        )
    assert not list(tmp_path.iterdir())
