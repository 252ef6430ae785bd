"""Bundle adjustment's loops against the interpreter, whose rows are NumPy's, and against dense algebra."""

from dataclasses import replace
from functools import cache
from importlib import import_module
from itertools import pairwise

import numpy as np
import pytest
from bundle_rings import ring

from epipole.optim import (
    BundleConfig,
    BundlePriors,
    PointDistances,
    PointPositions,
    adjust_bundle,
    bundle_covariance,
    bundle_layout,
    bundle_system,
    with_fixed_gauge,
)
from epipole.optim import _bundle_kernels as kernels
from epipole.optim import _bundle_layout_kernels as layout_kernels
from epipole.optim import _bundle_reduced_kernels as reduced_kernels
from epipole.optim._bundle_arrays import Entries
from epipole.optim.bundle_problem import BundleProblem
from epipole.optim.bundle_system import LinearSolver
from epipole.optim.losses import Loss
from kernel_references import assert_same_as_python, record_calls, reference_of

# Vectors of the processor round a product and a sum once, NumPy twice; eliminating a point multiplies what that leaves.
ROUNDING = {"rtol": 1e-11, "of_largest": 1e-12}
CALLED_BY = {
    bundle_system: (
        *(
            kernels.find_visible,
            kernels.linearize,
            reduced_kernels.substitute_back,
            reduced_kernels.add_images,
        ),
        *(
            reduced_kernels.multiply_eliminated,
            kernels.total_cost,
            kernels.damp_points,
            reduced_kernels.reduce_rows,
        ),
        layout_kernels.count_pairs,
    ),
    bundle_layout: (layout_kernels.sort_by_node, layout_kernels.find_pattern, layout_kernels.find_entries),
}


def rig(num_sensors: int, num_points: int = 7) -> BundleProblem:
    """A few points, one held, one behind its cameras, one seen once, one by nobody; an observation that is no number."""
    _, start = ring(np.random.default_rng(5), num_frames=6, num_points=num_points, num_sensors=num_sensors)
    free, points, pixels, offsets = (
        np.ones(num_points),
        start.points_in_world.copy(),
        start.pixels.copy(),
        start.offsets.copy(),
    )
    free[0] = 0.0
    points[1] = (40.0, 1.0, 2.0)
    pixels[offsets[2]] = np.nan
    offsets[-1], offsets[-2] = offsets[-3] + 1, offsets[-3] + 1
    end = offsets[-1]
    columns = {name: getattr(start, name)[:end] for name in ("frame", "sensor", "camera")}
    sensor_free = np.repeat(np.arange(num_sensors)[:, None] > 0, 6, axis=1).astype(float)
    return with_fixed_gauge(
        replace(
            start,
            points_in_world=points,
            point_free=free,
            pixels=pixels[:end],
            offsets=offsets,
            sensor_free=sensor_free,
            **columns,
        )
    )


VARIANTS = {
    "direct": (1, BundleConfig(loss=Loss.CAUCHY, solver=LinearSolver.DIRECT, max_iterations=2), None),
    "iterative": (2, BundleConfig(loss=Loss.TRIVIAL, solver=LinearSolver.ITERATIVE, max_iterations=2), None),
    "distances": (
        1,
        BundleConfig(loss=Loss.TUKEY, loss_scale_px=4.0, solver=LinearSolver.DIRECT, max_iterations=2),
        BundlePriors(
            distances=PointDistances(np.array([2]), np.array([3]), np.array([1.0]), np.array([0.1]))
        ),
    ),
    "positions": (
        1,
        BundleConfig(loss=Loss.CAUCHY, loss_scale_px=2.0, solver=LinearSolver.DIRECT, max_iterations=2),
        BundlePriors(points=PointPositions(np.array([2]), np.ones((1, 3)), np.full((1, 3), 0.1))),
    ),
    "empty": (1, BundleConfig(solver=LinearSolver.DIRECT, max_iterations=2), None),
}


@cache
def calls_of(variant: str) -> dict[object, list[tuple[object, ...]]]:
    """What each kernel is called with in two steps of an adjustment."""
    num_sensors, config, priors = VARIANTS[variant]
    problem = replace(rig(num_sensors), priors=priors)
    if variant == "positions":
        problem = replace(problem, point_sigma_px=np.linspace(0.5, 2.0, len(problem.point_free)))
    if variant == "empty":
        nothing = {
            name: getattr(problem, name)[:0]
            for name in ("frame", "sensor", "camera", "pixels", "points_in_world", "point_free")
        }
        problem = replace(problem, offsets=np.zeros(1, np.int64), **nothing)
    with pytest.MonkeyPatch.context() as patch:
        calls = {k: record_calls(patch, module, k) for module, own in CALLED_BY.items() for k in own}
        adjust_bundle(problem, config)
    return calls


def compare(kernel: object, variant: str, **tolerances: float) -> list[object]:
    """Compare the first and the last call; what each left behind."""
    calls = calls_of(variant)[kernel]
    assert calls or variant == "empty"
    return [assert_same_as_python(kernel, *calls[at], **tolerances) for at in (0, -1)[: len(calls)]]


every_variant = pytest.mark.parametrize("variant", list(VARIANTS))


@every_variant
@reference_of(
    layout_kernels.find_entries,
    layout_kernels.sort_by_node,
    layout_kernels.find_pattern,
    layout_kernels.count_pairs,
)
def test_who_meets_whom(variant: str) -> None:
    compare(layout_kernels.find_entries, variant)
    for _, (start, node, point, by_node, node_start, _) in compare(layout_kernels.sort_by_node, variant):
        np.testing.assert_array_equal(point, np.repeat(np.arange(len(start) - 1), np.diff(start)))
        np.testing.assert_array_equal(by_node, np.argsort(node, kind="stable"))
        assert node_start[-1] == len(node)
    if variant in ("direct", "distances", "positions"):
        compare(layout_kernels.find_pattern, variant)
        arguments = calls_of(variant)[layout_kernels.find_pattern][0]
        start, node, _, _, _, _, row_count, column = arguments
        total, (*_, row_count, column) = assert_same_as_python(layout_kernels.find_pattern, *arguments)
        meet = np.zeros((len(row_count),) * 2, bool)
        for a, b in pairwise(start):
            meet[np.ix_(node[a:b], node[a:b])] = True
        np.testing.assert_array_equal(row_count, np.tril(meet).sum(axis=1))
        for a, own in enumerate(np.split(column[:total], np.cumsum(row_count)[:-1])):
            np.testing.assert_array_equal(np.sort(own), np.flatnonzero(meet[a, : a + 1]))
        counting = (*arguments[:7], np.empty(0, np.int64))
        assert assert_same_as_python(layout_kernels.find_pattern, *counting)[0] == total
    for total, (start, node, work) in compare(layout_kernels.count_pairs, variant):
        many = np.diff(start)
        assert total == (many**2).sum()
        np.testing.assert_array_equal(work, np.bincount(node, np.repeat(many, many), minlength=len(work)))


@every_variant
@reference_of(kernels.find_visible, kernels.total_cost, kernels.damp_points)
def test_costs(variant: str) -> None:
    for _, (obs, *_, scene) in compare(kernels.find_visible, variant):
        point = np.repeat(np.arange(len(obs.offsets) - 1), np.diff(obs.offsets))
        position = scene.cam_from_world[obs.image]
        depth = (position[:, 6:9] * scene.points[point]).sum(axis=1) + position[:, 11]
        np.testing.assert_array_equal(obs.used, (depth > 0) & np.isfinite(obs.pixels).all(axis=1))
    compare(kernels.total_cost, variant, rtol=1e-12)
    compare(kernels.damp_points, variant, **ROUNDING)


@every_variant
@reference_of(kernels.linearize, reduced_kernels.substitute_back, reduced_kernels.add_images)
def test_normal_equations(variant: str) -> None:
    compare(kernels.linearize, variant, **ROUNDING)
    compare(reduced_kernels.substitute_back, variant, **ROUNDING)
    for _, (unknowns, normal, gradient, _, _, out, _) in compare(reduced_kernels.add_images, variant):
        frames = unknowns.nodes[:, 0]
        expected = np.zeros((len(out), 6))
        np.add.at(expected, frames[frames >= 0], gradient[frames >= 0, :6])
        np.testing.assert_allclose(out[frames[frames >= 0], :6], expected[frames[frames >= 0]])
        assert normal.shape[0] == len(frames)


def dense_z(entries: Entries, z: np.ndarray, num_nodes: int) -> np.ndarray:
    """Z as one matrix (nodes * lanes, points * 3)."""
    lanes = z.shape[2]
    out = np.zeros((num_nodes, lanes, len(entries.start) - 1, 3))
    for j in range(out.shape[2]):
        for e in range(entries.start[j], entries.start[j + 1]):
            out[entries.node[e], :, j] += z[e].T
    return out.reshape(num_nodes * lanes, -1)


@reference_of(reduced_kernels.reduce_rows)
def test_the_reduced_system() -> None:
    for variant in ("direct", "iterative", "distances", "positions"):
        ((_, after), *_) = compare(reduced_kernels.reduce_rows, variant, **ROUNDING)
        _, stop, entries, z, row_start, column, blocks, _, _ = after
        before = calls_of(variant)[reduced_kernels.reduce_rows][0][6]
        lanes = z.shape[2]
        whole = dense_z(entries, z, stop)
        product = (whole @ whole.T).reshape(stop, lanes, stop, lanes)
        row = np.repeat(np.arange(stop), np.diff(row_start))
        np.testing.assert_allclose(blocks, before - product[row, :, column], atol=1e-9 * np.abs(before).max())


@reference_of(reduced_kernels.multiply_eliminated)
def test_products_without_the_matrix() -> None:
    for _, (entries, _, _, z, x, out, _, _) in compare(
        reduced_kernels.multiply_eliminated, "iterative", **ROUNDING
    ):
        whole = dense_z(entries, z, len(x))
        np.testing.assert_allclose(out.ravel(), whole @ (whole.T @ x.ravel()), atol=1e-9 * np.abs(out).max())


@reference_of(reduced_kernels.point_covariances)
def test_covariances_of_points(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = record_calls(
        monkeypatch, import_module("epipole.optim.bundle_covariance"), reduced_kernels.point_covariances
    )
    problem = rig(1)
    bundle_covariance(problem, adjust_bundle(problem, BundleConfig(max_iterations=2)), noise_px=1.0)
    ((entries, _, stop, *rest),) = calls
    for rows in ((0, stop), (2, 3), (4, 4)):
        arguments = (entries, *rows, *rest[:-1], np.zeros_like(rest[-1]))
        assert_same_as_python(reduced_kernels.point_covariances, *arguments, rtol=1e-10, of_largest=1e-12)
