"""Things that look alike: models that show them as one are found and separated, and right models stay as they are."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_rings import EXACT, shared_keypoints, view_graph_of

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import connect_matches, find_conflicting_points
from epipole.mapping.model_builder import ModelBuilder
from epipole.pipelines.sfm import look_alikes
from epipole.pipelines.sfm.incremental import IncrementalMapper
from epipole.pipelines.sfm.look_alikes import Attempt, map_apart, map_once
from epipole.pipelines.sfm.mappers import map_with
from epipole.pipelines.sfm.mapping_stage import Mapped
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

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
    assert len(calls) == 1 and len(found.contradicting) == 0 and not found.is_split
    assert not find_conflicting_points(true).is_contradiction.any()


def test_of_two_pairs_that_a_third_contradicts_both_are_ambiguous():
    image1, image2 = np.array([0, 1, 0, 2], np.int32), np.array([1, 2, 2, 3], np.int32)
    found = look_alikes._is_ambiguous(4, image1, image2, np.array([5.0, 5.0, -50.0, 9.0]))
    np.testing.assert_array_equal(found, [True, True, False, False])
    weak = look_alikes._is_ambiguous(4, image1, image2, np.array([5.0, 5.0, -5.0, 9.0]))
    assert not weak.any()


def test_shared_numbers_are_what_looks_alike(rng):
    true, folded = walls(rng, 2)
    assert (
        len(shared_keypoints(true, 0, IMAGES_PER_WALL))
        == 0
        < len(shared_keypoints(folded, 0, IMAGES_PER_WALL))
    )
