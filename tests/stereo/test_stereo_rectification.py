"""Rectified rows match exactly for points in space, whatever the cameras; what cannot be rectified says why."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.rectification import rectify, within_both
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.pipelines.stereo.calibration_error import calibration_sigma
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.depth import depth_of
from epipole.pipelines.stereo.pair import measure_pair
from epipole.scene import StereoRig
from epipole.synthetic.courtyard import look_at
from epipole.synthetic.render import render
from epipole.synthetic.stereo_rooms import _room

W, H = 320, 240


def lens(model, *params):
    return Camera(model, W, H, np.array(params, np.float64))


PINHOLE, OPENCV, FISHEYE = CameraModel.PINHOLE, CameraModel.OPENCV, CameraModel.OPENCV_FISHEYE
RIGS = {
    "verged, different lenses": StereoRig(
        lens(OPENCV, 270, 271, 160, 118, -0.2, 0.05, 1e-3, -1e-3),
        lens(OPENCV, 283, 282, 157, 121, -0.1, 0.02, 0, 0),
        Rigid3.exp(np.array([-0.2, 0.01, 0.02, 0.01, 0.1, 0.02])),
    ),
    "fisheye": StereoRig(
        lens(FISHEYE, 120, 120, 160, 118, 0.01, -0.01, 0, 0),
        lens(FISHEYE, 126, 126, 158, 121, 0.01, -0.01, 0, 0),
        Rigid3.exp(np.array([-0.2, 0.01, 0.0, 0.01, 0.05, 0.02])),
    ),
    "right camera below": StereoRig(
        lens(PINHOLE, 270, 271, 160, 118),
        lens(PINHOLE, 280, 278, 157, 121),
        Rigid3.exp(np.array([0.0, -0.2, 0.0, 0.03, 0.0, 0.02])),
    ),
    "right camera above": StereoRig(
        lens(PINHOLE, 270, 271, 160, 118),
        lens(PINHOLE, 220, 221, 157, 121),
        Rigid3.exp(np.array([0.0, 0.2, 0.0, -0.03, 0.0, 0.02])),
    ),
}


@pytest.mark.parametrize("name", RIGS)
def test_points_in_space_lie_in_common_rows(name, rng):
    rig = RIGS[name]
    found = rectify(rig)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 9], (500, 3))
    in_left, in_right = points, rig.right_from_left.apply(points)
    flat, rectified = found.rig, []
    for in_cam, rotation in (
        (in_left, found.rectified_from_left),
        (in_right, found.rectified_from_right),
    ):
        x, y, z = (in_cam @ rotation.T).T
        rectified.append(np.stack([flat.focal_px * x / z + flat.cx, flat.focal_px * y / z + flat.cy], axis=1))
    np.testing.assert_allclose(rectified[0][:, 1], rectified[1][:, 1], atol=1e-9)
    disparity = rectified[0][:, 0] - rectified[1][:, 0]
    assert (disparity > 0).all()
    # Q gives the points back, in the rectified left camera's axes.
    four = np.column_stack([rectified[0], disparity, np.ones(500)]) @ found.Q.T
    np.testing.assert_allclose(four[:, :3] / four[:, 3:], in_left @ found.rectified_from_left.T, rtol=1e-9)
    assert found.is_rotated == name.startswith("right camera")
    # The tables say where each rectified pixel lies in the given image.
    row, column = found.size[1] // 2, found.size[0] // 2
    ray = np.array([[(column - flat.cx) / flat.focal_px, (row - flat.cy) / flat.focal_px, 1.0]])
    np.testing.assert_allclose(
        found.left_map_px[row, column], rig.left.project(ray @ found.rectified_from_left)[0], atol=1e-3
    )
    assert found.left_valid[row, column] and found.left_valid.mean() > 0.6


@pytest.mark.parametrize("name", RIGS)
def test_depth_of_a_rendered_pair_is_the_scenes(name):
    rig, scene = RIGS[name], _room(np.random.default_rng(3))
    left_from_world = look_at((0, 0, 0.1), (0, 5, 0.1))
    left = render(scene, rig.left, left_from_world)
    right = render(scene, rig.right, rig.right_from_left @ left_from_world)
    found = measure_pair(left.rgb, right.rgb, StereoConfig(), rig)
    assert "rectified" not in " ".join(found.warnings)
    rectification, flat = found.rectification, found.rig
    row, column = np.nonzero(np.isfinite(found.depths.depth))
    depth = found.depths.depth[row, column]
    rays = np.stack(
        [(column - flat.cx) / flat.focal_px, (row - flat.cy) / flat.focal_px, np.ones(len(row))], 1
    )
    in_left = (depth[:, None] * rays) @ rectification.rectified_from_left
    at = np.rint(rig.left.project(in_left)).astype(int)
    inside = (at >= 0).all(axis=1) & (at < [W, H]).all(axis=1)
    assert inside.mean() > 0.99
    true = left.depth[at[inside, 1], at[inside, 0]]
    wrong = np.abs(in_left[inside, 2] / true - 1.0)
    assert np.nanmedian(wrong) < 0.015 and np.nanmean(wrong < 0.06) > 0.85
    assert not np.isfinite(found.disparities.disparity_px[~rectification.left_valid]).any()


def test_what_cannot_be_rectified():
    camera = lens(PINHOLE, 270, 270, 160, 120)

    def rig(translation, rotation=(0, 0, 0)):
        return StereoRig(camera, camera, Rigid3.exp(np.array([*translation, *rotation], np.float64)))

    with pytest.raises(ConfigError, match="swapped"):
        rectify(rig((0.2, 0, 0)))
    with pytest.raises(DegenerateGeometryError, match="viewing direction"):
        rectify(rig((0, 0, -0.2)))
    with pytest.raises(DegenerateGeometryError):
        rectify(rig((-0.2, 0, 0), (0, np.pi, 0)))
    with pytest.raises(ConfigError, match="baseline is zero"):
        rig((0, 0, 0))
    with pytest.raises(ConfigError, match="not a rotation matrix"):
        StereoRig(camera, camera, Rigid3(1.0002 * np.eye(3), np.array([-0.2, 0.0, 0.0])))
    with pytest.raises(ShapeError, match="single motion"):
        StereoRig(camera, camera, Rigid3.identity(2))
    small = np.zeros((20, 30, 3), np.uint8)
    with pytest.raises(ShapeError, match="its calibration is for 320 x 240"):
        measure_pair(small, small, StereoConfig(), rig((-0.2, 0, 0)))


def test_pixels_that_no_camera_sees_are_out_of_view():
    rig = RIGS["verged, different lenses"]
    found = rectify(rig)
    image = np.random.default_rng(0).integers(0, 255, (H, W), dtype=np.uint8)
    matched = within_both(match_stereo(*found.apply(image, image)), found.left_valid, found.right_valid)
    assert (matched.reason[~found.left_valid] == 2).all()
    row, column = np.nonzero(np.isfinite(matched.disparity_px))
    at = np.rint(column - matched.disparity_px[row, column]).astype(int)
    assert found.right_valid[row, at].all()


def test_calibrations_part_of_the_error_is_what_simulation_gives(rng):
    """Disparities (f B / Z) under calibrations drawn from the covariance, against the first order."""
    base = RIGS["verged, different lenses"]
    root = np.zeros((30, 30))
    deviation = [
        *(0.5, 0.5, 0.7, 0.7, 1e-3, 1e-3, 1e-4, 1e-4, 0, 0, 0, 0) * 2,
        *(1e-4, 1e-4, 1e-4, 3e-4, 3e-4, 3e-4),
    ]
    root[np.diag_indices(30)] = deviation
    root += np.tril(rng.normal(0, 0.2, (30, 30)), -1) * np.array(deviation)[:, None]
    root *= 0.25
    rig = StereoRig(base.left, base.right, base.right_from_left, root @ root.T)
    found = rectify(rig)
    flat, disparity = found.rig, np.full(found.left_valid.shape, 12.0)
    sigma = calibration_sigma(rig, found, disparity)
    row, column = found.size[1] // 2, found.size[0] // 2
    ray = np.array([[(column - flat.cx) / flat.focal_px, (row - flat.cy) / flat.focal_px, 1.0]])
    other = ray - [[12.0 / flat.focal_px, 0.0, 0.0]]
    left_px = rig.left.project(ray @ found.rectified_from_left)
    right_px = rig.right.project(other @ found.rectified_from_right)
    seen = []
    for _ in range(1500):
        rendered = rig.perturbed(root @ rng.standard_normal(30))
        a = rendered.left.unproject(left_px)[0]
        to_left = rendered.right_from_left.inverse()
        b, center = to_left.rotation @ rendered.right.unproject(right_px)[0], to_left.translation
        # Where the rays come nearest to each other, seen along the rectified axis.
        s = np.linalg.lstsq(np.stack([a, -b], axis=1), center, rcond=None)[0]
        seen.append(flat.focal_px * flat.baseline / (found.rectified_from_left @ (s[0] * a))[2])
    assert abs(np.mean(seen) - 12.0) < 0.1
    assert np.std(seen) == pytest.approx(sigma[row, column], rel=0.12)
    depths = depth_of(match_stereo(*[np.zeros((H, W), np.uint8)] * 2), flat)
    assert (depths.calibration_sigma[np.isfinite(depths.depth)] == 0).all()
    with pytest.raises(ShapeError, match="no covariance"):
        calibration_sigma(base, found, disparity)
