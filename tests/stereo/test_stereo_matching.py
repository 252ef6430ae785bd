"""Semi-global matching against a plain reference, known shifts, real pairs with truth, and bad input."""

import numpy as np
import pytest
from PIL import Image

from epipole import _parallel
from epipole.disparity_search import search as stereo_matching
from epipole.disparity_search._path_kernels import NEVER
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, ShapeError
from epipole.image import census
from epipole.pipelines.stereo.config import StereoConfig
from epipole.scene import StereoReason


def texture(rng, height, width):
    return rng.integers(0, 256, (height, width)).astype(np.uint8)


def shifted_pair(rng, height, width, disparity):
    """Both images of a plane that faces the cameras."""
    wide = texture(rng, height, width + disparity)
    return wide[:, :width], wide[:, disparity:]


def reference_sums(left, right, low, count, config):
    """Hirschmueller's sums as the paper writes them: every path on its own, pixel after pixel."""
    height, width = left.shape
    codes = [np.unpackbits(census(p.astype(np.uint16), config.window), axis=2) for p in (left, right)]
    cost = np.full((height, width, count), NEVER, int)
    for x in range(width):
        for k in range(count):
            if 0 <= x - low - k < width:
                cost[:, x, k] = (codes[0][:, x] != codes[1][:, x - low - k]).sum(axis=1)
    directions = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    if config.paths == 8:
        directions += [(1, 1), (-1, 1), (1, -1), (-1, -1)]
    sums = np.zeros_like(cost)
    for dx, dy in directions:
        path = np.zeros_like(cost)
        for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
            for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
                v, u = y - dy, x - dx
                if not (0 <= v < height and 0 <= u < width):
                    path[y, x] = cost[y, x]
                    continue
                before, least = path[v, u], path[v, u].min()
                edge = abs(int(left[y, x]) - int(left[v, u]))
                jump = np.rint(
                    config.small_penalty * (1 + config.edge_penalty * np.exp(-edge / config.edge_fade))
                )
                padded = np.pad(before, 1, constant_values=10_000)
                beside = np.minimum(padded[:-2], padded[2:]) + config.small_penalty
                path[y, x] = np.minimum(
                    cost[y, x] + np.minimum.reduce([before, beside, np.full(count, least + jump)]) - least,
                    255,
                )
        sums += path
    return sums


@pytest.mark.parametrize("paths", [4, 8])
@pytest.mark.parametrize("low", [0, -3, 2])
def test_sums_are_those_of_the_paper(rng, paths, low):
    left, right = texture(rng, 9, 40), texture(rng, 9, 40)
    config = StereoConfig(paths=paths, min_disparity_px=low, max_disparity_px=low + 8)
    sums = reference_sums(left, right, low, 9, config)
    images = (stereo_matching._inspect(p.astype(np.uint16), config) for p in (left, right))
    found = stereo_matching._winners(*images, low, low + 8, config)
    np.testing.assert_array_equal(found.lowest, sums.min(axis=2))
    assert np.abs(np.rint(found.disparity) - low - sums.argmin(axis=2)).max() <= 1
    for y, x in np.ndindex(left.shape):
        k = sums[y, x].argmin()
        far = np.delete(sums[y, x], [i for i in (k - 1, k, k + 1) if 0 <= i < 9])
        assert found.second[y, x] == far.min()
    # The other image's disparities, read along the diagonals of the sums.
    for y, x in np.ndindex(left.shape):
        orientations = [(sums[y, x + low + k, k], k) for k in range(9) if 0 <= x + low + k < 40]
        assert (
            np.isnan(found.other[y, x])
            if not orientations
            else found.other[y, x] == low + min(orientations)[1]
        )


def test_census_sets_a_bit_for_each_darker_pixel(rng):
    image = texture(rng, 12, 17).astype(np.uint16)
    bits = np.unpackbits(census(image, (5, 3)), axis=2, bitorder="little")[..., :14]
    padded = np.pad(image, ((1, 1), (2, 2)), mode="edge")
    window = [padded[1 + dy : 13 + dy, 2 + dx : 19 + dx] for dy in (-1, 0, 1) for dx in (-2, -1, 0, 1, 2)]
    expected = np.stack([w < image for n, w in enumerate(window) if n != 7], axis=2)
    np.testing.assert_array_equal(bits, expected)
    np.testing.assert_array_equal(census(image, (5, 3)), census(image * 7 + 3, (5, 3)))


@pytest.mark.parametrize(
    "config", [StereoConfig(), StereoConfig(left_right="fast", paths=4), StereoConfig(window=(9, 7))]
)
@pytest.mark.parametrize("disparity", [0, 1, 17, 40])
def test_a_plane_that_faces_the_cameras(rng, config, disparity):
    left, right = shifted_pair(rng, 60, 200, disparity)
    found = match_stereo(left, right, config)
    inner = found.disparity_px[:, disparity + 4 : -4]
    assert np.nanmax(np.abs(inner - disparity)) < 0.5 and np.isfinite(inner).mean() > 0.99
    assert (found.reason[:, disparity + 2 :] == StereoReason.OK).mean() > 0.98
    assert np.array_equal(np.isfinite(found.disparity_px), found.reason == StereoReason.OK)


def test_a_half_pixel_is_seen(rng):
    """Averages of two neighbors lie half a pixel off."""
    wide = texture(rng, 80, 321).astype(float)
    fine = np.repeat(wide, 2, axis=1)
    smooth = (fine[:, :-3] + fine[:, 1:-2] + fine[:, 2:-1] + fine[:, 3:]) / 4
    left, right = smooth[:, 0:600:2], smooth[:, 13:613:2]
    found = match_stereo(left.astype(np.uint8), right.astype(np.uint8), StereoConfig(max_disparity_px=30))
    assert np.nanmedian(found.disparity_px[10:-10, 20:-20]) == pytest.approx(6.5, abs=0.1)


def test_strips_and_threads_do_not_change_what_is_found(rng, monkeypatch):
    left, right = shifted_pair(rng, 230, 120, 9)
    right = np.clip(right + 30.0 * rng.standard_normal(right.shape), 0, 255).astype(np.uint8)
    config = StereoConfig(max_disparity_px=31)
    whole = match_stereo(left, right, config)
    _parallel.set_num_threads(1)
    try:
        alone = match_stereo(left, right, config)
    finally:
        _parallel.set_num_threads(None)
    np.testing.assert_array_equal(whole.disparity_px, alone.disparity_px)
    np.testing.assert_array_equal(whole.reason, alone.reason)
    monkeypatch.setattr(stereo_matching, "_MOST_ROWS", 40)
    strips = match_stereo(left, right, config)
    both = np.isfinite(strips.disparity_px) & np.isfinite(whole.disparity_px)
    assert (both == np.isfinite(whole.disparity_px)).mean() > 0.995
    assert (strips.disparity_px[both] == whole.disparity_px[both]).mean() > 0.99


def test_what_cannot_be_known_is_not_invented(rng):
    left, right = shifted_pair(rng, 80, 160, 12)
    blank = np.full_like(left, 90)
    found = match_stereo(blank, blank, StereoConfig(max_disparity_px=31))
    assert found.density == 0 and (found.reason == StereoReason.TEXTURELESS).any()
    unrelated = match_stereo(left, texture(rng, 80, 160), StereoConfig(max_disparity_px=31))
    assert unrelated.density < 0.05
    # A near square hides what stands behind it to its left.
    near = texture(rng, 30, 40)
    left, right = left.copy(), right.copy()
    left[25:55, 80:120], right[25:55, 52:92] = near, near
    found = match_stereo(left, right, StereoConfig(max_disparity_px=47))
    assert np.nanmedian(found.disparity_px[28:52, 84:116]) == pytest.approx(28, abs=0.3)
    hidden = found.reason[30:50, 67:78]
    assert (hidden == StereoReason.OCCLUDED).mean() > 0.6


def test_pictures_of_16_bits_colors_and_different_exposure(rng):
    left, right = shifted_pair(rng, 60, 160, 11)
    config = StereoConfig(max_disparity_px=31)
    plain = match_stereo(left, right, config)
    deep = match_stereo(left.astype(np.uint16) * 200, right.astype(np.uint16) * 120 + 900, config)
    darker = match_stereo(np.repeat(left[..., None], 3, axis=2), (right * 0.6).astype(np.uint8), config)
    for found in (plain, deep, darker):
        assert np.nanmedian(found.disparity_px) == pytest.approx(11, abs=0.05) and found.density > 0.85


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        ((40, 60), (40, 61), "61 x 40"),
        ((40, 60, 4), (40, 60), "left must be"),
        ((0, 60), (0, 60), "empty"),
    ],
)
def test_what_is_no_pair_is_told_so(left, right, words):
    with pytest.raises(ShapeError, match=words):
        match_stereo(np.zeros(left, np.uint8), np.zeros(right, np.uint8))


def test_ranges_that_make_no_sense(rng):
    left, right = shifted_pair(rng, 30, 60, 5)
    with pytest.raises(ConfigError, match="60 pixels wide"):
        match_stereo(left, right, StereoConfig(min_disparity_px=60))
    with pytest.raises(ConfigError, match="at least min_disparity_px"):
        StereoConfig(min_disparity_px=5, max_disparity_px=4)
    with pytest.raises(ConfigError, match="odd"):
        StereoConfig(window=(4, 5))
    with pytest.raises(ConfigError, match="254"):
        StereoConfig(small_penalty=60)
    wide = match_stereo(left, right, StereoConfig(max_disparity_px=5000))
    assert np.nanmedian(wide.disparity_px) == pytest.approx(5, abs=0.1)
    tiny = match_stereo(left[:1, :1], right[:1, :1])
    assert tiny.disparity_px.shape == (1, 1)


def test_inputs_are_not_written_to(rng):
    left, right = shifted_pair(rng, 30, 60, 5)
    before = left.copy(), right.copy()
    match_stereo(left, right, StereoConfig(max_disparity_px=15))
    np.testing.assert_array_equal(left, before[0])
    np.testing.assert_array_equal(right, before[1])


@pytest.mark.parametrize(
    ("name", "most_bad", "least_density"), [("cones", 2.5, 0.965), ("teddy", 4.0, 0.945)]
)
def test_real_pairs_with_truth(data_dir, name, most_bad, least_density):
    """Errors above one pixel among what both images see, and how much of that is known."""
    folder = data_dir / "stereo" / "middlebury_2003" / name
    left, right = (np.asarray(Image.open(folder / f"im{k}.png").convert("RGB")) for k in (2, 6))
    truth, theirs = (np.asarray(Image.open(folder / f"disp{k}.png")) / 4.0 for k in (2, 6))
    found = match_stereo(left, right)
    x = np.arange(truth.shape[1])
    there = np.rint(x - truth).astype(int)
    seen = (truth > 0) & (there >= 0)
    seen &= np.abs(np.take_along_axis(theirs, np.maximum(there, 0), axis=1) - truth) <= 1
    known = seen & np.isfinite(found.disparity_px)
    assert known.sum() / seen.sum() > least_density
    assert 100 * (np.abs(found.disparity_px - truth)[known] > 1).mean() < most_bad
