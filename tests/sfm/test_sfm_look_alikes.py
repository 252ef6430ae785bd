"""Things that look alike: models that show them as one are found and separated, and right models stay as they are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sfm_rings import EXACT, shared_keypoints, view_graph_of

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import ConflictingPoints, connect_matches, explained_matches, find_conflicting_points
from epipole.mapping.model_builder import ModelBuilder
from epipole.pipelines.sfm.false_pairs import (
    _is_ambiguous,
    are_hinges,
    are_stray,
    are_torn,
    are_within,
    is_connected_by_conflicts,
    is_doubtful,
)
from epipole.pipelines.sfm.look_alikes import Attempt, map_apart, map_once
from epipole.pipelines.sfm.mappers.choice import map_with
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.pipelines.sfm.mapping_stage import Mapped
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks
from whole import in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked")

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))
IMAGES_PER_WALL = 7


def walls(rng, num_walls):
    """Cameras that walk along walls, one after the other, and see 0.8 of what is in view: the model as it is, and with all walls as one.

    The upper half of all walls is the same, and its points have the same numbers in the second model; the lower half is each wall's own.
    """
    num_points, count = 700, num_walls * IMAGES_PER_WALL
    wall = rng.uniform([-2.5, -1.5, 5.0], [2.5, 1.5, 6.0], (num_points, 3))
    alike = wall[:, 1] < 0.0
    own = [
        np.where(alike[:, None], wall, rng.uniform([-2.5, 0, 5], [2.5, 1.5, 6], wall.shape))
        for _ in range(num_walls)
    ]
    along = np.linspace(-1, 1, IMAGES_PER_WALL)[:, None] * [1.0, 0.0, 0.0]
    centers = along + rng.uniform(-0.1, 0.1, (num_walls, IMAGES_PER_WALL, 3))
    rotations = Rotation3.exp(np.outer(np.arange(num_walls), [0.0, 0.5, 0.0])).matrix
    seen, apart, as_one = [], [], []
    for i in range(count):
        k, n = divmod(i, IMAGES_PER_WALL)
        at = CAMERA.project(own[k] - centers[k, n])
        inside = ((at > 0) & (at < [639, 479])).all(axis=1) & (rng.random(num_points) < 0.8)
        seen.append((np.flatnonzero(inside), at[inside]))
        as_one.append(Rigid3(np.eye(3), -centers[k, n]))
        place = Rigid3(rotations[k], np.array([30.0 * k, 0.0, 0.0]))
        apart.append(as_one[-1] @ place.inverse())
    true_points = np.concatenate([own[k] @ rotations[k].T + [30.0 * k, 0, 0] for k in range(num_walls)])
    true = model_of(apart, true_points, seen, lambda k, p: k * num_points + p)
    as_one_points = np.concatenate(own)
    return true, model_of(as_one, as_one_points, seen, lambda k, p: np.where(alike[p], p, k * num_points + p))


def model_of(poses, xyz, seen, number):
    """A model whose image i sees the points `number(wall, rows)`."""
    point = np.concatenate([number(i // IMAGES_PER_WALL, rows) for i, (rows, _) in enumerate(seen)])
    owner = np.concatenate([np.full(len(rows), i) for i, (rows, _) in enumerate(seen)])
    keypoint = np.concatenate([np.arange(len(rows)) for rows, _ in seen])
    order = np.lexsort((owner, point))
    counts, n = np.bincount(point, minlength=len(xyz)), len(seen)
    rows = np.arange(n, dtype=np.int32)
    return Reconstruction(
        Cameras.from_list([CAMERA]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(n, np.int32),
            Rigid3(np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])),
            np.full(n, np.nan),
        ),
        Images(
            tuple(f"{i}.jpg" for i in range(n)),
            rows,
            np.zeros(n, np.int32),
            np.concatenate([[0], np.cumsum([len(rows) for rows, _ in seen])]).astype(np.int64),
            np.concatenate([at for _, at in seen]),
        ),
        Points(xyz, np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz))),
        Tracks(
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            owner[order].astype(np.int32),
            keypoint[order].astype(np.int32),
        ),
    )


def mapping_of(model, graph):
    """What `map_apart` calls: the mappers, on some of the pairs."""
    keypoints = [model.images.keypoints_of(i) for i in range(len(model.images))]
    cameras = replace(model.cameras, is_constant=np.ones(1, bool))

    def map_pairs(used):
        chosen = graph.select(used)
        remaining, models = np.ones(len(keypoints), bool), []
        while remaining.sum() >= 2:
            components = connect_matches(chosen, model.images.keypoint_offsets)
            builder = ModelBuilder(cameras, model.camera_of_image, keypoints, components)
            if map_with(IncrementalMapper(builder, chosen, EXACT), remaining) is None:
                break
            models.append(builder.freeze(model.images.name, None))
            remaining &= ~builder.registered
        count = len(models)
        mapped = Mapped(tuple(models), {}, (None,) * count, (1.0,) * count, ("global",) * count)
        return Attempt(mapped, chosen, np.full(len(used), np.nan))

    return map_pairs


def test_equal_walls_are_mapped_apart(rng):
    _, folded = walls(rng, 2)
    graph = view_graph_of(folded)
    is_false = (graph.image1 < IMAGES_PER_WALL) & (graph.image2 >= IMAGES_PER_WALL)
    assert is_false.sum() > 20
    map_pairs = mapping_of(folded, graph)
    as_one = map_once(graph, map_pairs)
    assert as_one.last.mapped.models[0].is_registered().all() and len(as_one.contradicting) == 0
    assert as_one.conflicts[0].contradicts_model
    found = map_apart(graph, map_pairs)
    registered = sorted(model.is_registered().nonzero()[0].tolist() for model in found.last.mapped.models)
    assert registered == [list(range(IMAGES_PER_WALL)), list(range(IMAGES_PER_WALL, 2 * IMAGES_PER_WALL))]
    assert not any(conflict.contradicts_model for conflict in found.conflicts)
    assert found.contradicting.is_conflicting.all() and len(found.contradicting) == is_false.sum()
    assert "of the points conflict" in found.contradicting.reason(0)


@in_whole_run
def test_three_equal_walls_are_mapped_apart(rng):
    _, folded = walls(rng, 3)
    graph = view_graph_of(folded)
    found = map_apart(graph, mapping_of(folded, graph))
    assert [int(model.is_registered().sum()) for model in found.last.mapped.models] == [IMAGES_PER_WALL] * 3


def test_different_walls_are_mapped_once(rng):
    """Nothing is left out of a right model, and nothing is mapped again."""
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    calls = []

    def counted(used):
        calls.append(used)
        return mapping_of(true, graph)(used)

    found = map_apart(graph, counted)
    assert len(calls) == 1 and len(found.contradicting) == 0
    assert not find_conflicting_points(true).is_contradiction.any()


def test_of_two_pairs_that_a_third_contradicts_both_are_ambiguous():
    image1, image2 = np.array([0, 1, 0, 2], np.int32), np.array([1, 2, 2, 3], np.int32)
    found = _is_ambiguous(4, image1, image2, np.array([5.0, 5.0, -50.0, 9.0]))
    np.testing.assert_array_equal(found, [True, True, False, False])
    weak = _is_ambiguous(4, image1, image2, np.array([5.0, 5.0, -5.0, 9.0]))
    assert not weak.any()


def test_shared_numbers_are_what_looks_alike(rng):
    true, folded = walls(rng, 2)
    assert (
        len(shared_keypoints(true, 0, IMAGES_PER_WALL))
        == 0
        < len(shared_keypoints(folded, 0, IMAGES_PER_WALL))
    )


def rows_of(graph, first, second):
    """Matches of the pairs whose first and second images are in these ranges."""
    chosen = np.isin(graph.image1, first) & np.isin(graph.image2, second)
    return chosen, np.repeat(chosen, graph.num_inliers())


def with_wrong_matches(graph, first, second):
    """The pairs between some images, with the keypoints of the second image shifted by one."""
    _, rows = rows_of(graph, first, second)
    return replace(graph, keypoint2=np.where(rows, np.roll(graph.keypoint2, 1), graph.keypoint2))


def test_matches_of_a_right_model_are_explained_and_wrong_ones_are_not(rng):
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    explained, count = explained_matches(true, graph)
    np.testing.assert_array_equal(explained, graph.num_inliers())
    np.testing.assert_array_equal(count, graph.num_inliers())
    wrong = with_wrong_matches(graph, [0], [2])
    explained, count = explained_matches(true, wrong)
    chosen, _ = rows_of(graph, [0], [2])
    assert explained[chosen] == 0 and (explained == count)[~chosen].all()
    np.testing.assert_array_equal(count, graph.num_inliers())
    lost = model_without(true, [2])
    explained, count = explained_matches(lost, graph)
    has_lost = (graph.image1 == 2) | (graph.image2 == 2)
    assert not count[has_lost].any() and (explained == graph.num_inliers())[~has_lost].all()


def model_without(model, images):
    """The model without the poses and the observations of some images."""
    frames, tracks = model.frames, model.tracks
    lost = np.isin(np.arange(len(model.images)), images)
    kept = ~lost[tracks.image]
    counts = np.bincount(tracks.point_of_observation()[kept], minlength=len(model.points))
    pose = frames.rig_from_world
    return replace(
        model,
        frames=replace(
            frames,
            rig_from_world=Rigid3(
                np.where(lost[:, None, None], np.nan, pose.rotation),
                np.where(lost[:, None], np.nan, pose.translation),
            ),
        ),
        tracks=Tracks(
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            tracks.image[kept],
            tracks.keypoint[kept],
        ),
    )


def test_a_model_is_torn_where_pairs_with_many_matches_are_overruled(rng):
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    used = np.ones(len(graph), bool)
    assert not are_torn(graph, [true], used, ~used).any()
    one = with_wrong_matches(graph, [0], [2])  # the other pairs of image 0 have more matches
    assert not are_torn(one, [true], used, ~used).any()
    most = with_wrong_matches(graph, [0, 1, 2], [4, 5, 6])
    most = with_wrong_matches(most, [0, 1], [3])
    torn = are_torn(most, [true], used, ~used)
    expected, _ = rows_of(graph, [0, 1, 2], [3, 4, 5, 6])
    np.testing.assert_array_equal(torn, expected)
    wrong = (explained_matches(true, most)[0] == 0) & used
    assert not are_torn(most, [true], ~wrong, ~used).any()  # pairs that are not in use overrule nothing


def test_an_image_strays_if_most_of_its_matches_are_in_another_model(rng):
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    used = np.ones(len(graph), bool)
    ends, others = model_without(true, [1, 2, 3, 4, 5]), model_without(true, [0, 6])
    stray = are_stray(graph, [others, ends], used)
    np.testing.assert_array_equal(stray.nonzero()[0], [0, 6])
    np.testing.assert_array_equal(
        are_within(graph, [others, ends], stray), (graph.image1 == 0) & (graph.image2 == 6)
    )
    assert not are_stray(graph, [true], used).any()


def test_a_later_model_is_in_doubt_if_its_parts_conflict_even_if_most_pairs_do_not():
    first, second = np.triu_indices(8, 1)
    within = (first < 4) == (second < 4)
    image1, image2 = np.append(first[within], 0), np.append(second[within], 7)
    common, conflicting = np.full(len(image1), 100), np.zeros(len(image1), np.int64)
    found = ConflictingPoints(
        image1.astype(np.int32), image2.astype(np.int32), common, np.zeros_like(common), conflicting
    )
    assert not is_doubtful(found, 8)
    conflicting[-1] = 60
    found = replace(found, num_conflicting=conflicting)
    assert is_doubtful(found, 8) and not found.contradicts_model


def test_an_earlier_false_pair_speaks_against_a_model_that_agrees_with_it(rng):
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    used = np.ones(len(graph), bool)
    was_false, _ = rows_of(graph, [0, 1, 2], [3, 4, 5, 6])
    was_false &= ~((graph.image1 == 2) & (graph.image2 == 3))
    np.testing.assert_array_equal(
        are_torn(graph, [true], ~was_false, was_false), rows_of(graph, [0, 1, 2], [3, 4, 5, 6])[0]
    )
    turned = Rigid3(
        np.where(
            was_false[:, None, None],
            Rotation3.exp(np.array([0.0, 1.0, 0.0])).matrix @ graph.cam2_from_cam1.rotation,
            graph.cam2_from_cam1.rotation,
        ),
        graph.cam2_from_cam1.translation,
    )
    elsewhere = replace(graph, cam2_from_cam1=turned)
    assert not are_torn(elsewhere, [true], ~was_false & used, was_false).any()


def test_a_single_image_does_not_hold_two_parts_together(rng):
    true, _ = walls(rng, 1)
    graph = view_graph_of(true)
    used = np.ones(len(graph), bool)
    assert not are_hinges(graph, [true], used).any()
    over, _ = rows_of(graph, [0, 1], [3, 4, 5, 6])  # without them, image 2 alone joins the parts
    hinges = are_hinges(graph, [true], ~over)
    np.testing.assert_array_equal(hinges, rows_of(graph, [0, 1], [2])[0])
    assert not are_hinges(graph, [model_without(true, [0, 1])], ~over).any()
    alone, _ = rows_of(graph, [0], range(1, 7))  # no pair is strong enough: nothing is known about it
    assert not are_hinges(graph, [true], ~alone).any()


@pytest.mark.parametrize("num_conflicting", [0, 1, 2])
def test_few_pairs_with_conflicts_put_a_model_in_doubt_if_they_alone_hold_it_together(num_conflicting):
    """Two groups of five images, all pairs within a group, and two pairs between the groups."""
    within = [(i, j) for first in (0, 5) for i in range(first, first + 5) for j in range(i + 1, first + 5)]
    image1, image2 = np.array([*within, (0, 5), (1, 6)], np.int32).T
    conflicting = np.zeros(len(image1), np.int64)
    conflicting[len(within) : len(within) + num_conflicting] = 60
    conflicts = ConflictingPoints(image1, image2, 100 - conflicting, np.zeros_like(conflicting), conflicting)
    model = SimpleNamespace(is_registered=lambda: np.ones(10, bool))
    graph = SimpleNamespace(image1=image1, image2=image2)
    assert not conflicts.contradicts_model
    assert is_connected_by_conflicts(graph, model, conflicts) == (num_conflicting == 2)
