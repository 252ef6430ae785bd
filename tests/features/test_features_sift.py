"""Our SIFT against its definition, against OpenCV's, and against a turned image."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial import cKDTree

from epipole.config import FeatureConfig
from epipole.features import _scale_space_kernels as space
from epipole.features import _sift_kernels as kernels
from epipole.features import sift
from epipole.features.features import Features
from epipole.features.match import match_descriptors


@pytest.fixture(scope="module")
def image():
    """A texture rich at all scales."""
    rng = np.random.default_rng(3)
    layers = [
        zoom(rng.normal(size=(n * 3 // 4, n)), 320 / n, order=1) / np.sqrt(n)
        for n in (8, 16, 32, 80, 160, 320)
    ]
    total = sum(layer[:240, :320] for layer in layers)
    total = (total - total.min()) / np.ptp(total)
    return np.rint(255 * total).astype(np.uint8)


def position(features: Features) -> np.ndarray:
    """Position, log of the scale and direction in one space, so that equal features are near each other."""
    rotation = 4.0 * np.stack([np.cos(features.angle_rad), np.sin(features.angle_rad)], axis=1)
    return np.column_stack([features.pixels, 8.0 * np.log2(features.scale_px), rotation])


def opencv_sift(gray: np.ndarray, config: FeatureConfig) -> Features:
    detector = cv2.SIFT_create(0, contrastThreshold=config.contrast_threshold, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    columns = np.array([(*k.pt, k.size, np.deg2rad(k.angle)) for k in keypoints], np.float32)
    return Features(columns[:, :2], columns[:, 2], columns[:, 3], sift.root_sift(descriptors))


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a.astype(float), b.astype(float)
    return (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


def test_finds_what_opencv_finds(image):
    config = FeatureConfig()
    ours, theirs = sift.detect_sift(image, config), opencv_sift(image, config)
    assert len(theirs) > 400
    assert abs(len(ours) - len(theirs)) < 0.01 * len(theirs)
    distance, nearest = cKDTree(position(theirs)).query(position(ours))
    same = distance < 0.5
    assert same.mean() > 0.98
    assert np.abs(ours.pixels - theirs.pixels[nearest])[same].mean() < 2e-3
    agreement = cosine(ours.descriptors, theirs.descriptors[nearest])[same]
    assert np.median(agreement) > 0.99
    assert np.percentile(agreement, 5) > 0.95  # OpenCV samples whole pixels around a rounded center


def test_a_turned_picture_has_the_turned_features(image):
    config = FeatureConfig()
    upright, rotated = sift.detect_sift(image, config), sift.detect_sift(np.rot90(image).copy(), config)
    # rot90 takes (x, y) to (y, width - 1 - x), and directions by -90 degrees.
    back = Features(
        np.stack([image.shape[1] - 1 - rotated.pixels[:, 1], rotated.pixels[:, 0]], axis=1),
        rotated.scale_px,
        rotated.angle_rad + np.float32(np.pi / 2),
        rotated.descriptors,
    )
    distance, nearest = cKDTree(position(upright)).query(position(back))
    same = distance < 1.0
    assert same.mean() > 0.85  # the doubled grid is not symmetric, so that weak features come and go
    assert np.median(cosine(back.descriptors, upright.descriptors[nearest])[same]) > 0.99


def test_largest_features_are_kept(image):
    everything = sift.detect_sift(image, FeatureConfig(max_features=100_000))
    most = image.size // sift.PIXELS_PER_FEATURE + 1
    few = sift.detect_sift(image, FeatureConfig(max_features=most))
    assert len(few) == most
    np.testing.assert_array_equal(few.scale_px, everything.scale_px[:most])
    assert (np.diff(everything.scale_px) <= 0).all()


def test_without_the_doubled_octave_the_largest_features_are_the_same(image, monkeypatch):
    config = FeatureConfig(max_features=100)
    assert image.size > sift.PIXELS_PER_FEATURE * config.max_features
    calls = []
    monkeypatch.setattr(sift, "_doubled_base", calls.append)
    fast = sift.detect_sift(image, config)
    monkeypatch.undo()
    assert not calls
    monkeypatch.setattr(sift, "PIXELS_PER_FEATURE", np.inf)
    slow = sift.detect_sift(image, config)
    distance, nearest = cKDTree(position(slow)).query(position(fast))
    same = distance < 0.5
    assert same.mean() > 0.9
    assert np.abs(fast.pixels - slow.pixels[nearest])[same].max() < 0.2
    assert np.median(cosine(fast.descriptors, slow.descriptors[nearest])[same]) > 0.995


def test_a_large_image_with_little_texture_gets_the_doubled_octave(image, monkeypatch):
    config = FeatureConfig(max_features=2000)
    monkeypatch.setattr(sift, "PIXELS_PER_FEATURE", np.inf)
    whole = sift.detect_sift(image, config)
    monkeypatch.setattr(sift, "PIXELS_PER_FEATURE", 1)
    found = sift.detect_sift(image, config)
    assert len(whole) < 2000 and abs(len(found) - len(whole)) < 0.05 * len(whole)
    is_small = found.scale_px < 2.0 * sift._SIGMA
    distance, _ = cKDTree(position(whole)).query(position(found)[is_small])
    assert is_small.sum() > 100 and (distance == 0).all()


def test_more_extrema_than_expected_are_all_kept():
    noise = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    levels = next(sift._octaves(sift._doubled_base(noise)))
    found = sift._find_extrema(levels, 0.0001)
    assert len(found) == space.find_extrema(
        levels, np.float32(0), 0.0001 / 3, 10.0, np.empty((9999, 4), np.float32)
    )
    assert np.isfinite(found).all()


@pytest.mark.parametrize("sigma", [0.6, 1.25, 3.1])
def test_blur_is_gaussian(rng, sigma):
    image = rng.random((31, 45)).astype(np.float32)
    out = np.empty_like(image)
    space.blur(image, sift._gaussian(sigma), out)
    expected = gaussian_filter(image.astype(float), sigma, mode="mirror", radius=int(np.ceil(4 * sigma)))
    np.testing.assert_allclose(out, expected, atol=1e-6)


def test_blur_of_a_picture_smaller_than_the_window(rng):
    image = rng.random((12, 12)).astype(np.float32)
    out = np.empty_like(image)
    space.blur(image, sift._gaussian(5.0), out)
    np.testing.assert_allclose(
        out, gaussian_filter(image.astype(float), 5.0, mode="mirror", radius=20), atol=1e-6
    )


def test_orientation_is_that_of_the_gradient():
    y, x = np.mgrid[:60, :60].astype(np.float32)
    for degrees in (0.0, 30.0, 100.0, 200.0, 355.0):
        ramp = (np.cos(np.deg2rad(degrees)) * x + np.sin(np.deg2rad(degrees)) * y).astype(np.float32)
        angles = np.empty(kernels.MOST_ORIENTATIONS)
        assert kernels.find_orientations(ramp, 30.0, 30.0, 2.0, angles) == 1
        difference = np.rad2deg(angles[0]) - degrees
        assert (
            abs((difference + 180) % 360 - 180) < 5.001
        )  # half a bin: a ramp has no spread to interpolate in


@pytest.mark.parametrize("size", [(16, 16), (16, 200), (17, 33)])
def test_small_pictures_are_no_trouble(rng, size):
    found = sift.detect_sift(rng.integers(0, 255, size).astype(np.uint8), FeatureConfig())
    assert np.isfinite(found.pixels).all() and found.descriptors.shape[1] == 128
    assert (found.pixels >= 0).all() and (found.pixels <= np.array(size[::-1]) - 1).all()


def test_samples_beyond_the_rim_of_a_very_wide_level_stay_inside():
    level = np.zeros((32, 32_800), np.float32)  # so wide that width - 1.001 rounds to width - 1
    patch = np.empty((22, 22), np.float32)
    kernels._sample.py_func(level, 32_794.0, 29.0, 1.5, 0.3, patch)  # Python would raise IndexError
    assert (patch == 0).all()


def test_domain_sizes_find_more_matches_between_distant_views(image):
    """In a view from the side, darker and with noise."""
    turn = np.array([[0.5, 0.05, 40.0], [0.0, 0.9, 10.0]])
    seen = cv2.warpAffine(image, turn, (320, 240), borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(0).normal(scale=4.0, size=seen.shape)
    seen = np.clip(0.8 * seen + 10.0 + noise, 0, 255).astype(np.uint8)
    right, wrong = {}, {}
    for sizes in (1, 5):
        config = FeatureConfig(domain_sizes=sizes)
        here, there = sift.detect_sift(image, config), sift.detect_sift(seen, config)
        matches = match_descriptors(here.descriptors, there.descriptors)
        moved = here.pixels[matches[:, 0]] @ turn[:, :2].T + turn[:, 2]
        off = np.linalg.norm(moved - there.pixels[matches[:, 1]], axis=1)
        right[sizes], wrong[sizes] = int((off < 2.0).sum()), int((off >= 2.0).sum())
    assert right[5] > 1.3 * right[1] > 30
    assert wrong[5] <= wrong[1]


@pytest.mark.parametrize("pixels_per_feature", [1, np.inf])
def test_low_contrast_gives_no_features_with_and_without_the_doubled_octave(
    image, monkeypatch, pixels_per_feature
):
    monkeypatch.setattr(sift, "PIXELS_PER_FEATURE", pixels_per_feature)
    faint = np.rint(128 + 0.004 * (image.astype(float) - 128)).astype(np.uint8)
    assert np.ptp(faint) > 0
    assert len(sift.detect_sift(faint, FeatureConfig())) == 0
    assert len(sift.detect_sift(image, FeatureConfig())) > 400
