"""The numbers of a model against independent expressions."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from report_ring import empty_model, graph_of, ring_model

from epipole.geometry import ray_angles_rad
from epipole.pipelines.sfm.page.statistics import (
    num_low_parallax_pairs,
    statistics_of,
    widest_angles_rad,
)
from epipole.scene import Points, Reconstruction


def test_widest_angle_is_the_greatest_over_all_pairs(model: Reconstruction) -> None:
    centers, angles = model.camera_centers_in_world(), widest_angles_rad(model)
    for j in range(0, len(model.points), 17):
        images = model.tracks.image[model.tracks.offsets[j] : model.tracks.offsets[j + 1]]
        point = model.points.xyz_in_world[j]
        pairs = [ray_angles_rad(point, centers[a], centers[b]) for a, b in combinations(images, 2)]
        assert angles[j] == pytest.approx(max(pairs), abs=1e-9)


def test_a_point_seen_once_has_no_angle(model: Reconstruction) -> None:
    tracks = replace(
        model.tracks,
        offsets=np.array([0, 1]),
        image=model.tracks.image[:1],
        keypoint=model.tracks.keypoint[:1],
    )
    own = model.points
    points = Points(own.xyz_in_world[:1], own.rgb[:1], own.error_px[:1])
    angles = widest_angles_rad(replace(model, points=points, tracks=tracks))
    assert len(angles) == 1 and np.isnan(angles).all()


def test_counts_and_errors() -> None:
    noisy = ring_model(num_points=300, noise_px=0.4)
    statistics = statistics_of(noisy)
    assert (statistics.num_images, statistics.num_registered, statistics.num_points) == (12, 10, 300)
    assert statistics.num_observations == statistics.track_length.sum() == len(statistics.error_px)
    # The length of a 2D Gaussian error of deviation s has the mean s sqrt(pi / 2).
    assert statistics.mean_error_px == pytest.approx(0.4 * np.sqrt(np.pi / 2), rel=0.05)
    assert statistics.mean_track_length == pytest.approx(10 * 2 / 3, rel=0.05)


def test_an_empty_model_has_empty_distributions() -> None:
    statistics = statistics_of(empty_model(4))
    assert (statistics.num_registered, statistics.num_points, statistics.num_observations) == (0, 0, 0)
    assert np.isnan(statistics.mean_error_px)
    assert np.isnan(statistics.mean_track_length)
    assert len(statistics.finite_angle_rad) == 0


def test_low_parallax_pairs_ignore_unknown_angles(model: Reconstruction) -> None:
    graph = graph_of(model)
    angles = np.full(len(graph), np.deg2rad(30.0))
    angles[:3], angles[3:5] = np.deg2rad(1.9), np.nan
    assert num_low_parallax_pairs(replace(graph, median_angle_rad=angles)) == 3
