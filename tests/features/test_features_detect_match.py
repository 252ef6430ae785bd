"""Features stand where the blobs are; matching equals brute force."""

import numpy as np
import pytest

import epipole.features.match as matching
from epipole.config import FeatureConfig, MatchConfig
from epipole.errors import ShapeError
from epipole.features import (
    Features,
    describe_image,
    describe_images,
    detect_features,
    match_along_epipolar_lines,
    match_descriptors,
    most_similar,
    root_sift,
    train_vocabulary,
)


def blobs(centers, sigma, size=240):
    y, x = np.mgrid[:size, :size]
    image = np.full((size, size), 60.0)
    for cx, cy in centers:
        image += 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8)


@pytest.mark.parametrize("sigma", [2.0, 3.0, 5.0])
def test_keypoints_stand_at_the_blobs_centers(sigma):
    centers = np.array([(60.3, 70.8), (150.0, 60.5), (90.75, 170.25), (180.1, 180.9)])
    found = detect_features(blobs(centers, sigma)).pixels.astype(float)
    offsets = np.array([found[np.argmin(np.linalg.norm(found - c, axis=1))] - c for c in centers])
    assert np.abs(offsets).max() < 0.12
    assert np.abs(offsets.mean(axis=0)).max() < 0.05  # a shift of 0.25 px would show here


def test_keypoints_of_a_reduced_picture_are_in_full_pixels():
    centers = np.array([(80.0, 100.0), (170.0, 160.0)])
    found = detect_features(blobs(centers, 8.0), FeatureConfig(max_size_px=120)).pixels.astype(float)
    for c in centers:
        assert np.linalg.norm(found - c, axis=1).min() < 0.3


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_blank_and_tiny_pictures_have_no_features(kind):
    config = FeatureConfig(kind=kind)
    assert len(detect_features(np.full((200, 200), 128, np.uint8), config)) == 0
    assert len(detect_features(np.zeros((3, 3), np.uint8), config)) == 0


def test_number_of_features_is_bounded(rng):
    image = rng.integers(0, 255, (300, 300)).astype(np.uint8)
    assert len(detect_features(image, FeatureConfig(max_features=50))) == 50


def test_root_sift_has_unit_length_and_gives_the_hellinger_kernel(rng):
    raw = rng.uniform(0, 100, (20, 128)).astype(np.float32)
    out = root_sift(raw).astype(float)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 512, rtol=0.01)
    p, q = raw[0] / raw[0].sum(), raw[1] / raw[1].sum()
    assert abs(out[0] @ out[1] / 512**2 - np.sqrt(p * q).sum()) < 0.01


def brute_force(a, b, config):
    similarity = a.astype(float) @ b.astype(float).T
    angle = np.arccos(np.clip(similarity / 512**2, 0, 1))
    pairs = []
    for i in range(len(a)):
        order = np.argsort(angle[i], kind="stable")
        j = order[0]
        unique = len(order) < 2 or angle[i, j] < config.max_ratio * angle[i, order[1]]
        if unique and angle[i, j] <= config.max_distance and similarity[i, j] == similarity[:, j].max():
            pairs.append((i, j))
    return np.array(pairs).reshape(-1, 2)


@pytest.mark.parametrize(("n", "m"), [(300, 411), (1, 50), (50, 1), (257, 33)])
def test_matching_equals_brute_force(rng, n, m):
    a = root_sift(rng.gamma(0.3, 1, (n, 128)).astype(np.float32))
    b = root_sift(rng.gamma(0.3, 1, (m, 128)).astype(np.float32))
    common = min(n, m) // 2
    b[:common] = np.clip(a[:common].astype(int) + rng.integers(-4, 5, (common, 128)), 0, 255)
    config = MatchConfig()
    np.testing.assert_array_equal(match_descriptors(a, b, config), brute_force(a, b, config))


@pytest.mark.parametrize(("n", "m"), [(1, 1), (8, 32), (9, 33), (700, 1003)])
def test_byte_products_equal_float_products(rng, n, m):
    if matching.byte_kernels.LANES == 0:
        pytest.skip("this processor has no products of whole numbers")
    a, b = (root_sift(rng.gamma(0.3, 1, (k, 128)).astype(np.float32)) for k in (n, m))
    b[: min(n, m)] = a[: min(n, m)]
    b[m // 2 :] = b[: m - m // 2]  # exact ties
    config = MatchConfig(max_ratio=1.0)
    column, *by_bytes = matching._top_two_bytes(a, b, config)
    by_floats = matching._top_two_floats(a, b, config)
    known = by_floats[0] >= 0
    np.testing.assert_array_equal(column[known], by_floats[0][known])
    for ours, theirs in zip(by_bytes, by_floats[1:]):
        np.testing.assert_array_equal(ours, np.maximum(theirs, 0))


def test_descriptors_too_long_for_byte_keys_are_compared_as_floats(rng):
    long = (rng.integers(0, 2, (40, 128)) * 255).astype(np.uint8)
    assert not matching._fits_byte_dot(long, long)
    config = MatchConfig(max_ratio=1.0)
    np.testing.assert_array_equal(match_descriptors(long, long, config), brute_force(long, long, config))


def test_orb_bits_match_their_copies(rng):
    a = rng.integers(0, 256, (100, 32)).astype(np.uint8)
    order = rng.permutation(100)
    found = match_descriptors(a, a[order])
    np.testing.assert_array_equal(order[found[:, 1]], found[:, 0])
    assert len(found) == 100


def test_empty_and_mismatched_descriptors():
    empty = np.zeros((0, 128), np.uint8)
    assert match_descriptors(empty, empty).shape == (0, 2)
    with pytest.raises(ShapeError):
        match_descriptors(empty, np.zeros((0, 32), np.uint8))


def test_guided_matches_lie_on_their_lines_and_find_repeated_features(rng):
    n = 400
    descriptors = np.repeat(root_sift(rng.gamma(0.3, 1, (n // 2, 128)).astype(np.float32)), 2, axis=0)
    pixels1 = rng.uniform(0, 500, (n, 2)).astype(np.float32)
    shift = rng.uniform(5, 60, n).astype(np.float32)
    pixels2 = pixels1 + np.stack([shift, np.zeros(n, np.float32)], axis=1)
    ones = np.ones(n, np.float32)
    first, second = Features(pixels1, ones, ones, descriptors), Features(pixels2, ones, ones, descriptors)
    horizontal = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # x2^T F x1 = 0: the same row
    assert len(match_descriptors(descriptors, descriptors)) == 0  # every feature stands twice
    found = match_along_epipolar_lines(first, second, horizontal, 2.0)
    assert len(found) > 0.9 * n
    assert (found[:, 0] == found[:, 1]).mean() > 0.95
    assert np.abs(pixels1[found[:, 0], 1] - pixels2[found[:, 1], 1]).max() <= 2.0


def test_retrieval_finds_the_picture_with_the_same_features(rng):
    scenes = [root_sift(rng.gamma(0.3, 1, (200, 128)).astype(np.float32)) for _ in range(6)]
    images = [s[rng.permutation(200)[:150]] for s in scenes for _ in range(2)]
    words = train_vocabulary(images, num_words=16)
    nearest = most_similar(np.stack([describe_image(p, words) for p in images]), 1)[:, 0]
    np.testing.assert_array_equal(nearest, np.arange(12) ^ 1)


def test_all_images_are_described_as_one_by_one(rng):
    images = [root_sift(rng.gamma(0.3, 1, (k, 128)).astype(np.float32)) for k in (0, 1, 40, 300)]
    words = train_vocabulary(images, num_words=8)
    expected = np.stack([describe_image(p, words) for p in images])
    np.testing.assert_array_equal(describe_images(images, words), expected)
    sums = np.zeros_like(words)
    values = images[3].astype(np.float32)
    word = np.argmin(((values[:, None] - words) ** 2).sum(axis=2), axis=1)
    np.add.at(sums, word, values - words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    vlad = (np.sign(sums) * np.sqrt(np.abs(sums))).ravel()
    np.testing.assert_allclose(expected[3], vlad / np.linalg.norm(vlad), atol=1e-5)


def test_many_images_are_compared_by_principal_components(rng):
    n, width = 1500, 256
    path = np.cumsum(rng.normal(size=(n, 8)), axis=0)  # images along a path: neighbors are similar
    axes = rng.normal(size=(8, width))
    vectors = (np.sin(0.3 * path) @ axes + 0.2 * rng.normal(size=(n, width))).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = most_similar(vectors, 50)
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    true = np.argsort(-similarity, axis=1)[:, :10]
    recall = np.mean([np.isin(t, f).mean() for t, f in zip(true, found)])
    assert found.shape == (n, 50) and (found != np.arange(n)[:, None]).all()
    assert recall > 0.95


@pytest.mark.parametrize("n", [200, 1100])
def test_averages_find_images_that_have_nothing_in_common_by_way_of_those_between(n):
    reach = 16  # images along a path, each with some of the things that the next ones show
    vectors = np.zeros((n, n + reach), np.float32)
    for i in range(n):
        vectors[i, i : i + reach + 1] = 1.0 / np.sqrt(reach + 1)
    found = most_similar(vectors, 50)
    np.testing.assert_array_equal(found[40:-40, :30], most_similar(vectors, 30)[40:-40])
    assert all(len({*row}) == 50 for row in found.tolist())
    for i in range(40, n - 40, 20):
        assert {*range(i - reach - 3, i + reach + 4)} - {i} <= {*found[i].tolist()}


def test_equal_images_have_no_principal_components():
    vectors = np.tile(np.ones((1, 8), np.float32) / np.sqrt(8), (1100, 1))
    assert most_similar(vectors, 3).shape == (1100, 3)
