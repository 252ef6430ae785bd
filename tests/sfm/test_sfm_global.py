"""The global mapper, and the choice between it and the incremental one: exact tracks in, the true cameras out."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from sfm_rings import EXACT, errors_of, mapper_of, view_graph_of

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import ModelBuilder, connect_matches
from epipole.pipelines.sfm.mappers.choice import map_with
from epipole.pipelines.sfm.mappers.global_mapper import average_cameras, map_globally
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.pipelines.sfm.matching.pair_selection import consistent_pairs
from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph
from epipole.synthetic.problems import bundle_problem
from mapping_graphs import graph_of_rotations
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked")  # many small calls, of types that other tests check


def with_rotations(graph: ViewGraph, rotation: np.ndarray) -> ViewGraph:
    return replace(graph, cam2_from_cam1=Rigid3(rotation, graph.cam2_from_cam1.translation))


def test_exact_tracks_give_the_true_cameras_and_points(ring, graph):
    mapper, given, rounds = mapper_of(ring, graph), [], []
    assert map_globally(mapper, np.ones(12, bool), lambda *g: given.append(g), lambda *g: rounds.append(g))
    off, rotated = errors_of(mapper, ring)
    assert mapper.model.registered.all() and off.max() < 1e-5 and rotated.max() < 1e-6
    assert len(mapper.model.living_points()) == len(ring.points)
    assert given[0] == (0, 12) and given[-1] == (12, 12)
    assert [done for done, _ in rounds] == sorted(done for done, _ in rounds) and rounds[-1][0] == rounds[-1][
        1
    ]


@pytest.mark.parametrize("seed", range(3))
def test_noise_moves_cameras_by_little(seed):
    noisy = bundle_problem(12, 900, 5, noise_px=0.5, seed=seed).truth
    mapper = mapper_of(noisy, view_graph_of(noisy), replace(EXACT, seed=seed))
    assert map_globally(mapper, np.ones(12, bool))
    off, rotated = errors_of(mapper, noisy)
    assert off.max() < 0.02 and rotated.max() < 0.005


def test_pairs_that_contradict_the_others_change_nothing(ring, graph, rng):
    """A fifth of the pairs rotated at random: far more than matches of the same points can explain."""
    wrong = rng.choice(len(graph), len(graph) // 5, replace=False)
    rotation = graph.cam2_from_cam1.rotation.copy()
    rotation[wrong] = Rotation3.exp(rng.normal(size=(len(wrong), 3))).matrix
    spoiled = with_rotations(graph, rotation)
    mapper = mapper_of(ring, spoiled)
    assert map_globally(mapper, np.ones(12, bool))
    off, _ = errors_of(mapper, ring)
    assert mapper.model.registered.all() and off.max() < 1e-5


def test_only_the_usable_images_are_mapped(ring, graph):
    usable = np.arange(12) < 9
    mapper = mapper_of(ring, graph)
    assert map_globally(mapper, usable)
    np.testing.assert_array_equal(mapper.model.registered, usable)


def test_the_largest_component_is_mapped(ring, graph):
    """Images 0 to 3 have no pair with the others."""
    apart = (graph.image1 < 4) == (graph.image2 < 4)
    cameras = average_cameras(graph.select(apart), np.ones(12, bool), EXACT)
    np.testing.assert_array_equal(cameras.is_member, np.arange(12) >= 4)


def test_images_without_a_known_motion_are_registered_afterwards(ring, graph):
    """All pairs of one image have a guessed focal length: no rotation, but its points are known from the others."""
    touches = (graph.image1 == 5) | (graph.image2 == 5)
    rotation = np.where(touches[:, None, None], np.nan, graph.cam2_from_cam1.rotation)
    mapper = mapper_of(ring, with_rotations(graph, rotation))
    assert map_globally(mapper, np.ones(12, bool))
    off, _ = errors_of(mapper, ring)
    assert mapper.model.registered[5] and off.max() < 1e-5


def test_two_images_are_too_few(ring, graph):
    mapper = mapper_of(ring, graph)
    assert not map_globally(mapper, np.arange(12) < 2)
    assert map_with(mapper, np.arange(12) < 2) == "incremental"  # which needs no third image


def test_a_camera_that_only_turns_gives_no_model(rng):
    """Six images of 200 points from one place, with half a pixel of noise: directions that no depth explains."""
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))
    points = rng.uniform([-1, -1, 4], [1, 1, 8], (200, 3))
    turns = Rotation3.exp(np.array([[0.0, 0.05 * k, 0.0] for k in range(6)])).matrix
    keypoints = [camera.project(points @ turn.T) + 0.5 * rng.normal(size=(200, 2)) for turn in turns]
    pairs = list(combinations(range(6), 2))
    relative = np.array([turns[j] @ turns[i].T for i, j in pairs])
    graph = graph_of_rotations(pairs, relative, [200] * len(pairs))
    graph = replace(graph, kind=np.full(len(graph), PairKind.ROTATION, np.int32))
    cameras = replace(Cameras.from_list([camera]), is_constant=np.ones(1, bool))
    components = connect_matches(graph, np.arange(7, dtype=np.int64) * 200)
    builder = ModelBuilder(cameras, np.zeros(6, np.int32), keypoints, components)
    assert map_with(IncrementalMapper(builder, graph, EXACT), np.ones(6, bool)) is None


def test_the_method_is_that_of_the_options(ring, graph):
    usable = np.ones(12, bool)
    for method, expected in (("incremental", "incremental"), ("global", "global"), ("auto", "global")):
        assert map_with(mapper_of(ring, graph, replace(EXACT, method=method)), usable) == expected
    unknown = with_rotations(graph, np.full((len(graph), 3, 3), np.nan))
    assert map_with(mapper_of(ring, unknown, replace(EXACT, method="global")), usable) is None


def test_without_known_motions_the_incremental_mapper_is_used(ring, graph):
    """Rotations of all pairs but one unknown: that pair starts an incremental model."""
    rotation = graph.cam2_from_cam1.rotation.copy()
    best = int(np.argmax(graph.num_inliers()))
    rotation[np.arange(len(graph)) != best] = np.nan
    kind = np.where(np.arange(len(graph)) == best, graph.kind, PairKind.UNCALIBRATED).astype(np.int32)
    mapper = mapper_of(ring, replace(with_rotations(graph, rotation), kind=kind))
    assert map_with(mapper, np.ones(12, bool)) == "incremental"
    assert mapper.model.registered.all()


def with_false_pairs(truth, graph, rng, fraction=0.3):
    """Replace a fraction of the pairs by false ones with geometry and matches that agree: image c also shows what b shows.

    Returns the keypoints, with those of the look-alikes added, and the pairs, with a mask of the false ones.
    """
    n = len(truth.images)
    own = [truth.images.keypoints_of(i) for i in range(n)]
    keypoints, num_false = [[k] for k in own], round(fraction * len(graph))
    kept = np.ones(len(graph), bool)
    kept[rng.permutation(len(graph))[:num_false]] = False
    pairs = {}
    for e in np.flatnonzero(kept):
        rows = slice(graph.match_offsets[e], graph.match_offsets[e + 1])
        pairs[int(graph.image1[e]), int(graph.image2[e])] = (
            e,
            graph.keypoint1[rows],
            graph.keypoint2[rows],
            False,
        )
    for e in rng.choice(len(graph), num_false, replace=False):
        a, b = int(graph.image1[e]), int(graph.image2[e])
        far = [c for c in range(a + 1, n) if min(c - a, a + n - c) > 5 and (a, c) not in pairs]
        if far:
            c = int(rng.choice(far))
            rows = slice(graph.match_offsets[e], graph.match_offsets[e + 1])
            shift = sum(len(block) for block in keypoints[c])
            keypoints[c].append(own[b])
            pairs[a, c] = (e, graph.keypoint1[rows], graph.keypoint2[rows] + shift, True)
    order = sorted(pairs)
    source = np.array([pairs[p][0] for p in order])
    counts = [len(pairs[p][1]) for p in order]
    mixed = ViewGraph(
        *np.array(order, np.int32).T.copy(),
        graph.kind[source],
        np.array(counts, np.int32),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.concatenate([pairs[p][1] for p in order]).astype(np.int32),
        np.concatenate([pairs[p][2] for p in order]).astype(np.int32),
        graph.cam2_from_cam1[source],
        *(graph.essential[source], graph.fundamental[source], graph.homography[source]),
        graph.median_angle_rad[source],
    )
    return [np.concatenate(k) for k in keypoints], mixed, np.array([pairs[p][3] for p in order])


@pytest.mark.parametrize("seed", range(20 if IS_WHOLE else 1))
@pytest.mark.parametrize("method", ["global", "incremental"])
def test_pairs_that_look_alike_spoil_no_model(seed, method):
    """Three of ten verified pairs show different things, each with matches that agree on one wrong motion."""
    truth = bundle_problem(24, 1500, 6, noise_px=0.3, seed=seed).truth
    rng, config = np.random.default_rng(seed), replace(EXACT, method=method, seed=seed)
    keypoints, mixed, is_false = with_false_pairs(truth, view_graph_of(truth), rng)
    assert is_false.mean() > 0.2
    used, contradiction_rad = consistent_pairs(mixed, keypoints, truth.cameras, truth.camera_of_image, config)
    np.testing.assert_array_equal(np.isfinite(contradiction_rad), is_false)
    assert len(used) == (~is_false).sum()
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    cameras = replace(truth.cameras, is_constant=np.ones(1, bool))
    builder = ModelBuilder(cameras, truth.camera_of_image, keypoints, connect_matches(used, offsets))
    mapper = IncrementalMapper(builder, used, config)
    assert map_with(mapper, np.ones(24, bool)) == method
    off, rotated = errors_of(mapper, truth)
    assert builder.registered.all() and off.max() < 0.02 and np.rad2deg(np.median(rotated)) < 0.2
