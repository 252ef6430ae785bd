"""Components of matches, triangulation of tracks, consistency."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.mapping import MatchConsistency, ModelBuilder, connect_matches
from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph
from epipole.synthetic import look_at

CAMERA = Camera(CameraModel.PINHOLE, 1000, 800, np.array([900.0, 900.0, 499.5, 399.5]))


def view_graph(pairs, matches):
    n = len(pairs)
    stacked = np.concatenate(matches)
    unknown = np.full((n, 3, 3), np.nan)
    return ViewGraph(
        np.array([p[0] for p in pairs], np.int32),
        np.array([p[1] for p in pairs], np.int32),
        np.full(n, int(PairKind.GENERAL), np.int32),
        np.array([len(m) for m in matches], np.int32),
        np.concatenate([[0], np.cumsum([len(m) for m in matches])]).astype(np.int64),
        stacked[:, 0].astype(np.int32),
        stacked[:, 1].astype(np.int32),
        Rigid3(unknown, np.full((n, 3), np.nan)),
        *(unknown, unknown, unknown),
        np.full(n, 0.2),
    )


PLACES = [look_at((5 * np.cos(a), 5 * np.sin(a), 1.0), (0, 0, 0)) for a in (0.0, 0.25, 0.5)]


def scene(rng, positions=PLACES, num_points=80):
    points = rng.uniform(-1, 1, (num_points, 3))
    keypoints = [CAMERA.project(p.apply(points)) for p in positions]
    same = np.stack([np.arange(num_points)] * 2, axis=1)
    graph = view_graph([(0, 1), (1, 2), (0, 2)], [same, same, same])
    starts = np.arange(4, dtype=np.int64) * num_points
    model = ModelBuilder(
        Cameras.from_list([CAMERA]), np.zeros(3, np.int32), keypoints, connect_matches(graph, starts)
    )
    return positions, points, graph, model


def test_components_join_pairs_into_tracks(rng):
    _, points, _, model = scene(rng)
    assert len(model.components) == len(points)
    assert (np.diff(model.components.offsets) == 3).all()


def test_a_conflicting_match_is_refused_and_the_stronger_pairs_win():
    # Keypoint 0 of image 2 is matched to keypoint 0 of image 0 (twice) and, wrongly, to keypoint 1 of image 0.
    graph = view_graph(
        [(0, 1), (1, 2), (0, 2)],
        [np.array([[0, 0], [1, 1], [2, 2]]), np.array([[0, 0], [1, 1]]), np.array([[1, 0]])],
    )
    found = connect_matches(graph, np.array([0, 3, 6, 9], np.int64))
    for t in range(len(found)):
        rows = slice(found.offsets[t], found.offsets[t + 1])
        assert len(np.unique(found.image[rows])) == found.offsets[t + 1] - found.offsets[t]
        assert len(set(found.keypoint[rows])) == 1
    assert len(found) == 3


def test_triangulation_is_exact_and_filters_what_does_not_fit(rng):
    positions, points, graph, model = scene(rng)
    for image, position in enumerate(positions):
        model.register(image, position)
    everything = np.arange(len(model.components))
    assert model.triangulate(everything, 4.0, np.deg2rad(1.5)) == 3 * len(points)
    owner = model.row_point[model.components.offsets[:-1]]
    np.testing.assert_allclose(model.points[owner], points, atol=1e-9)
    assert MatchConsistency(model, graph).overall(model) == 1.0
    moved = Rigid3.exp(np.array([0, 0, 0, 0, 0.05, 0])) @ positions[2]
    model.register(2, moved)
    assert model.filter(4.0, np.deg2rad(1.5)) == len(points)
    assert (model.row_point[model.row_image == 2] == -1).all()
    assert MatchConsistency(model, graph).of_images(model)[2] == 0.0


def test_a_wrong_row_is_left_out_of_its_point(rng):
    positions, points, _, model = scene(rng)
    for image, position in enumerate(positions):
        model.register(image, position)
    wrong = np.flatnonzero(model.row_image == 1)[:10]
    model.row_pixel[wrong] += 50
    model.update_rays(0)
    model.triangulate(np.arange(len(model.components)), 4.0, np.deg2rad(1.5))
    assert (model.row_point[wrong] == -1).all()
    owner = model.row_point[model.components.offsets[:-1]]
    np.testing.assert_allclose(model.points[owner], points, atol=1e-9)


@pytest.mark.parametrize(("baseline", "expected"), [(1e-3, 0), (0.05, 0), (0.5, 160)])
def test_narrow_angles_give_no_points(rng, baseline, expected):
    aside = Rigid3.exp(np.array([baseline, 0, 0, 0, 0, 0])) @ PLACES[0]
    positions, _, _, model = scene(rng, [PLACES[0], aside, PLACES[2]])
    model.register(0, positions[0])
    model.register(1, positions[1])
    assert model.triangulate(np.arange(len(model.components)), 4.0, np.deg2rad(1.5)) == expected


def test_a_snapshot_brings_the_model_back(rng):
    positions, _, _, model = scene(rng)
    model.register(0, positions[0])
    model.register(1, positions[1])
    model.triangulate(np.arange(len(model.components)), 4.0, np.deg2rad(1.5))
    state, before = model.snapshot(), model.points.copy()
    model.clear()
    assert model.num_points == 0 and not model.registered.any()
    model.restore(state)
    np.testing.assert_array_equal(model.points, before)
    np.testing.assert_array_equal(model.registered, [True, True, False])


@pytest.mark.parametrize("depth", [0.0, 1e-15, 1e-9])
def test_a_point_in_a_cameras_center_is_no_point(rng, depth):
    """There every pixel of that camera fits, and its depth is lost in rounding when the model moves."""
    positions, _, _, model = scene(rng)
    for image, position in enumerate(positions):
        model.register(image, position)
    model.triangulate(np.arange(len(model.components)), 4.0, np.deg2rad(1.5))
    before = (model.row_point >= 0).sum()
    lost = int(model.row_point[0])
    mine = np.flatnonzero(model.row_point == lost)
    model.set_points(
        np.array([lost]), positions[0].inverse().apply(CAMERA.unproject(model.row_pixel[:1]) * depth), mine
    )
    inside = model.points[lost]
    for row in mine[1:]:  # the other views see it where it is; the first sees it wherever it likes
        model.row_pixel[row] = CAMERA.project(positions[model.row_image[row]].apply(inside[None]))[0]
    model.filter(4.0, np.deg2rad(1.5))
    assert model.row_point[mine[0]] == -1
    tilt = Similarity3(np.array(1e-4), Rotation3.exp([0.4, -0.7, 0.2]).matrix, np.array([1.0, 2.0, 3.0]))
    model.move(tilt)
    frozen = model.freeze(["a", "b", "c"])
    assert np.isfinite(frozen.reprojection_errors_px()).all()
    assert np.isfinite(frozen.mean_reprojection_error_px())
    assert (model.row_point >= 0).sum() >= before - 3
