"""A sample of the points covers the images, and determines the cameras nearly as well as all of them."""

import numpy as np
import pytest
from test_mapping_components import CAMERA, view_graph

from epipole.geometry import Rigid3, Rotation3, align_points
from epipole.mapping import (
    Freedom,
    ModelBuilder,
    PointViews,
    adjust_all,
    adjust_sample,
    adjustment,
    connect_matches,
    sample_points,
)
from epipole.mapping import _track_kernels as track_kernels
from epipole.mapping import _view_kernels as view_kernels
from epipole.mapping.point_sample import CELLS, LEAST_PER_IMAGE
from epipole.optim import BundleConfig
from epipole.scene import Cameras
from kernel_references import assert_same_as_python, reference_of

NUM_IMAGES, FIXED = 8, Freedom(focal=False, distortion=False)


def row_of_cameras(num_images=NUM_IMAGES):
    """Cameras side by side that look at the same wall."""
    x = np.linspace(-1.0, 1.0, num_images)
    centers = np.stack([x, 0.1 * np.sin(5 * x), -4.0 + 0.2 * np.cos(7 * x)], axis=1)
    rotations = np.stack([Rotation3.exp(np.array([0.0, -0.1 * c, 0.02])).matrix for c in x])
    return Rigid3(rotations, -np.einsum("nab,nb->na", rotations, centers))


def model_of(rng, num_points=3000, noise_px=0.5, off=0.01):
    """All cameras see all points; the model starts near the truth."""
    truth, points = row_of_cameras(), rng.uniform(-1.2, 1.2, (num_points, 3)) * [1.0, 0.7, 0.6]
    keypoints = [
        CAMERA.project(pose.apply(points)) + noise_px * rng.normal(size=(num_points, 2)) for pose in truth
    ]
    same = np.stack([np.arange(num_points)] * 2, axis=1)
    graph = view_graph([(i, i + 1) for i in range(NUM_IMAGES - 1)], [same] * (NUM_IMAGES - 1))
    starts = np.arange(NUM_IMAGES + 1, dtype=np.int64) * num_points
    model = ModelBuilder(
        Cameras.from_list([CAMERA]), np.zeros(NUM_IMAGES, np.int32), keypoints, connect_matches(graph, starts)
    )
    for k, pose in enumerate(truth):
        model.register(k, Rigid3.exp(off * rng.normal(size=6)) @ pose)
    model.triangulate(np.arange(len(model.components)), 100.0, np.deg2rad(1.0))
    return truth, model


def center_error(model, truth):
    found, expected = model.registered_poses().centers(), truth.centers()
    return np.sqrt(((align_points(found, expected).apply(found) - expected) ** 2).sum(axis=1).mean())


def test_a_sample_covers_every_image_with_fewer_points(rng):
    _, model = model_of(rng)
    chosen = sample_points(model)
    assert 0.02 < chosen.mean() < 0.2
    seen = np.flatnonzero(model.row_point >= 0)
    size = np.array([CAMERA.width, CAMERA.height])
    for image in range(NUM_IMAGES):
        rows = seen[model.row_image[seen] == image]
        kept = rows[chosen[model.row_point[rows]]]
        assert len(kept) >= LEAST_PER_IMAGE
        cells = [
            {tuple(c) for c in np.clip(model.row_pixel[r] * CELLS / size, 0, CELLS - 1).astype(int)}
            for r in (rows, kept)
        ]
        assert len(cells[1]) > 0.6 * len(cells[0])


def test_images_with_few_observations_keep_them(rng):
    _, model = model_of(rng, num_points=60)
    assert sample_points(model).all()


def test_cameras_are_nearly_as_right_as_with_all_points(rng):
    truth, model = model_of(rng)
    start = model.snapshot()
    config = BundleConfig(max_iterations=20)
    adjust_all(model, config, FIXED)
    whole, cost = center_error(model, truth), reprojection_cost(model)
    model.restore(start)
    before = center_error(model, truth)
    adjust_sample(model, config, FIXED)
    assert center_error(model, truth) < min(6.0 * whole, 0.1 * before)
    assert reprojection_cost(model) < 1.02 * cost  # the other points have moved with the cameras


def reprojection_cost(model):
    seen = np.flatnonzero(model.row_point >= 0)
    total = 0.0
    for image in range(NUM_IMAGES):
        rows = seen[model.row_image[seen] == image]
        points = model.cam_from_world(image).apply(model.points[model.row_point[rows]])
        total += ((CAMERA.project(points) - model.row_pixel[rows]) ** 2).sum()
    return total


def test_a_small_model_is_adjusted_with_all_points(rng, monkeypatch):
    _, model = model_of(rng, num_points=150)
    calls = []
    monkeypatch.setattr(adjustment, "adjust_all", lambda *given: calls.append(given))
    adjust_sample(model, BundleConfig(), FIXED)
    assert len(calls) == 1 and calls[0][0] is model


@reference_of(track_kernels.cover_cells)
def test_cells_are_covered_as_in_python(rng):
    lengths = rng.integers(2, 7, 50)
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    image = np.concatenate([rng.choice(9, k, replace=False) for k in lengths]).astype(np.int64)
    cell = rng.integers(0, 16, offsets[-1])
    order = np.argsort(-lengths, kind="stable")
    given = (offsets, image, cell, order, 0.4, np.zeros((9, 16), bool), np.zeros(50, bool))
    _, changed = assert_same_as_python(track_kernels.cover_cells, *given)
    covered, chosen = changed[5], changed[6]
    rows = np.flatnonzero(np.repeat(chosen, lengths))
    assert 0 < chosen.sum() < 50
    assert covered[image[rows], cell[rows]].all() and covered.sum() == len({*zip(image[rows], cell[rows])})


@reference_of(view_kernels.closest_views)
@pytest.mark.parametrize("own_image", [0, -1])
def test_the_view_from_the_most_similar_direction_is_found(rng, own_image):
    num_images, num_points = 6, 30
    centers, points = rng.normal(size=(num_images, 3)) * 3.0, rng.normal(size=(num_points, 3))
    pairs = np.argwhere(rng.random((num_points, num_images)) < 0.5)
    point, image = pairs[:, 0].astype(np.int32), pairs[:, 1].astype(np.int32)
    views = PointViews.of(points, centers, point, image, np.arange(len(point), dtype=np.int32))
    np.testing.assert_array_equal(views.point, point[views.keypoint])
    point, image = views.point, views.image
    assert (np.diff(image) >= 0).all()
    away = centers[image] - points[point]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    observed = view_kernels.Observations(point, views.to_camera, views.starts)
    neighbors, least, found = np.array([1, 2, 4], np.int64), 0.2, np.empty(num_points, np.int64)
    given = observed, own_image, neighbors, centers[0], points, least, *views.scratch(), found
    count, changed = assert_same_as_python(view_kernels.closest_views, *given)
    assert (changed[6] == view_kernels.NOT_FOUND).all()
    expected = []
    for j in set(range(num_points)) - {*point[image == own_image]}:
        rows = [r for r in range(len(point)) if point[r] == j and image[r] in neighbors]
        own = (centers[0] - points[j]) / np.linalg.norm(centers[0] - points[j])
        cosines = [own @ away[r] for r in rows]
        if rows and max(cosines) >= least:
            expected.append(rows[int(np.argmax(cosines))])
    assert sorted(changed[8][:count].tolist()) == sorted(expected)
    assert expected


@pytest.mark.parametrize("num_points", [0, 1])
def test_a_model_without_points_has_an_empty_sample(rng, num_points):
    _, model = model_of(rng, num_points=max(num_points, 1))
    if num_points == 0:
        model.clear()
    assert len(sample_points(model)) == model.num_points


def test_large_problems_need_half_the_memory_for_the_same_minimum(monkeypatch):
    models, precise = [], []
    adjust = adjustment.adjust_bundle

    def recorded(problem, config):
        precise.append(not config.single_precision)
        return adjust(problem, config)

    monkeypatch.setattr(adjustment, "adjust_bundle", recorded)
    for largest in (adjustment.LARGE, 10_000):
        monkeypatch.setattr(adjustment, "LARGE", largest)
        models.append(model_of(np.random.default_rng(1))[1])
        adjust_all(models[-1], BundleConfig(function_tolerance=1e-14, max_iterations=100), FIXED)
    assert precise == [True, False]
    usual, large = (model.registered_poses() for model in models)
    np.testing.assert_allclose(large.centers(), usual.centers(), atol=1e-7)
    np.testing.assert_allclose(models[1].points, models[0].points, atol=1e-6)
