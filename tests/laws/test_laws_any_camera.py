"""Projection and back for every camera model, with lenses and pixels that Hypothesis makes up."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from any_geometry import HEIGHT, WIDTH, cameras, numbers, pixels, points_ahead, vectors
from epipole.cameras import CameraModel

MODELS = [pytest.param(model, id=model.name) for model in CameraModel]


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_every_pixel_of_a_mild_lens_has_a_ray_that_comes_back(
    model: CameraModel, data: st.DataObject
) -> None:
    camera, positions = data.draw(cameras(model=model)), data.draw(pixels())
    depth = data.draw(numbers(1e-3, 1e3))
    rays = camera.unproject(positions)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(camera.project(depth * rays), positions, atol=1e-7)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_what_a_mild_lens_sees_comes_back_as_its_direction(model: CameraModel, data: st.DataObject) -> None:
    camera, points = data.draw(cameras(model=model, bend=0.01)), data.draw(points_ahead())
    rays = camera.unproject(camera.project(points))
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_a_wild_lens_gives_a_ray_that_comes_back_or_none(model: CameraModel, data: st.DataObject) -> None:
    """Where the distortion folds there is no ray: NaN, in the whole row, and never a wrong one."""
    camera, positions = data.draw(cameras(bend=2.0, model=model)), data.draw(pixels())
    rays = camera.unproject(positions)
    known = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~known]).all()
    np.testing.assert_allclose(camera.project(rays[known]), positions[known], atol=1e-4)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_the_jacobian_is_the_slope(model: CameraModel, data: st.DataObject) -> None:
    camera, points = data.draw(cameras(model=model)), data.draw(points_ahead(most=4))
    trajectory = data.draw(vectors(3, 1.0))
    _, by_points, by_params = camera.project_with_jacobian(points)
    h = 1e-5
    slope = (camera.project(points + h * trajectory) - camera.project(points - h * trajectory)) / (2 * h)
    np.testing.assert_allclose(by_points @ trajectory, slope, rtol=1e-5, atol=1e-4)
    step = np.full(len(camera.params), 1e-5)
    step[list(camera.model.distortion_indices)] = 1e-7
    for column, size in enumerate(step):
        shift = size * (np.arange(len(step)) == column)
        ends = [replace(camera, params=camera.params + s * shift).project(points) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * size)
        np.testing.assert_allclose(by_params[:, :, column], slope, rtol=1e-4, atol=1e-3)


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
