"""Neighboring points that exclude each other: none in a right model, many in one that shows different things as one."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.mapping import ConflictingPoints, cluster_images, conflicting_points, find_conflicting_points
from epipole.mapping import _conflict_kernels as kernels
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks
from kernel_references import assert_same_as_python, record_calls, reference_of

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))


def row_of_cameras(rng, num_images, sees, num_points=1500):
    """Cameras side by side before a wall of points; `sees` (image, point) -> whether it is observed if it is in view."""
    points = rng.uniform([-2, -2, 5], [2 + 0.1 * num_images, 2, 6], (num_points, 3))
    centers = np.stack([0.1 * np.arange(num_images), np.zeros(num_images), np.zeros(num_images)], axis=1)
    poses = Rigid3(np.tile(np.eye(3), (num_images, 1, 1)), -centers)
    point, image, pixels = [], [], []
    for i in range(num_images):
        at = CAMERA.project(poses[i].apply(points))
        inside = ((at > 0) & (at < [639, 479])).all(axis=1) & sees(i, points)
        point.append(np.flatnonzero(inside))
        image.append(np.full(inside.sum(), i))
        pixels.append(at[inside])
    counts = [len(p) for p in point]
    keypoint = np.concatenate([np.arange(c) for c in counts])
    flat, owner = np.concatenate(point), np.concatenate(image)
    order = np.lexsort((owner, flat))
    lengths = np.bincount(flat, minlength=num_points)
    rows = np.arange(num_images, dtype=np.int32)
    return Reconstruction(
        Cameras.from_list([CAMERA]),
        Rigs.of_single_cameras(1),
        Frames(np.zeros(num_images, np.int32), poses, np.full(num_images, np.nan)),
        Images(
            tuple(f"{i}.jpg" for i in range(num_images)),
            rows,
            np.zeros(num_images, np.int32),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            np.concatenate(pixels),
        ),
        Points(points, np.zeros((num_points, 3), np.uint8), np.zeros(num_points)),
        Tracks(
            np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            owner[order].astype(np.int32),
            keypoint[order].astype(np.int32),
        ),
    )


def test_points_of_a_right_model_do_not_conflict(rng):
    """Half of the points in view are observed, at random."""
    found = find_conflicting_points(row_of_cameras(rng, 10, lambda _, p: rng.random(len(p)) < 0.5))
    assert len(found) == 45 and found.is_judged.all() and found.fraction.max() < 0.01
    assert (found.evidence > 0.0).all() and not found.contradicts_model
    assert "45 pairs" in repr(found)


def test_images_of_different_things_in_one_place_conflict(rng):
    """Even and odd images show different things: only the upper half of the wall looks alike."""

    def sees(image, points):
        below = points[:, 1] > 0.0
        of_even = np.arange(len(points)) % 2 == 0
        return (~below | (of_even == (image % 2 == 0))) & (rng.random(len(points)) < 0.7)

    found = find_conflicting_points(row_of_cameras(rng, 10, sees))
    differ = found.image1 % 2 != found.image2 % 2
    np.testing.assert_array_equal(found.is_contradiction, differ)
    np.testing.assert_array_equal(found.evidence < 0.0, differ)
    assert found.contradicts_model
    clusters = cluster_images(10, found.image1, found.image2, found.evidence)
    np.testing.assert_array_equal(clusters, np.arange(10) % 2)


def counted(num_same, num_different, fraction_of_same, fraction_of_different):
    """Pairs of 1,000 views with these fractions of conflicts, give or take a third."""
    spread = [np.linspace(0.67, 1.33, n) for n in (num_same, num_different)]
    conflicting = np.concatenate([fraction_of_same * spread[0], fraction_of_different * spread[1]])
    conflicting = np.rint(1000 * conflicting).astype(np.int64)
    image = np.zeros(len(conflicting), np.int32)
    return ConflictingPoints(image, image + 1, 1000 - conflicting, np.zeros_like(conflicting), conflicting)


@pytest.mark.parametrize("of_same", [0.0, 0.005, 0.05, 0.12])
def test_the_typical_fraction_of_conflicts_is_that_of_the_model(of_same):
    """Blurred frames have more conflicts, of which a tenth of the pairs shows the least; different things still have more."""
    right, wrong = counted(200, 0, of_same, 0.0), counted(120, 80, of_same, 0.4)
    same, different = right.typical_fractions
    assert same >= 0.7 * min(of_same, 0.06) and different >= 3 * same
    assert not right.contradicts_model
    assert (
        wrong.contradicts_model and wrong.is_contradiction[120:].all() and (wrong.evidence[120:] < 0.0).all()
    )


def test_a_model_of_many_like_things_is_in_doubt_although_few_of_its_pairs_show_the_same_thing():
    assert counted(0, 200, 0.0, 0.5).contradicts_model


def test_what_one_thing_hides_is_no_contradiction_of_the_model(rng):
    """Something before one camera hides a corner of its view from it."""
    found = find_conflicting_points(
        row_of_cameras(rng, 10, lambda i, p: (i != 4) | (p[:, 0] < 0.8) | (p[:, 1] < 0))
    )
    assert not found.is_contradiction.any() and not found.contradicts_model


def test_points_seen_from_different_directions_are_not_compared(rng):
    """Cameras far apart see different sides of things."""
    model = row_of_cameras(rng, 2, lambda i, p: np.arange(len(p)) % 2 == i)
    found = find_conflicting_points(model)
    assert len(found) == 1 and found.fraction[0] == 1.0
    position = model.frames.rig_from_world
    apart = Rigid3(position.rotation, position.translation * [[1.0], [40.0]])  # 4 m, 36 degrees
    moved = replace(model, frames=replace(model.frames, rig_from_world=apart))
    assert len(find_conflicting_points(moved)) == 0


@pytest.mark.parametrize("num_images", [0, 1, 2])
def test_few_images_have_few_pairs(rng, num_images):
    model = row_of_cameras(rng, 2, lambda _, p: np.ones(len(p), bool))
    unknown = np.where(np.arange(2)[:, None] < num_images, 0.0, np.nan)
    position = model.frames.rig_from_world
    registered = Rigid3(position.rotation + unknown[:, :, None], position.translation + unknown)
    seen = model.tracks.image < num_images
    counts = np.bincount(model.tracks.point_of_observation()[seen], minlength=len(model.points))
    tracks = Tracks(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        model.tracks.image[seen],
        model.tracks.keypoint[seen],
    )
    few = replace(model, frames=replace(model.frames, rig_from_world=registered), tracks=tracks)
    assert len(find_conflicting_points(few)) == (1 if num_images == 2 else 0)


@reference_of(kernels.count_views)
def test_the_kernel_agrees_with_python_and_with_sets(rng, monkeypatch):
    model = row_of_cameras(rng, 5, lambda i, p: rng.random(len(p)) < 0.3, num_points=60)
    calls = record_calls(monkeypatch, conflicting_points, kernels.count_views)
    found = find_conflicting_points(model)
    for arguments in calls:
        assert_same_as_python(kernels.count_views, *arguments)
    seen = [set(model.tracks.image[model.tracks.point_of_observation() == p]) for p in range(60)]
    neighbors = conflicting_points._neighbors_of(model)
    centers = model.camera_centers_in_world()
    counts = dict.fromkeys(zip(found.image1.tolist(), found.image2.tolist()), np.zeros(3, int))
    for p in range(60):
        around = [seen[q] for q in neighbors[p] if q >= 0]
        for i in seen[p]:
            for j in set().union(*around, seen[p]) - {i}:
                a, b = (model.points.xyz_in_world[p] - centers[k] for k in (i, j))
                sizes = np.linalg.norm([a, b], axis=1)
                if a @ b <= np.cos(np.deg2rad(20)) * sizes.prod() or sizes.max() >= 1.5 * sizes.min():
                    continue
                is_disjoint = all(not (s & seen[p]) for s in around if j in s)
                kind = 0 if j in seen[p] else 2 if is_disjoint else 1
                counts[min(i, j), max(i, j)] = counts[min(i, j), max(i, j)] + np.eye(3, dtype=int)[kind]
    expected = np.array([counts[pair] for pair in zip(found.image1.tolist(), found.image2.tolist())])
    np.testing.assert_array_equal(
        np.stack([found.num_common, found.num_missed, found.num_conflicting], 1), expected
    )


def test_images_that_were_not_matched_are_not_judged(rng):
    """Two halves of the points, each seen by other images: a conflict, unless these images were never compared."""

    def sees(camera, points):
        return (np.arange(len(points)) % 2 == camera % 2) & (rng.random(len(points)) < 0.9)

    model = row_of_cameras(rng, 10, sees)
    everything = find_conflicting_points(model)
    assert everything.contradicts_model
    within = np.array([(i, j) for i in range(10) for j in range(i + 2, 10, 2)][::-1], np.int32)[:, ::-1]
    found = find_conflicting_points(model, np.ascontiguousarray(within))
    assert not found.contradicts_model and not found.is_contradiction.any() and len(found) > 0
    kept = (everything.image1 + everything.image2) % 2 == 0
    for name in ("image1", "image2", "num_common", "num_missed", "num_conflicting"):
        np.testing.assert_array_equal(getattr(found, name), getattr(everything, name)[kept])
    assert len(find_conflicting_points(model, np.zeros((0, 2), np.int32))) == 0
