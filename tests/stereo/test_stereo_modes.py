"""Blocks, coarse to fine, brightness in the cost, and filling."""

import cv2
import numpy as np
import pytest

from epipole import api
from epipole.disparity_search import _block_kernels
from epipole.disparity_search import _path_kernels as path_kernels
from epipole.disparity_search import search as stereo_matching
from epipole.disparity_search.coarse_to_fine import tiles_of
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, ShapeError
from epipole.io.images.depth_maps import read_pfm
from epipole.pipelines.stereo import _filling_kernels
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.filling import fill_disparities
from epipole.scene import StereoReason
from epipole.synthetic.stereo_rooms import stereo_room


@pytest.fixture(scope="module")
def pair():
    return stereo_room(4, (320, 240))


def wrong(found, pair):
    error = np.abs(found.disparity_px - pair.disparity_px)
    return float((error[np.isfinite(error)] > 1).mean())


def test_block_sums_are_sums_over_blocks(rng):
    """Against cv2.boxFilter of the Hamming distances, for every disparity; windows are cut off at the border."""
    left, right = rng.integers(0, 255, (2, 12, 40)).astype(np.uint16)
    config = StereoConfig(method="block", block_px=5, max_disparity_px=6)
    one, two = (stereo_matching._inspect(p, config) for p in (left, right))
    found = stereo_matching._winners(one, two, 0, 6, config)
    bits = np.unpackbits(one.bits[:, :, None] ^ two.bits[:, None], axis=-1).sum(axis=-1)
    height, width = left.shape
    sums = np.full((height, width, 7), np.inf)
    for d in range(7):
        cost = np.full((height, width), 255.0)
        for x in range(d, width):
            cost[:, x] = bits[:, x, x - d]
        sums[:, :, d] = cv2.boxFilter(cost, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    np.testing.assert_array_equal(found.lowest, sums.min(axis=2))
    np.testing.assert_array_equal(np.abs(found.disparity - sums.argmin(axis=2)) <= 0.5, True)


def test_blocks_are_right_where_there_is_texture(pair):
    high = int(np.nanmax(pair.disparity_px)) + 8
    blocks = match_stereo(pair.left, pair.right, StereoConfig(method="block", max_disparity_px=high))
    assert blocks.density > 0.9 and wrong(blocks, pair) < 0.015
    fast = StereoConfig(method="block", left_right="fast", max_disparity_px=high)
    assert match_stereo(pair.left, pair.right, fast).density > 0.6


def test_coarse_to_fine_finds_what_the_full_search_finds():
    big = stereo_room(5, (700, 560))
    full, tiled = (
        match_stereo(big.left, big.right, StereoConfig(max_disparity_px=126, search=search))
        for search in ("full", "coarse_to_fine")
    )
    assert abs(full.density - tiled.density) < 0.01
    assert wrong(tiled, big) < wrong(full, big) + 0.002
    both = np.isfinite(full.disparity_px) & np.isfinite(tiled.disparity_px)
    assert (np.abs(full.disparity_px - tiled.disparity_px)[both] < 0.25).mean() > 0.99
    with pytest.raises(ConfigError, match="accurate"):
        StereoConfig(search="coarse_to_fine", left_right="fast")


def test_tiles_cover_the_picture_and_their_ranges_hold_the_coarse_disparities(rng):
    coarse = rng.uniform(20, 60, (450, 500)).astype(np.float32)
    coarse[:, 250:] = np.nan
    seen = np.zeros((900, 1000), int)
    for tile in tiles_of(coarse, (900, 1000), (0, 400)):
        rows, columns, (first, last) = slice(*tile.rows), slice(*tile.columns), tile.disparities
        seen[rows, columns] += 1
        assert 0 <= first < last <= 400
        own = 2.0 * coarse[slice(*(r // 2 for r in tile.rows)), slice(*(c // 2 for c in tile.columns))]
        if np.isfinite(own).any():
            assert first <= np.nanmin(own) and np.nanmax(own) <= last
    assert (seen == 1).all()
    # Where nothing is known everything is searched.
    nothing = np.full((450, 500), np.nan, np.float32)
    assert all(t.disparities == (0, 400) for t in tiles_of(nothing, (900, 1000), (0, 400)))


def test_brightness_in_the_cost(pair, rng):
    left, right = rng.integers(0, 255, (2, 3, 50)).astype(np.uint16)
    size, search = (3, 50, 3, 32), (0, 32, 32)
    rows = {}
    for most in (0, 9):
        config = StereoConfig(brightness_cost=most)
        one, two = (stereo_matching._inspect(p, config) for p in (left, right))
        mirrored = np.zeros((3, 3, 50 + 64), np.uint8)
        mirrored[:, :, 32:82] = two.bits[:, ::-1].transpose(0, 2, 1)
        blended = stereo_matching._blended(one.brightness, two.brightness, 32, most)
        rows[most] = np.empty(50 * 32, np.uint8)
        images = (one.bits.reshape(-1), mirrored.reshape(-1), *blended)
        path_kernels.cost_row(images, 1, size, search, rows[most])
    more = (rows[9].astype(int) - rows[0]).reshape(50, 32)
    for x in range(50):
        for d in range(min(x + 1, 32)):
            assert more[x, d] == min(abs(int(left[1, x]) - int(right[1, x - d])) // 2, 9)
    high = int(np.nanmax(pair.disparity_px)) + 8
    found = match_stereo(pair.left, pair.right, StereoConfig(brightness_cost=8, max_disparity_px=high))
    assert found.density > 0.95 and wrong(found, pair) < 0.01


def test_the_tridiagonal_solution(rng):
    n = 30
    weights, values, links = rng.uniform(0, 1, n), rng.normal(size=n), rng.uniform(0, 1, n)
    links[-1] = 0.0
    system = np.diag(weights)
    for i in range(n - 1):
        constraint = 2.5 * links[i]
        system[i, i] += constraint
        system[i + 1, i + 1] += constraint
        system[i, i + 1] -= constraint
        system[i + 1, i] -= constraint
    out = np.empty(n)
    _filling_kernels.solve_line(weights, values, links, 2.5, np.empty(n), out)
    np.testing.assert_allclose(out, np.linalg.solve(system, weights * values), rtol=1e-9)
    np.testing.assert_allclose(
        _filling_kernels.solve_line.py_func(weights, values, links, 2.5, np.empty(n), out) or out, out
    )


def test_filled_pixels_are_marked_and_the_known_ones_stay(pair, tmp_path):
    high = int(np.nanmax(pair.disparity_px)) + 8
    found = match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=high))
    filled = fill_disparities(found, pair.left)
    known = np.isfinite(found.disparity_px)
    np.testing.assert_array_equal(filled.filled_mask, ~known)
    np.testing.assert_array_equal(filled.disparity_px[known], found.disparity_px[known])
    assert np.isfinite(filled.disparity_px).all()
    error = np.abs(filled.disparity_px - pair.disparity_px)
    occluded = (found.reason == StereoReason.OCCLUDED) & np.isfinite(error)
    assert np.median(error[occluded]) < 3.0
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), getattr(pair, name))
    config = StereoConfig(max_disparity_px=high, fill=True)
    api.stereo(tmp_path / "left.png", tmp_path / "right.png", tmp_path / "out", config)
    written = read_pfm(tmp_path / "out" / "filled.pfm")
    np.testing.assert_allclose(written, filled.disparity_px, atol=1e-4)
    mask = cv2.imread(str(tmp_path / "out" / "filled_mask.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(mask > 0, ~known)
    assert not np.isfinite(read_pfm(tmp_path / "out" / "disparity.pfm")[~known]).any()


def test_nothing_to_fill_from_and_bad_input(pair):
    blank = np.full((40, 60), 90, np.uint8)
    nothing = match_stereo(blank, blank, StereoConfig(max_disparity_px=16))
    assert not np.isfinite(fill_disparities(nothing, blank).disparity_px).any()
    with pytest.raises(ShapeError, match="8-bit image"):
        fill_disparities(nothing, blank[:10])
    with pytest.raises(ConfigError, match="strength"):
        fill_disparities(nothing, blank, 0.0)
    for options in ({"block_px": 4}, {"block_px": 17}, {"brightness_cost": -1}, {"brightness_cost": 200}):
        with pytest.raises(ConfigError):
            StereoConfig(**options)


def test_block_kernels_are_their_python_selves(rng):
    columns = rng.integers(0, 900, 8 * 32).astype(np.uint16)
    out, expected = np.empty(8 * 32, np.uint16), np.empty(8 * 32, np.uint16)
    _block_kernels.sum_across(columns, 2, 8, 32, out)
    _block_kernels.sum_across.py_func(columns, 2, 8, 32, expected)
    np.testing.assert_array_equal(out, expected)
    whole = columns.reshape(8, 32).astype(int)
    for x in range(8):
        np.testing.assert_array_equal(out.reshape(8, 32)[x], whole[max(x - 2, 0) : x + 3].sum(axis=0))
