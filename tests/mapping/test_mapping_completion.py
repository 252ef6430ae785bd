"""Track completion: points of a model are found in images that did not match them."""

import numpy as np
import pytest
from test_mapping_components import CAMERA, PLACES, view_graph

from epipole.config import MatchConfig
from epipole.features import Features, match_near_pixels
from epipole.geometry import Rigid3
from epipole.mapping import ModelBuilder, connect_matches, drop_short_tracks, find_further_matches
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers import completion
from epipole.pipelines.sfm.mappers.completion import complete_model
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.scene import Cameras


def descriptors_of(rng, count):
    raw = rng.gamma(0.5, size=(count, 128))
    return np.rint(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)


def scene(rng, num_points=80, matched_in_third=20):
    """Three views; only some points are matched in the third, which sees all of them."""
    points = rng.uniform(-1, 1, (num_points, 3))
    keypoints = [CAMERA.project(p.apply(points)) for p in PLACES]
    same = np.stack([np.arange(num_points)] * 2, axis=1)
    part = same[:matched_in_third]
    graph = view_graph([(0, 1), (1, 2), (0, 2)], [same, part, part])
    starts = np.arange(4, dtype=np.int64) * num_points
    model = ModelBuilder(
        Cameras.from_list([CAMERA]), np.zeros(3, np.int32), keypoints, connect_matches(graph, starts)
    )
    for k, pose in enumerate(PLACES):
        model.register(k, pose)
    model.triangulate(np.arange(len(model.components)), 2.0, np.deg2rad(1.0))
    ones = np.ones(num_points, np.float32)
    descriptors = descriptors_of(rng, num_points)
    features = [Features(k.astype(np.float32), ones, ones, descriptors) for k in keypoints]
    return graph, starts, model, features


def test_missing_observations_are_found(rng):
    graph, starts, model, features = scene(rng)
    further = find_further_matches(model, features, 3.0, MatchConfig(max_ratio=1.0))
    assert (further.keypoint1 == further.keypoint2).all()
    assert {*further.image2[further.image2 == 2].tolist()} == {2}
    assert {*further.keypoint2.tolist()} == {*range(20, 80)}
    components = connect_matches(graph, starts, further)
    assert len(components) == 80 and (np.diff(components.offsets) == 3).all()


def test_a_feature_that_looks_different_is_not_taken(rng):
    _, _, model, features = scene(rng)
    third = features[2]
    other = Features(third.pixels, third.scale_px, third.angle_rad, descriptors_of(rng, len(third)))
    assert len(find_further_matches(model, [*features[:2], other], 3.0, MatchConfig(max_ratio=1.0))) == 0


def test_a_feature_that_is_elsewhere_is_not_taken(rng):
    _, _, model, features = scene(rng)
    third = features[2]
    moved = Features(third.pixels + 20.0, third.scale_px, third.angle_rad, third.descriptors)
    found = find_further_matches(model, [*features[:2], moved], 3.0, MatchConfig(max_ratio=1.0))
    assert len(found) == 0


def test_images_without_common_points_are_no_neighbors(rng):
    _, _, model, features = scene(rng, matched_in_third=10)
    assert len(find_further_matches(model, features, 3.0, MatchConfig())) == 0


@pytest.mark.parametrize("num_searches", [1, 2])
def test_the_second_search_finds_what_a_wrong_pose_hides_from_the_first(rng, monkeypatch, num_searches):
    monkeypatch.setattr(completion, "SEARCHES", num_searches)
    graph, starts, model, features = scene(rng)
    third = PLACES[2]
    off = 2.0 * 5.0 / CAMERA.focal_px  # two pixels at the mean depth
    moved = Rigid3(third.rotation, third.translation + np.array([off, 0.0, 0.0]))
    model.register(2, moved)
    mapper = IncrementalMapper(model, graph, MapperConfig(min_angle_deg=1.0), is_last=False)
    complete_model(mapper, features, starts)
    observed = np.bincount(model.row_point[model.row_point >= 0])
    assert (observed == 3).sum() == {1: 20, 2: 80}[num_searches]


@pytest.mark.parametrize(("num_long", "num_left"), [(20, 20), (21, 80)])
def test_short_tracks_go_where_images_have_enough_long_ones(rng, num_long, num_left):
    _, _, model, _ = scene(rng)
    dropped = drop_short_tracks(model, 3, num_long)
    left = len(np.unique(model.row_point[model.row_point >= 0]))
    assert left == num_left and dropped == 80 - num_left


def test_near_pixels_is_the_exhaustive_search(rng):
    n, m, radius = 60, 400, 6.0
    pixels = rng.uniform(0, 200, (m, 2))
    at = np.concatenate([pixels[:n] + rng.normal(0, 2, (n, 2)), [[np.nan, 3.0], [-50.0, 10.0], [1e300, 5.0]]])
    features = Features(
        pixels.astype(np.float32), np.ones(m, np.float32), np.ones(m, np.float32), descriptors_of(rng, m)
    )
    wanted = np.concatenate([features.descriptors[:n], features.descriptors[:3]])
    matches, angles = match_near_pixels(at, wanted, features, radius, MatchConfig(max_ratio=0.9))
    similarity = wanted.astype(np.int64) @ features.descriptors.astype(np.int64).T
    distance = np.linalg.norm(at[:, None] - features.pixels.astype(np.float64), axis=2)
    similarity[~(distance <= radius)] = -1
    expected = []
    for i, row in enumerate(similarity):
        j = int(row.argmax())
        first, second = np.arccos(np.clip(np.array([row[j], np.delete(row, j).max()]) / 512.0**2, 0, 1))
        if row[j] >= 0 and first < 0.9 * second and first <= 0.7 and similarity[:, j].max() == row[j]:
            expected.append((i, j))
    assert [tuple(pair) for pair in matches] == expected and len(expected) > 30
    assert (angles <= 0.7).all()
