"""A rig of cameras: the stacked image, projection, common views, and poses from all cameras together."""

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import Disparities, refine_pose
from epipole.scene import CameraRig

CAMERAS = (
    Camera("OPENCV", 640, 480, [520.0, 525.0, 319.5, 239.5, -0.1, 0.02, 1e-3, -1e-3]),
    Camera("PINHOLE", 320, 240, [200.0, 200.0, 159.5, 119.5]),
    Camera("OPENCV_FISHEYE", 400, 400, [150.0, 150.0, 199.5, 199.5, 0.01, 0.0, 0.0, 0.0]),
)


def mounted(*angles_deg, offset=0.1):
    """cam_from_rig of cameras that look in these directions, each `offset` ahead of the rig's center."""
    rotations = [Rotation3.exp(np.array([0.0, -np.radians(a), 0.0])).matrix for a in angles_deg]
    return Rigid3(np.stack(rotations), np.tile([0.0, 0.0, -offset], (len(angles_deg), 1)))


RIG = CameraRig(CAMERAS, mounted(0, 120, 240))


def seen(rng, rig, n=90):
    """Points in front of the cameras, their pixels, and rig_from_world."""
    which = np.arange(n) % len(rig.cameras)
    size = np.array([(c.width, c.height) for c in rig.cameras])[which]
    pixels = rng.uniform(0.1, 0.9, (n, 2)) * size + np.column_stack([np.zeros(n), rig.tops[which]])
    in_cam = rig.unproject(pixels, which) * rng.uniform(2, 6, (n, 1))
    in_rig = np.stack([rig.cam_from_rig[k].inverse().apply(x) for k, x in zip(which, in_cam)])
    position = Rigid3.exp(rng.normal(size=6))
    return position.inverse().apply(in_rig), pixels, position, which


def test_pixels_belong_to_the_camera_in_whose_image_they_are(rng):
    points, pixels, position, which = seen(rng, RIG)
    assert (RIG.camera_of(pixels) == which).all()
    assert np.abs(RIG.project(position.apply(points), which) - pixels).max() < 1e-9
    assert RIG.sees(pixels, which).all()
    corners = np.array([[0.0, 479.4], [0.0, 479.6], [0.0, 0.0], [0.0, 1119.0]])
    assert RIG.camera_of(corners).tolist() == [0, 1, 0, 2]


def test_the_stacked_image_has_each_cameras_image(rng):
    images = [rng.integers(0, 255, (c.height, c.width), np.uint8) for c in CAMERAS]
    stacked = RIG.stack(images)
    assert stacked.shape == (RIG.height, RIG.width) == (1120, 640)
    assert all((a == b).all() for a, b in zip(RIG.parts(stacked), images))
    with pytest.raises(ShapeError, match="needs as many images"):
        RIG.stack(images[:2])
    with pytest.raises(ShapeError, match="image of camera 1 is 640 x 480"):
        RIG.stack([images[0], images[0], images[2]])


def test_the_pose_of_the_rig_is_exact_without_noise_and_ignores_wrong_matches(rng):
    points, pixels, position, _ = seen(rng, RIG)
    start = Rigid3.exp(0.03 * rng.normal(size=6)) @ position
    found = refine_pose(points, pixels, RIG, start)
    assert np.abs((found.cam_from_world @ position.inverse()).log()).max() < 1e-10
    off = pixels.copy()
    off[:20, 0] = np.clip(off[:20, 0] + 40.0, 0, 310)
    found = refine_pose(points, off, RIG, start)
    assert np.abs((found.cam_from_world @ position.inverse()).log()).max() < 1e-3
    with pytest.raises(ConfigError, match="not of a rig"):
        refine_pose(points, pixels, RIG, start, disparities=Disparities(np.ones(len(points)), 1.0))


def test_the_covariance_of_the_rigs_pose_is_that_of_repeated_noise(rng):
    points, pixels, position, _ = seen(rng, RIG)
    steps = []
    for _ in range(300):
        found = refine_pose(
            points, pixels + 0.5 * rng.normal(size=pixels.shape), RIG, position, loss_scale=50.0
        )
        steps.append((found.cam_from_world @ position.inverse()).log())
    ratio = np.var(steps, axis=0) / np.diag(0.25 * found.covariance())
    assert (ratio > 0.7).all() and (ratio < 1.4).all()


def test_a_rig_of_one_direction_is_like_its_camera(rng):
    """The information of two cameras in one position facing the same way is twice that of one."""
    camera = CAMERAS[1]
    twice = CameraRig(
        (camera, camera), Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [1e-9, 0, 0]]))
    )
    points, pixels, position, which = seen(rng, twice)
    local = pixels - np.column_stack([np.zeros(len(which)), twice.tops[which]])
    alone, both = refine_pose(points, local, camera, position), refine_pose(points, pixels, twice, position)
    assert np.allclose(alone.information, both.information, atol=1e-3)


def test_only_cameras_with_a_common_view_measure_depth():
    assert not RIG.measures_depth and RIG.common_views()[0, 1] == 0
    pair = CameraRig(
        CAMERAS[:2], Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [-0.1, 0, 0]]))
    )
    assert pair.measures_depth and pair.common_views()[1, 0] > 0.7 and np.isclose(pair.length, 0.1)


@pytest.mark.parametrize(
    ("cameras", "poses", "error", "words"),
    [
        (CAMERAS[:1], mounted(0), ConfigError, "2 to 6 cameras"),
        (CAMERAS, mounted(0, 120), ShapeError, "one motion per camera"),
        (CAMERAS[:2], Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))), ConfigError, "same position"),
        (CAMERAS[:2], Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.full((2, 3), np.nan)), ConfigError, "finite"),
    ],
)
def test_wrong_rigs_are_refused(cameras, poses, error, words):
    with pytest.raises(error, match=words):
        CameraRig(cameras, poses)
