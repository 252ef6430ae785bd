"""Z = f B / d, its error, and points of depth maps."""

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import depth_error, depth_to_disparity, disparity_to_depth
from epipole.scene import depth_map_to_point_cloud


def test_worked_numbers():
    """f = 800 px, B = 0.12 m: 40 px is 2.4 m and 4 px is 24 m; a pixel of error is 6 cm there and 6 m here."""
    np.testing.assert_allclose(disparity_to_depth([40.0, 4.0], 800, 0.12), [2.4, 24.0], rtol=1e-15)
    np.testing.assert_allclose(depth_error([2.4, 24.0], 800, 0.12, 1.0), [0.06, 6.0], rtol=1e-12)
    assert depth_error(24.0, 800, 0.24, 1.0) == pytest.approx(3.0)


def test_depth_and_disparity_are_inverse(rng):
    depth = rng.uniform(0.1, 100.0, (7, 5))
    disparity = depth_to_disparity(depth, 995.0, 0.193, 31.1)
    np.testing.assert_allclose(disparity_to_depth(disparity, 995.0, 0.193, 31.1), depth, rtol=1e-10)


def test_the_error_is_the_derivative():
    depth, step = 7.3, 1e-5
    disparity = depth_to_disparity(depth, 700.0, 0.2)
    moved = disparity_to_depth(disparity + step, 700.0, 0.2)
    assert depth_error(depth, 700.0, 0.2, step) == pytest.approx(abs(moved - depth), rel=1e-5)


def test_what_has_no_depth():
    out = disparity_to_depth([np.nan, 0.0, -1.0, np.inf], 800, 0.12)
    assert np.isnan(out[0]) and out[1] == np.inf and np.isnan(out[2]) and out[3] == 0
    assert np.isnan(depth_to_disparity([0.0, -1.0, np.nan], 800, 0.12)).all()
    assert depth_to_disparity(np.inf, 800, 0.12) == 0
    assert disparity_to_depth(np.zeros((0, 3)), 800, 0.12).shape == (0, 3)


@pytest.mark.parametrize(
    ("focal", "baseline"), [(0, 1), (-5, 1), (800, 0), (800, -0.1), (np.nan, 1), (800, np.inf)]
)
def test_cameras_that_cannot_be(focal, baseline):
    for call in (disparity_to_depth, depth_to_disparity):
        with pytest.raises(ConfigError, match=r"must be positive|must be a number, got NaN"):
            call([1.0], focal, baseline)
    with pytest.raises(ConfigError, match=r"must be positive|must be a number, got NaN"):
        depth_error(1.0, focal, baseline, 0.1)


def test_points_of_a_depth_map_project_to_their_pixels(rng):
    depth = rng.uniform(1, 9, (6, 8))
    depth[0, :4] = np.nan, np.inf, 0.0, -2.0
    K = np.array([[500.0, 0, 3.2], [0, 510.0, 2.7], [0, 0, 1]])
    cloud = depth_map_to_point_cloud(depth, K)
    assert len(cloud) == 44 and not cloud.mask[0, :4].any()
    pixels = cloud.points_in_cam @ K.T
    y, x = np.nonzero(cloud.mask)
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], np.stack([x, y], 1), atol=1e-9)
    assert len(depth_map_to_point_cloud(np.full((3, 3), np.nan), K)) == 0
    with pytest.raises(ShapeError, match=r"\(h, w\)"):
        depth_map_to_point_cloud(np.ones(5), K)


def test_a_number_gives_a_number() -> None:
    depth = disparity_to_depth(40.0, 500.0, 0.1)
    assert isinstance(depth, float) and depth == 1.25
    assert isinstance(depth_to_disparity(1.25, 500.0, 0.1), float)
    assert isinstance(depth_error(1.25, 500.0, 0.1, 0.5), float)
    assert disparity_to_depth([[40.0]], 500.0, 0.1).shape == (1, 1)
