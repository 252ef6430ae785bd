"""Gaussians as bytes of a page: unpacked, they are the cloud's numbers within rounding."""

import numpy as np
import pytest

from epipole.report.gaussians import ROW, most_visible, packed
from epipole.scene.gaussian_cloud import DC, GaussianCloud


def cloud_of(n: int, num_sh: int = 1, seed: int = 0) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    arrays = (
        *(rng.normal(size=(n, 3)), rng.uniform(-6, 0, (n, 3)), 3 * rng.normal(size=(n, 4))),
        *(rng.normal(scale=3, size=n), rng.uniform(-1, 1, (n, num_sh, 3))),
    )
    return GaussianCloud(*(np.asarray(array, np.float32) for array in arrays))


def triples(words: np.ndarray, within: tuple[float, float]) -> np.ndarray:
    parts = np.stack([words & 1023, words >> 10 & 1023, words >> 20 & 1023], axis=-1)
    return within[0] + within[1] * parts / 1023.0


@pytest.mark.parametrize("num_sh", [1, 4, 16])
def test_what_is_packed_comes_back(num_sh: int) -> None:
    cloud = cloud_of(200, num_sh)
    found = packed(cloud)
    assert ROW.itemsize == 32 and len(found.rows) == 32 * 200
    words = np.frombuffer(found.rows, "<u4").reshape(200, 8)
    assert np.array_equal(words[:, :3].view("<f4"), cloud.means_in_world)
    colors = 0.5 + DC * cloud.sh[:, 0]
    assert np.abs(triples(words[:, 3], found.color_range) - colors).max() < 1e-3
    quats = words[:, 4:6].copy().view("<i2") / 32767.0
    unit = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    assert np.abs(quats - unit).max() < 2e-5
    low, span = found.scale_range
    split = words[:, 6:8].copy().view("<u2")
    assert np.abs(low + span * split[:, :3] / 65535.0 - cloud.log_scales).max() < 1e-4
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits.astype(float)))
    assert np.abs(split[:, 3] / 65535.0 - opacity).max() < 1e-5
    if num_sh == 1:
        assert found.harmonics is None
    else:
        kept = triples(np.frombuffer(found.harmonics, "<u4").reshape(200, 3), found.harmonic_range)
        assert np.abs(kept - cloud.sh[:, 1:4]).max() < 1.1e-3


def test_numbers_beyond_all_reason_are_clipped() -> None:
    cloud = cloud_of(4, 4)
    cloud.log_scales[0], cloud.sh[1], cloud.opacity_logits[:2] = 1e30, -1e30, (1e30, -1e30)
    cloud.log_scales[2] = -1e30
    found = packed(cloud)
    assert np.isfinite([*found.scale_range, *found.color_range, *found.harmonic_range]).all()
    rows = np.frombuffer(found.rows, ROW)
    assert rows["opacity"][0] == 65535 and rows["opacity"][1] == 0
    assert (rows["log_scale"][0] == 65535).all() and (rows["log_scale"][2] == 0).all()
    assert len(most_visible(cloud, 2)) == 2


def test_equal_gaussians_have_a_range_of_nothing() -> None:
    found = packed(cloud_of(1).rows(np.zeros(3, np.int64)))
    rows = np.frombuffer(found.rows, ROW)
    assert len(rows) == 3 and found.scale_range[1] > 0
    same = cloud_of(1)
    same.log_scales[:] = -2.0
    found = packed(same)
    assert found.scale_range == (-2.0, 0.0) and not np.frombuffer(found.rows, ROW)["log_scale"].any()


def test_the_most_visible_stay_in_their_order() -> None:
    cloud = cloud_of(300, seed=3)
    rows = most_visible(cloud, 40)
    assert len(rows) == 40 and (np.diff(rows) > 0).all()
    sizes = np.sort(np.exp(cloud.log_scales.astype(float)), axis=1)
    visible = sizes[:, 1] * sizes[:, 2] / (1 + np.exp(-cloud.opacity_logits.astype(float)))
    assert set(rows) == set(np.argsort(-visible)[:40])
    assert np.array_equal(most_visible(cloud, 300), np.arange(300))
