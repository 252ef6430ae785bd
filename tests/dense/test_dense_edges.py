"""Depth at edges: the cost of a window, and the choice between depths."""

import cv2
import numpy as np
import pytest
from dense_scenes import CAMERA, RANGE, rendered, times_seen

from epipole.dense import _edge_kernels, depth_edges
from epipole.dense import depth as depth_module
from epipole.dense.depth import view_depth
from epipole.dense.depth_edges import choose_at_edges
from epipole.dense.view import intrinsics_of
from epipole.scene.view_depth import DepthReason
from kernel_references import assert_same_as_python, record_calls, reference_of

REFERENCE, SOURCES = 10, (8, 9, 11, 12, 13)


def scene(*rows):
    views, depths = rendered()
    return [views[k] for k in rows], depths[rows[0]]


def slopes_of(inverse):
    out = np.zeros((*inverse.shape, 2), np.float32)
    _edge_kernels.slope_rows(inverse.astype(np.float32), 5, np.float32(0.02), 0, len(inverse), out)
    return out


def test_slopes_of_a_plane_are_exact_on_both_sides_of_an_edge():
    v, u = np.mgrid[:40, :60].astype(np.float64)
    inverse = np.where(u < 30, 0.5 + 1e-4 * u - 2e-4 * v, 0.2 - 5e-5 * u)
    slopes = slopes_of(inverse)
    np.testing.assert_allclose(slopes[:, :30], np.broadcast_to([1e-4, -2e-4], (40, 30, 2)), atol=1e-7)
    np.testing.assert_allclose(slopes[:, 30:], np.broadcast_to([-5e-5, 0.0], (40, 30, 2)), atol=1e-7)


def test_the_cost_is_smallest_at_the_true_depth():
    (reference, source), truth = scene(10, 11)
    gray, other = (cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY) for view in (reference, source))
    motion, k = source.cam_from_world @ reference.cam_from_world.inverse(), intrinsics_of(CAMERA)
    view = motion.rotation.ravel(), motion.translation, k
    slopes, seen = slopes_of(1.0 / truth), times_seen(10, (11,)) == 1
    weights, values = np.empty(25), np.empty(25)
    best = []
    for v, u in np.argwhere(seen[20:-20, 20:-20])[::97] + 20:
        variance = _edge_kernels.window_of(gray, u, v, weights, values)
        ray = (u - k[2]) / k[0], (v - k[3]) / k[1], 1 / k[0], 1 / k[1]
        costs = [
            _edge_kernels.cost_in_source(
                other, view, ray, (scale / truth[v, u], *slopes[v, u].tolist()), weights, values, variance
            )
            for scale in (0.85, 1.0, 1.15)
        ]
        if variance > 30:
            best.append(int(np.argmin(costs)))
    assert len(best) > 100 and np.mean(np.array(best) == 1) > 0.85


def test_a_wrong_depth_beside_an_edge_is_replaced_and_a_hole_is_filled():
    (reference, *sources), truth = scene(REFERENCE, *SOURCES)
    inverse = np.nan_to_num(1.0 / truth).astype(np.float32)
    wider = cv2.dilate(inverse, np.ones((5, 5), np.uint8))  # the foreground grows by two pixels
    seen = times_seen(REFERENCE, SOURCES) >= 2
    wrong = (wider > 1.05 * inverse) & seen & np.isfinite(truth)
    holes = np.zeros(truth.shape, bool)
    holes[100:104] = True
    given = np.where(holes | ~np.isfinite(truth), np.nan, wider).astype(np.float32)
    raw = np.full((len(sources), *truth.shape), np.nan, np.float32)
    grays = [cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY) for view in (reference, *sources)]
    choice = choose_at_edges(given, holes, raw, grays, depth_module._views_of(reference, sources))
    error = np.abs(choice.inverse_depth * truth - 1.0)
    assert wrong.sum() > 300 and (error[wrong] < 0.03).mean() > 0.7
    filled = holes & seen & (choice.cost < 0.2)
    assert filled.sum() > 300 and (error[filled] < 0.02).mean() > 0.9
    untouched = ~choice.zone
    np.testing.assert_array_equal(choice.inverse_depth[untouched], given[untouched])


def test_edges_have_fewer_wrong_pixels_than_without_the_choice(monkeypatch):
    (reference, *sources), truth = scene(REFERENCE, *SOURCES)
    found = view_depth(reference, sources, RANGE)
    monkeypatch.setattr(depth_module, "_choose_at_edges", lambda *_: None)
    before = view_depth(reference, sources, RANGE)

    def right_and_wrong(result):
        error, known = np.abs(result.depth / truth - 1.0), result.reason == DepthReason.OK
        return (error <= 0.01).sum(), (known & ~(error <= 0.05)).sum()

    right, wrong = right_and_wrong(found)
    right_before, wrong_before = right_and_wrong(before)
    assert right > 1.01 * right_before and wrong <= wrong_before


@pytest.mark.parametrize("num", [1, 2])
def test_few_sources_and_images_without_texture_change_nothing(num):
    (reference, *sources), _ = scene(REFERENCE, *SOURCES[:num])
    shape = reference.rgb.shape[:2]
    flat = np.full(shape, 90, np.uint8)
    inverse = np.full(shape, 0.2, np.float32)
    inverse[:, 100:] = 0.4
    raw = np.full((num, *shape), np.nan, np.float32)
    views = depth_module._views_of(reference, sources)
    choice = choose_at_edges(inverse, np.zeros(shape, bool), raw, [flat] * (num + 1), views)
    assert choice.zone[:, 97:103].all() and not choice.zone[:, :90].any()
    np.testing.assert_array_equal(choice.inverse_depth, inverse)
    assert (choice.cost == _edge_kernels.HIDDEN).all() and not choice.num_matching.any()


@reference_of(
    _edge_kernels.slope_rows,
    _edge_kernels.choose_rows,
    _edge_kernels.window_of,
    _edge_kernels.cost_in_source,
)
def test_kernels_do_what_their_python_does(monkeypatch):
    (reference, *sources), _ = scene(REFERENCE, *SOURCES)
    row = (_edge_kernels.slope_rows, _edge_kernels.choose_rows)
    calls = {kernel: record_calls(monkeypatch, depth_edges, kernel) for kernel in row}
    view_depth(reference, sources, RANGE)
    for kernel, recorded in calls.items():
        arguments = list(recorded[len(recorded) // 2])
        arguments[-2] = arguments[-3] + 2  # two rows
        assert_same_as_python(kernel, *arguments, rtol=1e-5, atol=1e-7)
