"""Images for learned features, and keypoints and samples from the maps of their networks, have known answers."""

import numpy as np
import pytest

from epipole.features.learned_aliked import is_local_maximum, padded_image, refine_peaks, select_peaks
from epipole.features.learned_xfeat import cell_positions, keypoint_heat, network_image, select_keypoints
from epipole.features.map_sampling import cubic_weights, linear_weights, sample_map


def test_heat_is_a_softmax_in_the_order_of_the_pixels():
    logits = np.full((65, 2, 3), -np.inf, np.float32)
    logits[64] = 0.0
    logits[8 * 5 + 2, 1, 2] = np.log(3.0)  # row 5 and column 2 of the cell
    heat = keypoint_heat(logits)
    expected = np.zeros((16, 24))
    expected[8 + 5, 16 + 2] = 0.75
    np.testing.assert_allclose(heat, expected, atol=1e-7)


def test_keypoints_are_local_maxima_in_the_order_of_their_scores():
    heat = np.zeros((32, 32), np.float32)
    heat[0, 0], heat[10, 10], heat[12, 12], heat[20, 9] = (
        0.3,
        0.5,
        0.4,
        0.5,
    )  # (12, 12) is beside a higher one
    heat[25, 25], heat[31, 16], heat[16, 31] = 0.05, 0.9, 0.9  # too low, and in the last row and column
    reliability = np.ones((1, 4, 4), np.float32)
    found, scores = select_keypoints(heat, reliability, 10)
    assert {tuple(each) for each in found} == {(0, 0), (10, 10), (9, 20)}
    np.testing.assert_allclose(scores[:2], 0.5, rtol=1e-6)
    assert (
        scores[2] < 0.3
    )  # half of the window in which reliability is sampled is outside the map, in both directions
    found, _ = select_keypoints(heat, reliability, 1)
    np.testing.assert_array_equal(found, [[10, 10]])  # of equal scores the first in reading order
    assert len(select_keypoints(np.zeros((32, 32), np.float32), reliability, 10)[0]) == 0


def test_cubic_weights_are_those_of_keys_and_sum_to_one():
    fraction = np.array([0.0, 0.5, 0.25], np.float32)
    offsets, weights = zip(*cubic_weights(fraction))
    assert offsets == (-1, 0, 1, 2)
    # from bicubic interpolation of a unit impulse by torch.nn.functional.grid_sample
    expected = [
        [0, -0.09375, -0.10546875],
        [1, 0.59375, 0.87890625],
        [0, 0.59375, 0.26171875],
        [0, -0.09375, -0.03515625],
    ]
    np.testing.assert_allclose(np.array(weights), expected, atol=1e-6)
    np.testing.assert_allclose(np.sum(weights, axis=0), 1.0, atol=1e-6)


@pytest.mark.parametrize("weights", [linear_weights, cubic_weights])
def test_maps_are_sampled_exactly_and_zero_outside(weights, rng):
    y, x = np.mgrid[:9, :11].astype(np.float32)
    values = np.stack([2 * x - y + 3, np.ones_like(x)])
    at = rng.uniform([1.0, 1.0], [8.9, 6.9], (50, 2)).astype(np.float32)
    if weights is cubic_weights:  # this kernel reproduces constants, but no slopes, between elements
        np.testing.assert_allclose(sample_map(values, at, weights)[:, 1], 1.0, atol=1e-5)
        at = np.floor(at)
    expected = np.stack([2 * at[:, 0] - at[:, 1] + 3, np.ones(50)], axis=1)
    np.testing.assert_allclose(sample_map(values, at, weights), expected, atol=1e-5)
    outside = np.array([[-4, 3], [14, 3], [3, -4], [3, 12]], np.float32)
    np.testing.assert_array_equal(sample_map(values, outside, weights), np.zeros((4, 2)))
    half_outside = sample_map(values, np.array([[-0.5, 4]], np.float32), linear_weights)
    np.testing.assert_allclose(half_outside, [[-0.5, 0.5]])


def test_cells_are_sampled_where_xfeat_samples_them():
    # torch: grid_sample(align_corners=False) at 2 x / (w - 1) - 1
    pixels = np.array([[0, 0], [95, 63], [40, 10]])
    expected = [[-0.5, -0.5], [11.5, 7.5], [40 * 12 / 95 - 0.5, 10 * 8 / 63 - 0.5]]
    np.testing.assert_allclose(cell_positions(pixels, (96, 64)), expected, rtol=1e-6)


def test_a_suppressed_maximum_suppresses_nothing():
    scores = np.zeros((15, 20), np.float32)
    scores[5, 5], scores[5, 7], scores[5, 9] = (
        0.9,
        0.8,
        0.7,
    )  # the second is beside the first, the third beside the second
    scores[9, 14], scores[1, 12], scores[9, 3] = 0.95, 0.99, 0.1
    np.testing.assert_array_equal(
        np.argwhere(is_local_maximum(scores) & (scores > 0.5)), [[1, 12], [5, 5], [5, 9], [9, 14]]
    )
    np.testing.assert_array_equal(
        select_peaks(scores, 10), [[14, 9], [5, 5], [9, 5]]
    )  # (12, 1) is at the border
    np.testing.assert_array_equal(select_peaks(scores, 1), [[14, 9]])


def test_peaks_are_refined_by_the_scores_around_them():
    scores = np.zeros((9, 9), np.float32)
    scores[4, 4] = scores[4, 5] = 1.0
    # weights e^0 at both and e^-10 at the 23 others of the window, whose coordinates sum to -1 and 0
    expected = [4 + (1 - np.exp(-10)) / (2 + 23 * np.exp(-10)), 4]
    np.testing.assert_allclose(refine_peaks(scores, np.array([[4, 4]])), [expected], atol=1e-5)


def test_images_are_padded_with_their_border():
    image = np.arange(33 * 34 * 3, dtype=np.uint32).astype(np.uint8).reshape(33, 34, 3)
    padded, inside = padded_image(image)
    assert padded.shape == (3, 64, 64)
    np.testing.assert_allclose(padded[:, *inside], image.transpose(2, 0, 1) / 255, atol=1e-6)
    np.testing.assert_array_equal(padded[:, :, 0], padded[:, :, inside[1].start])
    np.testing.assert_array_equal(padded[:, -1], padded[:, inside[0].stop - 1])


def test_the_image_is_normalized_and_a_blank_one_stays_finite(rng):
    rgb = rng.integers(0, 255, (70, 100, 3)).astype(np.uint8)
    image = network_image(rgb, 1000)
    assert image.shape == (64, 96)
    np.testing.assert_allclose([image.mean(), image.std()], [0, 1], atol=1e-3)
    np.testing.assert_array_equal(network_image(np.full((64, 64), 90, np.uint8), 1000), np.zeros((64, 64)))
    assert network_image(np.zeros((2000, 40), np.uint8), 200).shape == (192, 32)
