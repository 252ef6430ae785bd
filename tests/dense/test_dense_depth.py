"""Depth of a view: rectification laws, accuracy on a rendered scene, reasons for holes, kernels against Python."""

from dataclasses import replace

import numpy as np
import pytest
from dense_scenes import CAMERA, RANGE, rendered, times_seen

from epipole import _parallel
from epipole.dense import _depth_kernels, depth
from epipole.dense.depth import view_depth
from epipole.dense.pair_rectification import rectify_views
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.scene.view_depth import DepthReason
from kernel_references import assert_same_as_python, record_calls, reference_of
from whole import in_whole_run

REFERENCE, SOURCES = 10, (8, 9, 11, 12, 13)


def views(*rows):
    return [rendered()[0][k] for k in rows]


@pytest.mark.parametrize("other", [7, 9, 12])
def test_a_point_has_the_same_row_and_the_stated_disparity(other):
    one, two = views(REFERENCE, other)
    pair = rectify_views(one, two, RANGE)
    rng = np.random.default_rng(0)
    pixels = rng.uniform([40, 60], [280, 200], (50, 2))
    z = rng.uniform(2.5, 7.0, 50)
    rays = CAMERA.unproject(pixels)
    rays /= rays[:, 2:]
    in_other = (two.cam_from_world @ one.cam_from_world.inverse()).apply(rays * z[:, None])
    left = homogeneous(np.linalg.inv(pair.reference_from_rectified), pixels)
    right = homogeneous(np.linalg.inv(pair.source_from_rectified), CAMERA.project(in_other))
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    disparity = left[:, 0] - right[:, 0]
    np.testing.assert_allclose(
        1.0 / z, (disparity + pair.first_disparity_px) * (rays @ pair.inverse_depth_of_ray), rtol=1e-9
    )
    assert (disparity >= 0).all() and (disparity <= pair.num_disparities).all()
    in_image = (CAMERA.project(in_other) >= 0).all(axis=1) & (CAMERA.project(in_other) <= [319, 239]).all(
        axis=1
    )
    matched = in_image & (left[:, 0] >= 0) & (left[:, 0] < pair.size[0])
    assert matched.sum() > 15 and (right[matched, 0] > -1).all() and (right[matched, 0] < pair.size[0]).all()


def homogeneous(matrix, pixels):
    rows = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ matrix.T
    return rows[:, :2] / rows[:, 2:]


def test_most_visible_pixels_are_right_and_few_are_wrong():
    (reference, *sources), truth = views(REFERENCE, *SOURCES), rendered()[1][REFERENCE]
    found = view_depth(reference, sources, RANGE)
    error = np.abs(found.depth - truth) / truth
    visible, known = times_seen(REFERENCE, SOURCES) >= 1, np.isfinite(found.depth) & np.isfinite(truth)
    assert (error[visible] < 0.01).mean() > 0.8  # 0.94 at 1536 x 1024
    assert (error[visible] > 0.05).mean() < 0.02
    within = (np.abs(found.depth - truth) <= found.sigma)[known].mean()
    assert 0.5 < within < 0.85
    assert (np.isfinite(found.depth) == (found.reason == DepthReason.OK)).all()
    assert (np.isnan(found.sigma) == np.isnan(found.depth)).all()
    assert (np.isfinite(found.depth) & ~np.isfinite(truth)).mean() < 0.02  # sky


@in_whole_run
def test_depth_does_not_depend_on_the_number_of_threads():
    reference, *sources = views(REFERENCE, *SOURCES)
    found = view_depth(reference, sources, RANGE)
    try:
        _parallel.set_num_threads(1)
        again = view_depth(reference, sources, RANGE)
    finally:
        _parallel.set_num_threads(None)
    np.testing.assert_array_equal(found.depth, again.depth)
    np.testing.assert_array_equal(found.sigma, again.sigma)


def test_without_a_usable_source_no_pixel_has_a_depth():
    (reference,) = views(REFERENCE)
    same = replace(reference, name="again")
    turned = replace(
        reference, cam_from_world=Rigid3(Rotation3.exp(np.array([0, np.pi, 0])).matrix, np.ones(3))
    )
    for sources in ([], [same], [turned]):
        found = view_depth(reference, sources, RANGE)
        assert found.density == 0.0 and (found.reason == DepthReason.OUT_OF_VIEW).all()


def test_masks_of_the_view_and_of_its_sources_are_respected():
    reference, *sources = views(REFERENCE, *SOURCES)
    used = np.ones((240, 320), bool)
    used[:, :100] = False
    found = view_depth(replace(reference, used_mask=used), sources, RANGE)
    assert (found.reason[:, :100] == DepthReason.MASKED).all() and found.density > 0.4
    nothing = [replace(source, used_mask=np.zeros_like(used)) for source in sources]
    found = view_depth(reference, nothing, RANGE)
    assert found.density == 0.0 and (found.reason == DepthReason.OCCLUDED).mean() > 0.5


def test_one_unmasked_source_is_enough_where_the_other_is_masked():
    reference, one, other = views(REFERENCE, 9, 11)
    whole = view_depth(reference, [one], RANGE)
    masked = replace(other, used_mask=np.zeros((240, 320), bool))
    found = view_depth(reference, [one, masked], RANGE)
    assert found.density > 0.9 * whole.density


def test_a_blank_image_has_no_depth_and_says_why():
    reference, *sources = [
        replace(view, rgb=np.full_like(view.rgb, 120)) for view in views(REFERENCE, *SOURCES)
    ]
    found = view_depth(reference, sources, RANGE)
    assert found.density == 0.0
    assert (found.reason == DepthReason.TEXTURELESS).mean() > 0.4


def test_wrong_arguments_are_refused():
    reference, source = views(REFERENCE, 9)
    for depths in ((0.0, 1.0), (2.0, 1.0), (1.0, np.inf), (np.nan, 2.0)):
        with pytest.raises(ConfigError, match="depths"):
            view_depth(reference, [source], depths)
    with pytest.raises(ConfigError, match="model_sigma_px"):
        view_depth(reference, [source], RANGE, -1.0)
    with pytest.raises(DegenerateGeometryError, match="same position"):
        rectify_views(reference, reference, RANGE)
    forward = replace(
        source, cam_from_world=Rigid3(np.eye(3), np.array([0.0, 0.0, -1.0])) @ reference.cam_from_world
    )
    with pytest.raises(DegenerateGeometryError, match="viewing direction"):
        rectify_views(reference, forward, RANGE)
    with pytest.raises(ShapeError, match="different sizes"):
        replace(reference, rgb=reference.rgb[:-1])


@reference_of(_depth_kernels.sample_pair, _depth_kernels.merge_rows, _depth_kernels.merge_near_rows)
def test_kernels_do_what_their_python_does(monkeypatch):
    reference, *sources = views(REFERENCE, *SOURCES)
    calls = {
        kernel: record_calls(monkeypatch, depth, kernel)
        for kernel in (_depth_kernels.sample_pair, _depth_kernels.merge_rows, _depth_kernels.merge_near_rows)
    }
    view_depth(reference, sources, RANGE)
    for kernel, recorded in calls.items():
        arguments = list(recorded[len(recorded) // 2])
        arguments[-2] = arguments[-3] + 4  # a few rows
        assert_same_as_python(kernel, *arguments, rtol=1e-5, atol=1e-7)
