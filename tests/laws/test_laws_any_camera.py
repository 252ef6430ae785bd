"""Projection and back for every camera model, with lenses and pixels that Hypothesis makes up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from any_geometry import HEIGHT, WIDTH, cameras, pixels
from epipole.cameras import CameraModel

MODELS = [pytest.param(model, id=model.name) for model in CameraModel]


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_a_wild_lens_gives_a_ray_that_comes_back_or_none(model: CameraModel, data: st.DataObject) -> None:
    """Where the distortion folds there is no ray: NaN, in the whole row, and never a wrong one."""
    camera, positions = data.draw(cameras(bend=2.0, model=model)), data.draw(pixels())
    rays = camera.unproject(positions)
    known = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~known]).all()
    np.testing.assert_allclose(camera.project(rays[known]), positions[known], atol=1e-4)


@given(cameras(), pixels(), st.integers(2, 5), st.integers(2, 5))
def test_a_resampled_picture_has_the_same_rays(camera, positions, times_x, times_y) -> None:
    """Pixel edges stay: x in the small image is n x + (n - 1) / 2 in one n times as wide."""
    if len(camera.model.focal_indices) == 1:
        times_y = times_x
    scaled = camera.scaled_to(times_x * WIDTH, times_y * HEIGHT)
    there = (positions + 0.5) * [times_x, times_y] - 0.5
    np.testing.assert_allclose(scaled.unproject(there), camera.unproject(positions), atol=1e-9)


@given(cameras(), st.integers(0, 2))
def test_points_that_are_no_points_have_no_pixels(camera, column) -> None:
    points = np.array([[0.1, 0.2, 3.0], [0.1, 0.2, 3.0]])
    points[1, column] = np.nan
    found = camera.project(points)
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).any()
