"""Images without EXIF share a focal length unless they contradict it; and what a model's images say of its focal lengths."""

import numpy as np
import pytest
from test_sfm_focal import GUESS, all_pairs, camera, motions, view_graph

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.mapping.focal_accuracy import FocalAccuracy, _even_images, focal_accuracies
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.focal import estimate_focals
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.pipeline import _without_contradictions
from epipole.pipelines.sfm.shared_focals import contradicted_cameras, with_own_cameras
from epipole.scene import (
    Cameras,
    Frames,
    Images,
    Points,
    Reconstruction,
    Rigs,
    Tracks,
)
from whole import IS_WHOLE

ONE = Cameras.from_list([camera()], is_focal_trusted=[False])


def fundamental(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """By eight points, of noisy pixels (n, 2)."""
    parts = []
    for pixels in (a, b):
        middle, scale = pixels.mean(axis=0), np.sqrt(2) / pixels.std()
        parts.append(np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]]))
    p, q = (np.column_stack([x, np.ones(len(x))]) @ T.T for x, T in zip((a, b), parts))
    found = np.linalg.svd((q[:, :, None] * p[:, None]).reshape(len(p), 9))[2][-1].reshape(3, 3)
    left, values, right = np.linalg.svd(found)
    return parts[1].T @ (left[:, :2] * values[:2]) @ right[:2] @ parts[0]


def noisy_graph(rng, focals, noise_px=1.0):
    """Pairs of images of a cloud of points, whose geometry comes from pixels with noise."""
    positions = motions(rng, len(focals))
    points = rng.normal(0, 1, (300, 3)) * [1.5, 1, 1] + [0, 0, 5]
    pixels = []
    for position, focal in zip(positions, focals):
        inside = position.apply(points)
        own = focal * inside[:, :2] / inside[:, 2:] + [399.5, 299.5]
        seen = (inside[:, 2] > 0.5) & (own > 0).all(axis=1) & (own < [800, 600]).all(axis=1)
        pixels.append(np.where(seen[:, None], own + rng.normal(0, noise_px, own.shape), np.nan))
    found, pairs, counts = [], [], []
    for i, j in all_pairs(len(focals)):
        both = np.isfinite(pixels[i] + pixels[j]).all(axis=1)
        if both.sum() >= 60:
            found.append(fundamental(pixels[i][both], pixels[j][both]))
            pairs.append((i, j))
            counts.append(int(both.sum()))
    graph = view_graph(positions, focals, pairs, counts)
    graph.fundamental[:] = found
    return graph


@pytest.mark.parametrize("seed", range(4 if IS_WHOLE else 1))
@pytest.mark.parametrize("num_images", [3, 6, 9])
def test_images_of_one_camera_share_it(seed, num_images, unchecked):
    graph = noisy_graph(np.random.default_rng(seed), np.full(num_images, 0.8 * GUESS))
    assert contradicted_cameras(ONE, np.zeros(num_images, np.int32), graph) == []


@pytest.mark.parametrize("seed", range(3 if IS_WHOLE else 1))
@pytest.mark.parametrize("spread", [0.15, 0.4, 0.8])
def test_images_of_many_cameras_do_not(seed, spread, unchecked):
    rng = np.random.default_rng(seed)
    graph = noisy_graph(rng, 0.8 * GUESS * np.exp(spread * rng.normal(size=7)))
    assert contradicted_cameras(ONE, np.zeros(7, np.int32), graph) == [0]


@pytest.mark.parametrize("seed", range(3 if IS_WHOLE else 1))
def test_cameras_of_their_own_get_their_own_focal_lengths(seed, unchecked):
    rng = np.random.default_rng(seed)
    focals = 0.8 * GUESS * np.exp(0.3 * rng.normal(size=7))
    graph = noisy_graph(rng, focals)
    cameras, rows = with_own_cameras(ONE, np.zeros(7, np.int32), [0])
    assert sorted(rows.tolist()) == list(range(7)) and rows[0] == 0
    found, _ = estimate_focals(cameras, rows, graph)
    assert np.median(np.abs(np.log(found.params[rows, 0] / focals))) < 0.1


def test_known_and_other_cameras_stay(rng):
    graph = noisy_graph(rng, np.full(4, GUESS) * [0.5, 1, 1.5, 2])
    trusted = Cameras.from_list([camera()], is_focal_trusted=[True])
    assert contradicted_cameras(trusted, np.zeros(4, np.int32), graph) == []
    two = Cameras.from_list([camera(), camera(1.5 * GUESS)])
    cameras, rows = with_own_cameras(two, np.array([1, 0, 1, 1], np.int32), [1])
    assert rows.tolist() == [1, 0, 2, 3]
    np.testing.assert_array_equal(cameras.params[:, 0], GUESS * np.array([1, 1.5, 1.5, 1.5]))


def images_of(tmp_path, num_images, *, is_video=False):
    nothing = np.full((num_images, 3), np.nan)
    names = tuple(f"{n}.jpg" for n in range(num_images))
    rows, empty = np.zeros(num_images, np.int32), ("",) * num_images
    return ImageSet(
        *(
            tmp_path,
            names,
            ONE,
            rows,
            ("assumed",),
            nothing,
            nothing,
            nothing[:, 0],
            empty,
            empty,
            {},
            is_video,
        )
    )


def test_what_is_contradicted_is_said(tmp_path, rng):
    graph = noisy_graph(rng, GUESS * np.array([0.5, 0.8, 1.2, 1.6, 2.0]))
    found = _without_contradictions(images_of(tmp_path, 5), graph, ReconstructConfig())
    assert len(found.cameras) == 5 == len(found.focal_sources)
    assert found.notes == (
        "5 images of 800x600 without a known focal length contradict a shared one: each gets its own camera",
    )
    for images, config in (
        (images_of(tmp_path, 5), ReconstructConfig(single_camera=True)),
        (images_of(tmp_path, 5, is_video=True), ReconstructConfig()),
    ):
        found = _without_contradictions(images, graph, config)
        assert len(found.cameras) == 1 and "contradict one shared focal length" in found.notes[0]


def ring_model(rng, camera, *, given_px=None, rotation=1.0, num_images=8, noise_px=0.3):
    """Images around a cloud of points, adjusted to noise; the model's focal length may be another than theirs."""
    points = rng.normal(0, 1, (250, 3))
    rotations, translations, keypoints = [], [], []
    for angle in np.linspace(-rotation, rotation, num_images):
        position = Rigid3(np.eye(3), np.array([0, 0, 6.0])) @ Rigid3.exp([0, 0, 0, 0.3 * angle**2, angle, 0])
        rotations.append(position.rotation)
        translations.append(position.translation)
        keypoints.append(camera.project(position.apply(points)) + rng.normal(0, noise_px, (len(points), 2)))
    n, p = num_images, len(points)
    own = camera if given_px is None else Camera("PINHOLE", 800, 600, [given_px, given_px, 399.5, 299.5])
    return Reconstruction(
        Cameras.from_list([own], is_constant=[given_px is not None]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(n, np.int32), Rigid3(np.array(rotations), np.array(translations)), np.full(n, np.nan)
        ),
        Images(
            tuple(f"{k}.jpg" for k in range(n)),
            np.arange(n, dtype=np.int32),
            np.zeros(n, np.int32),
            np.arange(n + 1, dtype=np.int64) * p,
            np.concatenate(keypoints),
        ),
        Points(points, np.zeros((p, 3), np.uint8), np.zeros(p)),
        Tracks(
            np.arange(p + 1, dtype=np.int64) * n,
            np.tile(np.arange(n, dtype=np.int32), p),
            np.repeat(np.arange(p, dtype=np.int32), n),
        ),
    )


PINHOLE = Camera("PINHOLE", 800, 600, [900.0, 900.0, 399.5, 299.5])


@pytest.mark.parametrize("factor", [0.9, 1.3] + IS_WHOLE * [0.7, 1.1])
def test_a_wrong_known_focal_length_is_contradicted(rng, factor):
    (found,) = focal_accuracies(ring_model(rng, PINHOLE, given_px=900.0 * factor)).values()
    assert found.contradicts_model and found.is_determined
    assert found.model_px == pytest.approx(900.0 * factor)
    assert abs(found.focal_px - 900.0) < 3 * max(found.sigma_px, 3.0)


@pytest.mark.parametrize("seed", range(3 if IS_WHOLE else 1))
def test_a_right_one_is_not(seed):
    rng = np.random.default_rng(seed)
    off_middle = Camera("SIMPLE_RADIAL", 800, 600, [900.0, 405.0, 290.0, -0.02])
    for own, given_px in ((PINHOLE, 900.0), (off_middle, None)):
        (found,) = focal_accuracies(ring_model(rng, own, given_px=given_px)).values()
        assert found.is_determined and not found.contradicts_model


def test_a_camera_that_hardly_turns_determines_nothing(rng):
    (found,) = focal_accuracies(
        ring_model(rng, PINHOLE, given_px=900.0, rotation=0.02, noise_px=1.0)
    ).values()
    assert not found.is_determined and not found.contradicts_model


def test_few_observations_give_no_answer(rng):
    model = ring_model(rng, PINHOLE, num_images=2)
    assert (
        focal_accuracies(
            Reconstruction(
                *(model.cameras, model.rigs, model.frames, model.images),
                Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0)),
                Tracks(np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32)),
            )
        )
        == {}
    )


def test_of_many_images_an_even_part_of_each_camera_is_looked_at():
    camera_of_image = np.repeat(np.arange(2), [160, 40])
    kept = _even_images(camera_of_image, np.arange(200))
    assert len(kept) == len(set(kept.tolist())) == 100
    assert (kept >= 160).sum() == 40
    gaps = np.diff(np.sort(kept[kept < 160]))
    assert gaps.max() <= 6


def test_the_verdict_goes_by_the_deviation():
    assert FocalAccuracy(1000, 1001, 15).is_determined
    assert not FocalAccuracy(1000, 1001, 25).is_determined
    assert not FocalAccuracy(1000, 1001, float("inf")).contradicts_model
    assert FocalAccuracy(1000, 1030, 5).contradicts_model
    assert not FocalAccuracy(1000, 1010, 1).contradicts_model  # other errors are not so small
