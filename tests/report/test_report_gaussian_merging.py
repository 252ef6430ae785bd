"""A cloud of fewer Gaussians looks like the whole one."""

from pathlib import Path

import numpy as np
import pytest
from test_report_gaussians import cloud_of

from epipole.fields.splat.rasterizer import render
from epipole.pipelines.fields.cameras import orbit
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.scene import seen_gaussians
from epipole.report.gaussian_merging import merged
from epipole.report.gaussians import log_visibility, most_visible
from epipole.scene.gaussian_cloud import GaussianCloud

BLACK = np.zeros(3, np.float32)


def surface(n: int = 4000) -> GaussianCloud:
    """A square of many small Gaussians whose color changes slowly, with a few large ones behind it."""
    rng = np.random.default_rng(4)
    means = np.concatenate(
        [rng.uniform(-1, 1, (n, 3)) * (1, 1, 0.01), rng.uniform(-1, 1, (20, 3)) * (2, 2, 0) + (0, 0, 2)]
    )
    scales = np.concatenate([np.full((n, 3), np.log(0.03)), np.full((20, 3), np.log(0.6))])
    sh = np.stack([means[:, 0], means[:, 1], -means[:, 0]], axis=1)[:, None]
    quats = rng.normal(size=(n + 20, 4))
    arrays = (means, scales, quats, np.zeros(n + 20), sh)
    return GaussianCloud(*(np.asarray(array, np.float32) for array in arrays))


def psnrs(cloud: GaussianCloud, others: list[GaussianCloud], view: tuple[np.ndarray, ...]) -> np.ndarray:
    """(clouds, views) against the whole."""
    shots = orbit(*view, RenderConfig(frames=3, width=200))
    rendered = [
        np.stack(
            [np.clip(render(each, shot.camera, shot.cam_from_world).over(BLACK), 0, 1) for shot in shots]
        )
        for each in (cloud, *others)
    ]
    return np.array(
        [-10 * np.log10(((each - rendered[0]) ** 2).mean(axis=(1, 2, 3))) for each in rendered[1:]]
    )


def test_a_surface_keeps_its_look() -> None:
    cloud = surface()
    few = merged(cloud, 800)
    view = np.array([0.3, 0.2, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0])
    (fewer, left_out) = psnrs(cloud, [few, cloud.rows(most_visible(cloud, 800))], view)
    assert len(few) == 800 and fewer.min() > 30 and (fewer > left_out + 10).all()


def test_a_guitar_keeps_its_look(data_dir: Path) -> None:
    cloud, view = seen_gaussians(data_dir / "fields" / "splats" / "guitar.compressed.ply")
    most = len(cloud) // 5
    clouds = [merged(cloud, most), cloud.rows(most_visible(cloud, most))]
    fewer, left_out = psnrs(cloud, clouds, (view.position, view.look_at, view.up))
    assert fewer.min() > 30 and (fewer > left_out + 4).all()


def test_what_is_kept_alone_is_not_changed() -> None:
    cloud = cloud_of(500, 4)
    assert merged(cloud, 500) is cloud
    few = merged(cloud, 490)
    same = (few.means_in_world[:, None] == cloud.means_in_world[None]).all(axis=2)
    assert len(few) == 490 and same.any(axis=1).sum() >= 470
    rows = same.argmax(axis=1)[same.any(axis=1)]
    kept = few.rows(np.flatnonzero(same.any(axis=1)))
    assert np.array_equal(kept.sh, cloud.sh[rows]) and np.array_equal(kept.quats_wxyz, cloud.quats_wxyz[rows])


def test_moments_are_those_of_the_group() -> None:
    cloud = cloud_of(60, 4, seed=8)
    one = merged(cloud, 1)
    weight = np.exp(log_visibility(cloud))
    mean = np.average(cloud.means_in_world, axis=0, weights=weight)
    assert len(one) == 1 and one.means_in_world[0] == pytest.approx(mean, rel=1e-5)
    assert one.sh[0] == pytest.approx(np.average(cloud.sh, axis=0, weights=weight), abs=1e-5)
    w, x, y, z = one.quats_wxyz[0].astype(float)
    assert np.hypot(np.hypot(w, x), np.hypot(y, z)) == pytest.approx(1, abs=1e-6)
    apart = cloud.means_in_world - mean
    own = np.average(np.exp(2.0 * cloud.log_scales.astype(float)).sum(axis=1), weights=weight)
    around = np.average((apart**2).sum(axis=1), weights=weight)
    assert np.exp(2.0 * one.log_scales.astype(float)).sum() == pytest.approx(own + around, rel=1e-4)


@pytest.mark.parametrize("most", [1, 2, 7])
def test_odd_clouds(most: int) -> None:
    cloud = cloud_of(9, 1)
    cloud.log_scales[0], cloud.opacity_logits[:3] = 1e30, (1e30, -1e30, -1e30)
    cloud.log_scales[1], cloud.quats_wxyz[4], cloud.means_in_world[5:] = -1e30, 0.0, cloud.means_in_world[5]
    cloud.means_in_world[2] = 3e38
    few = merged(cloud, most)
    assert len(few) == most
    for array in (few.means_in_world, few.sh):
        assert np.isfinite(array).all()
