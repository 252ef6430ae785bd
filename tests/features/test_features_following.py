"""Points followed from image to image, and patches placed to a fraction of a pixel."""

import cv2
import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.features import (
    FlowConfig,
    _patch_kernels,
    align_patches,
    align_patches_of_images,
    find_along_rows,
    find_patches,
    patches,
    track_points,
)
from kernel_references import assert_same_as_python, record_calls, reference_of


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """Smooth noise: gradients everywhere, the same look nowhere twice."""
    noise = np.random.default_rng(3).normal(size=(240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def pixels(rng) -> np.ndarray:
    return rng.uniform([60, 60], [260, 180], (80, 2))


def warped(image: np.ndarray, affine: np.ndarray) -> np.ndarray:
    return cv2.warpAffine(
        image, affine, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def test_a_shift_is_followed(image, pixels):
    shift = np.array([7.3, -4.6])
    moved = warped(image, np.hstack([np.eye(2), shift[:, None]]))
    there, found = track_points(image, moved, pixels)
    assert found.mean() > 0.95
    assert np.linalg.norm(there[found] - pixels[found] - shift, axis=1).max() < 0.15
    guess = np.full_like(pixels, np.nan)
    again, _ = track_points(image, moved, pixels, guess)
    np.testing.assert_allclose(again[found], there[found], atol=0.05)


def test_what_is_not_there_is_not_found(image, pixels, rng):
    other = rng.permuted(image, axis=0)
    _, found = track_points(image, other, pixels)
    assert found.mean() < 0.2
    _, found = track_points(np.full_like(image, 90), np.full_like(image, 90), pixels)
    assert not found.any()
    there, found = track_points(image, image, np.zeros((0, 2)))
    assert there.shape == (0, 2) and found.shape == (0,)
    with pytest.raises(ShapeError, match="too small"):
        track_points(image[:15, :15], image[:15, :15], pixels)
    with pytest.raises(ConfigError, match="odd"):
        FlowConfig(window_px=20)


@pytest.mark.parametrize(
    ("rotation_deg", "scale", "gain"), [(0.0, 1.0, 1.0), (20.0, 1.0, 0.7), (-8.0, 1.3, 1.2)]
)
def test_a_foretold_warp_is_placed_exactly(image, pixels, rng, rotation_deg, scale, gain):
    affine = cv2.getRotationMatrix2D((160, 120), rotation_deg, scale)
    moved = np.clip(warped(image, affine) * gain + 5, 0, 255).astype(np.uint8)
    truth = pixels @ affine[:, :2].T + affine[:, 2]
    warps = np.tile(affine[:, :2], (len(pixels), 1, 1))
    found, score = align_patches(image, moved, pixels, warps, truth + rng.uniform(-1.5, 1.5, truth.shape))
    inside = (truth > 12).all(axis=1) & (truth < [308, 228]).all(axis=1)
    good = inside & (score > 0.9)
    assert good.sum() > 0.9 * inside.sum()
    assert np.median(np.linalg.norm(found - truth, axis=1)[good]) < 0.06
    if rotation_deg:
        _, plain = align_patches(image, moved, pixels, np.tile(np.eye(2), (len(pixels), 1, 1)), truth)
        assert np.nanmedian(plain) < np.nanmedian(score) - 0.03


def test_a_bent_patch_is_found_at_its_center(rng):
    """Two views of a far scene 60 degrees apart: the warp of first order alone finds patches to one side."""
    size, focal = (320, 240), 200.0
    center = np.array([159.5, 119.5])
    rotation = cv2.Rodrigues(np.array([0.0, np.radians(60.0), 0.0]))[0]
    texture = cv2.GaussianBlur(rng.normal(size=(900, 2400)).astype(np.float32), None, 2.0)
    texture = np.clip(128 + 250 * texture, 0, 255).astype(np.uint8)

    def view(turn):
        """A panorama on a cylinder, seen by a camera that is turned."""
        u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = (
            np.stack([(u - center[0]) / focal, (v - center[1]) / focal, np.ones(u.shape)], axis=-1) @ turn.T
        )
        at = (
            800 * np.arctan2(rays[..., 0], rays[..., 2]) + 1200,
            800 * rays[..., 1] / np.hypot(rays[..., 0], rays[..., 2]) + 450,
        )
        return cv2.remap(texture, *(x.astype(np.float32) for x in at), cv2.INTER_CUBIC)

    def moved(pixels):
        rays = np.column_stack([(pixels - center) / focal, np.ones(len(pixels))]) @ rotation.T
        return focal * rays[:, :2] / rays[:, 2:] + center

    first, second = view(np.eye(3)), view(rotation.T)
    pixels = np.column_stack([rng.uniform(30, 80, 200), rng.uniform(40, 200, 200)])
    h, x, y = 1e-2, np.array([1e-2, 0.0]), np.array([0.0, 1e-2])
    linear = np.stack([moved(pixels + d) - moved(pixels - d) for d in (x, y)], axis=2) / (2 * h)
    mixed = moved(pixels + x + y) - moved(pixels + x - y) - moved(pixels - x + y) + moved(pixels - x - y)
    straight = [moved(pixels + d) + moved(pixels - d) - 2 * moved(pixels) for d in (x, y)]
    second_order = np.stack([straight[0], mixed / 4, straight[1]], axis=2) / h**2
    off = {}
    for order, warps in ((1, linear), (2, np.concatenate([linear, second_order], axis=2))):
        found, score = align_patches(first, second, pixels, warps, moved(pixels))
        good = score > 0.9
        assert good.mean() > 0.6
        off[order] = np.median((found - moved(pixels))[good, 0])
    assert abs(off[1]) > 0.03 and abs(off[2]) < 0.1 * abs(off[1])
    with pytest.raises(ShapeError, match=r"\(n, 2, 2\) or \(n, 2, 5\)"):
        align_patches(first, second, pixels, linear[..., :1], pixels)


def test_patches_that_say_nothing_have_no_score(image):
    pixels = np.array([[2.0, 2.0], [160.0, 120.0], [np.nan, 3.0], [160.0, 120.0]])
    warps = np.tile(np.eye(2), (4, 1, 1))
    warps[3] = 0.0
    _, score = align_patches(image, image, pixels, warps, pixels)
    assert np.isnan(score[[0, 2, 3]]).all() and score[1] > 0.999
    _, score = align_patches(np.full_like(image, 9), image, pixels, warps, pixels)
    assert np.isnan(score).all()
    with pytest.raises(ShapeError, match="warps must be"):
        align_patches(image, image, pixels, warps[:2], pixels)
    with pytest.raises(ConfigError, match="half_px"):
        align_patches(image, image, pixels, warps, pixels, 1)


def test_patches_of_several_images_are_located_as_one_by_one(image, pixels, rng):
    images = [image, image[::-1].copy(), np.full_like(image, 9)]
    of, warps = rng.integers(0, 3, len(pixels)), np.tile(np.eye(2), (len(pixels), 1, 1))
    guess = pixels + rng.uniform(-1, 1, pixels.shape)
    found, score = align_patches_of_images(images, of, image, pixels, warps, guess)
    for k, single in enumerate(images):
        own = of == k
        there, its = align_patches(single, image, pixels[own], warps[own], guess[own])
        np.testing.assert_array_equal(found[own], there)
        np.testing.assert_array_equal(score[own], its)
    none = align_patches_of_images([], np.zeros(0, np.int64), image, np.zeros((0, 2)), warps[:0], guess[:0])
    assert [len(part) for part in none] == [0, 0]
    with pytest.raises(ShapeError, match="for 2 images"):
        align_patches_of_images(images[:2], of, image, pixels, warps, guess)


@pytest.mark.parametrize("gain", [0.3, 0.6, 1.3, 2.2])
def test_points_are_followed_into_a_picture_of_another_exposure(image, pixels, gain):
    """As well as into one of the same: with the brightness as it is most points were lost."""
    middle = np.rint(40 + 0.3 * image).astype(np.uint8)  # nothing is over-exposed in either
    motion = np.float64([[1, 0, 3.3], [0, 1, -1.7]])
    other = np.rint(gain * warped(middle, motion)).clip(0, 255).astype(np.uint8)
    found, mask = track_points(middle, other, pixels)
    assert mask.mean() > 0.9
    assert np.linalg.norm(found[mask] - pixels[mask] - [3.3, -1.7], axis=1).max() < 0.3
    back, mask = track_points(other, middle, pixels + np.array([3.3, -1.7]))
    assert mask.mean() > 0.9 and np.linalg.norm(back[mask] - pixels[mask], axis=1).max() < 0.3


def test_odd_places_do_not_trouble_the_brightness(image):
    odd = np.array([[60.0, 60.0], [-30.0, 5.0], [1e12, 1e12], [np.nan, 50.0]])
    _, mask = track_points(image, image, odd)
    assert mask[0] and not mask[1:].any()


@reference_of(_patch_kernels.align_patches)
def test_the_kernel_is_its_source(image, monkeypatch):
    calls = record_calls(monkeypatch, patches, _patch_kernels.align_patches)
    pixels = np.array([[50.3, 60.7], [3.0, 3.0], [200.0, 100.0]])
    warps = np.tile(np.array([[1.02, 0.05], [-0.04, 0.97]]), (3, 1, 1))
    align_patches(
        image, warped(image, np.float64([[1, 0, 0.6], [0, 1, -0.3]])), pixels, warps, pixels + 0.4, 3
    )
    for arguments in calls:
        assert_same_as_python(_patch_kernels.align_patches, *arguments, rtol=1e-9, atol=1e-9)


def test_halved_pictures_find_patches_from_further_away(image, pixels, rng):
    affine = cv2.getRotationMatrix2D((160, 120), 10.0, 1.1)
    moved = warped(image, affine)
    truth = pixels @ affine[:, :2].T + affine[:, 2]
    inside = (truth > 30).all(axis=1) & (truth < [290, 210]).all(axis=1)
    trajectory = rng.normal(size=truth.shape)
    guess = truth + 9.0 * trajectory / np.linalg.norm(trajectory, axis=1, keepdims=True)
    warps = np.tile(affine[:, :2], (len(pixels), 1, 1))
    hits = []
    for levels in (1, 3):
        found, score = find_patches(image, moved, pixels, warps, guess, levels)
        hits.append(((score > 0.9) & (np.linalg.norm(found - truth, axis=1) < 0.3))[inside].mean())
    assert hits[1] > 0.85 > 0.5 > hits[0], hits
    with pytest.raises(ConfigError, match="levels"):
        find_patches(image, moved, pixels, warps, guess, 0)


def test_shifts_along_rows_are_found_and_what_repeats_has_a_rival(image, pixels, rng):
    shift = 17
    right = np.roll(image, -shift, axis=1)
    found, score, rival = find_along_rows(image, right, pixels, 40)
    whole, more = (find_along_rows(image, right, pixels, shift) for shift in (image.shape[1], 2**62))
    np.testing.assert_array_equal(whole, more)  # beyond the image there is nothing to find
    inside = (pixels > [shift + 6, 6]).all(axis=1) & (pixels < [314, 234]).all(axis=1)
    assert inside.sum() > 20
    assert (found[inside] == shift).all() and (score[inside] > 0.999).all()
    assert (score - rival)[inside].min() > 0
    tile = np.tile(rng.integers(0, 255, (240, 20), np.uint8), (1, 16))
    _, score, rival = find_along_rows(tile, tile, np.array([[150.0, 100.0]]), 40)
    assert score[0] > 0.999 and rival[0] > 0.999
    _, score, _ = find_along_rows(
        np.full_like(image, 7), image, np.array([[100.0, 100.0], [np.nan, 1.0]]), 40
    )
    assert np.isnan(score).all()
    with pytest.raises(ConfigError, match="max_shift"):
        find_along_rows(image, right, pixels, -1)


@reference_of(_patch_kernels.find_along_rows)
def test_the_kernel_along_rows_is_its_source(image, monkeypatch):
    calls = record_calls(monkeypatch, patches, _patch_kernels.find_along_rows)
    find_along_rows(image, np.roll(image, -3, axis=1), np.array([[50.3, 60.7], [3.0, 3.0]]), 9, 3)
    assert calls
    for arguments in calls:
        assert_same_as_python(_patch_kernels.find_along_rows, *arguments, rtol=1e-12, atol=1e-12)
