"""Points that are missing where geometry says that there must be some: none in a right model, many in a folded one."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.mapping import find_missing_points
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

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


def test_a_right_model_lacks_nothing(rng):
    """Half of the points in view are observed, at random."""
    found = find_missing_points(row_of_cameras(rng, 10, lambda _, p: rng.random(len(p)) < 0.5))
    assert len(found) == 90 and found.absent_fraction.max() < 0.1 and not found.contradicts_model
    assert "90 pairs" in repr(found)


def test_images_of_different_things_in_one_place_lack_what_surrounds_them(rng):
    """Even and odd images show different things: only the upper half of the wall looks alike."""

    def sees(image, points):
        below = points[:, 1] > 0.0
        of_even = np.arange(len(points)) % 2 == 0
        return ~below | (of_even == (image % 2 == 0))

    found = find_missing_points(row_of_cameras(rng, 10, sees))
    differ = found.image1 % 2 != found.image2 % 2
    np.testing.assert_array_equal(found.is_contradiction, differ)
    assert found.contradicts_model


def test_what_one_thing_hides_is_no_contradiction_of_the_model(rng):
    """Something before one camera hides a corner of its view from it."""
    found = find_missing_points(
        row_of_cameras(rng, 10, lambda i, p: (i != 4) | (p[:, 0] < 0.8) | (p[:, 1] < 0))
    )
    assert found.absent_fraction.max() > 0.05 and not found.contradicts_model


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
    assert len(find_missing_points(few)) == (2 if num_images == 2 else 0)
