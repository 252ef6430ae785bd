"""Fusion of depths: agreement, free space, points contributed once, normals, kernels against Python."""

from dataclasses import replace

import numpy as np
import pytest
from dense_scenes import CAMERA, rendered

from epipole.dense import _fusion_kernels, fusion
from epipole.dense import normals as normals_module
from epipole.dense.fusion import DensePoints, fuse_view
from epipole.errors import ConfigError, ShapeError
from epipole.scene.view_depth import ViewDepth
from kernel_references import assert_same_as_python, record_calls, reference_of

ROWS = (9, 10, 11)


def exact(k, sigma=0.002):
    """View k with its exact depth."""
    views, depths = rendered()
    depth = depths[k].astype(np.float32)
    known = np.isfinite(depth)
    return views[k], ViewDepth(
        depth, sigma * depth, np.where(known, 0, 3).astype(np.uint8), 2 * known.astype(np.uint8)
    )


def fused(k=10, change=lambda depth: depth):
    view, depth = exact(k)
    return fuse_view(view, change(depth), [exact(other) for other in ROWS if other != k])


def test_points_are_on_the_surface_and_contributed_once():
    view, depth = exact(10)
    found = fused()
    in_cam = view.cam_from_world.apply(found.points.points_in_world)
    column, row = np.rint(CAMERA.project(in_cam)).astype(int).T
    np.testing.assert_allclose(in_cam[:, 2], depth.depth[row, column], rtol=0.02)
    assert np.median(np.abs(in_cam[:, 2] / depth.depth[row, column] - 1)) < 1e-3
    everything = sum(len(fused(k).points) for k in ROWS)
    confirmed = [fused(k).confirmed.sum() for k in ROWS]
    assert max(confirmed) < everything < 0.6 * sum(confirmed)
    lengths = np.linalg.norm(found.points.normals, axis=1)
    assert ((np.abs(lengths - 1) < 1e-3) | (lengths == 0)).all() and (lengths > 0).mean() > 0.95
    toward = view.cam_from_world.inverse().translation - found.points.points_in_world
    assert ((found.points.normals * toward).sum(axis=1) >= -1e-6).all()


def test_the_ground_has_a_normal_upward():
    found = fused().points
    ground = found.points_in_world[:, 2] < 0.03
    assert np.median(found.normals[ground, 2]) > 0.9


def test_points_before_what_others_see_are_not_confirmed():
    def nearer(depth):
        moved = depth.depth.copy()
        moved[100:140, 100:200] *= 0.8
        return replace(depth, depth=moved, num_agreeing=np.full_like(depth.num_agreeing, 5))

    found = fused(change=nearer)
    assert found.confirmed[100:140, 100:200].mean() < 0.02
    assert found.confirmed[150:, 100:200].mean() > 0.9


def test_a_depth_that_no_other_view_has_needs_three_sources():
    view, depth = exact(10)
    few = replace(depth, num_agreeing=np.full_like(depth.num_agreeing, 2))
    assert not fuse_view(view, few, []).confirmed.any()
    many = replace(depth, num_agreeing=np.full_like(depth.num_agreeing, 3))
    np.testing.assert_array_equal(fuse_view(view, many, []).confirmed, np.isfinite(depth.depth))


def test_no_depth_gives_no_points():
    def nothing(depth):
        nan = np.full_like(depth.depth, np.nan)
        return replace(depth, depth=nan, sigma=nan)

    found = fused(change=nothing)
    assert len(found.points) == 0 and not found.confirmed.any()
    assert (
        len(DensePoints.joined([])) == 0
        and len(DensePoints.joined([found.points, fused().points]).every(7)) > 0
    )
    with pytest.raises(ConfigError, match="step"):
        found.points.every(0)
    view, depth = exact(10)
    smaller = ViewDepth(*(getattr(depth, name)[1:] for name in ("depth", "sigma", "reason", "num_agreeing")))
    with pytest.raises(ShapeError, match="different sizes"):
        fuse_view(view, smaller, [])


def test_any_number_of_views_may_agree():
    view, depth = exact(10)
    found = [fuse_view(view, depth, [exact(11)] * count).confirmed.sum() for count in (255, 256, 300)]
    assert found[0] == found[1] == found[2] > 0


@reference_of(_fusion_kernels.compare_rows, _fusion_kernels.normal_rows)
def test_kernels_do_what_their_python_does(monkeypatch):
    compared = record_calls(monkeypatch, fusion, _fusion_kernels.compare_rows)
    normals = record_calls(monkeypatch, normals_module, _fusion_kernels.normal_rows)
    fused()
    for kernel, calls, start in (
        (_fusion_kernels.compare_rows, compared, 4),
        (_fusion_kernels.normal_rows, normals, 4),
    ):
        arguments = list(calls[len(calls) // 2])
        arguments[start + 1] = arguments[start] + 4
        assert_same_as_python(kernel, *arguments, rtol=2e-4, atol=1e-5)


def test_a_sample_does_not_keep_the_memory_of_all_points():
    points = DensePoints(
        np.zeros((100, 3)),
        np.zeros((100, 3), np.float32),
        np.zeros((100, 3), np.uint8),
        np.ones(100, np.float32),
    )
    few = points.every(10)
    assert len(few) == 10
    for name in ("points_in_world", "normals", "rgb", "sigma"):
        assert not np.shares_memory(getattr(few, name), getattr(points, name))
