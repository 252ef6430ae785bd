"""The rasterizer against the equations written out, its derivatives against differences, and its edges."""

import numpy as np
import pytest
from plain_rasterizer import plain_render

from epipole import _parallel
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.fields.splat import (
    _blend_kernels,
    _gradient_kernels,
    _projection_kernels,
    _tile_kernels,
    numba_backend,
)
from epipole.fields.splat.numba_backend import useful_pairs
from epipole.fields.splat.rasterizer import (
    ImageGradient,
    RenderOptions,
    arrays_of,
    backward,
    render,
    render_view,
    view_of,
)
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at
from kernel_references import reference_of

CAMERA = Camera("PINHOLE", 45, 35, [40.0, 42.0, 22.0, 17.0])
SEEN = look_at((0.5, -2.5, 0.6), (0, 0, 0))
PARTS = ("means", "log_scales", "quats_wxyz", "logits", "sh")


def cloud_of(rng, count=60, num_sh=16):
    """Gaussians of all shapes around the middle, none of them over-exposed or black."""
    sh = 0.2 * rng.normal(size=(count, num_sh, 3))
    sh[:, 0] += 1.5
    arrays = (
        rng.uniform(-0.8, 0.8, (count, 3)),
        np.log(rng.uniform(0.05, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        0.5 * rng.normal(size=count),
        sh,
    )
    return GaussianCloud(*(array.astype(np.float32) for array in arrays))


@reference_of(
    _projection_kernels.project,
    _tile_kernels.count_tiles,
    _tile_kernels.fill_tiles,
    _blend_kernels.blend_tiles,
    _blend_kernels.put_over,
)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("num_sh", [1, 4, 9, 16])
def test_a_picture_is_that_of_the_equations(rng, num_sh, antialiased):
    cloud = cloud_of(rng, 200, num_sh)
    camera = Camera("PINHOLE", 70, 50, [60.0, 62.0, 34.0, 25.0])
    found = render(cloud, camera, SEEN, RenderOptions(antialiased=antialiased))
    color, depth, coverage = plain_render(arrays_of(cloud), camera, SEEN, antialiased=antialiased)
    # A pixel at which alpha is 1/255 to the last digit may fall on either side.
    for one, other in ((found.color, color), (found.depth, depth), (found.coverage, coverage)):
        off = np.abs(one - other)
        assert np.percentile(off, 99) < 1e-4 and off.max() < 2e-2
    assert found.over(np.ones(3, np.float32)) == pytest.approx(color + (1 - coverage)[..., None], abs=2e-2)


@reference_of(_tile_kernels.sort_by_depth)
@pytest.mark.parametrize("n", [0, 1, 5000])
def test_the_nearest_come_first_and_equal_ones_in_their_order(rng, n):
    depths = np.exp(rng.normal(0.0, 9.0, n)).astype(np.float32)
    depths[rng.random(n) < 0.3] = rng.choice([0.0, 1.0, 2.0])
    rows = np.flatnonzero(depths)
    wanted = rows[np.argsort(depths[rows], kind="stable")]
    np.testing.assert_array_equal(numba_backend._by_depth(depths), wanted)


@reference_of(_blend_kernels.count_useful)
def test_useful_pairs_are_those_of_the_equations(rng):
    cloud = cloud_of(rng, 200, 1)
    cloud.opacity_logits[:] += 3.0
    found, count, through = render(cloud, CAMERA, SEEN), 0, np.ones((35, 45))
    order = np.argsort(SEEN.apply(cloud.means_in_world.astype(float))[:, 2].astype(np.float32), kind="stable")
    for n in order:
        alone = plain_render(arrays_of(cloud.rows(np.array([n]))), CAMERA, SEEN)[2]
        count += ((alone > 0) & (through > 1e-4)).sum()
        through *= 1 - alone
    assert useful_pairs(found) == pytest.approx(count, rel=2e-3)
    assert 0 < useful_pairs(found) < found.num_evaluated and (through <= 1e-4).any()


@reference_of(_blend_kernels.blend_tiles_backward, _gradient_kernels.gather)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("num_sh", [1, 4, 9, 16])
def test_derivatives_are_those_of_differences(rng, num_sh, antialiased):
    cloud, options = cloud_of(rng, 30, num_sh), RenderOptions(antialiased=antialiased)
    arrays, view = arrays_of(cloud), view_of(CAMERA, SEEN, options)
    rendered = render_view(arrays, view)
    wanted = [
        rng.normal(size=part.shape).astype(np.float32)
        for part in (rendered.color, rendered.depth, rendered.coverage)
    ]
    found, _, by_pose = backward(arrays, view, rendered, ImageGradient(*wanted))

    def loss(parts, position):
        rendered = plain_render(parts, CAMERA, position, antialiased=antialiased)
        return sum(float((w * d).sum()) for w, d in zip(wanted, rendered))

    exact = [np.asarray(part, np.float64) for part in arrays]
    for k, name in enumerate(PARTS):
        own = np.asarray(getattr(found, name), np.float64).reshape(-1)
        off = []
        for at in rng.integers(len(own), size=15):
            ends = []
            for sign in (1.0, -1.0):
                moved = [part.copy() for part in exact]
                moved[k].reshape(-1)[at] += sign * 1e-6
                ends.append(loss(moved, SEEN))
            off.append(abs((ends[0] - ends[1]) / 2e-6 - own[at]))
        # Where a pixel crosses 1/255 within the step the difference jumps: not more than a few do.
        assert np.median(off) < 1e-3 * np.abs(own).mean() + 1e-6, name
        assert np.mean(np.array(off) < 1e-2 * np.abs(own).mean() + 1e-5) > 0.8, name
    off = []
    for k, step in enumerate(1e-7 * np.eye(6)):
        ends = [loss(exact, Rigid3.exp(sign * step) @ SEEN) for sign in (1.0, -1.0)]
        off.append(abs((ends[0] - ends[1]) / 2e-7 - by_pose[k]))
    assert np.median(off) < 1e-2 * np.abs(by_pose).mean()


def test_a_backend_that_does_not_exist_is_refused(rng):
    view, cloud = view_of(CAMERA, SEEN, RenderOptions()), arrays_of(cloud_of(rng, 3))
    with pytest.raises(ConfigError, match=r"backend must be one of numba, got 'cuda'"):
        render_view(cloud, view, backend="cuda")


def test_any_number_of_threads_gives_the_same(rng):
    cloud = cloud_of(rng, 500)
    results = []
    for threads in (1, 3):
        _parallel.set_num_threads(threads)
        view, arrays = view_of(CAMERA, SEEN, RenderOptions()), arrays_of(cloud)
        rendered = render_view(arrays, view)
        results.append(
            (rendered.color, *backward(arrays, view, rendered, ImageGradient(rendered.color)).cloud)
        )
    _parallel.set_num_threads(None)
    for one, other in zip(*results):
        np.testing.assert_array_equal(one, other)


def test_what_is_behind_beside_or_transparent_is_not_drawn(rng):
    cloud = cloud_of(rng, 20)
    empty = np.zeros((35, 45), np.float32)
    for other in (
        cloud.rows(np.zeros(0, np.int64)),
        GaussianCloud(
            cloud.means_in_world + 50, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh
        ),
        GaussianCloud(
            cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits - 30, cloud.sh
        ),
        GaussianCloud(
            np.full_like(cloud.means_in_world, np.nan),
            cloud.log_scales,
            cloud.quats_wxyz,
            cloud.opacity_logits,
            cloud.sh,
        ),
    ):
        found = render(other, CAMERA, SEEN)
        np.testing.assert_array_equal(found.coverage, empty)
        view = view_of(CAMERA, SEEN, RenderOptions())
        gradient = backward(arrays_of(other), view, found, ImageGradient(np.ones_like(found.color)))
        assert not any(part.any() for part in gradient.cloud) and not gradient.by_pose.any()
        assert not gradient.is_visible.any()


def test_what_does_not_fit_is_refused(rng):
    cloud = cloud_of(rng, 3)
    with pytest.raises(ConfigError, match="undistort"):
        render(cloud, Camera("RADIAL", 40, 30, [30.0, 20.0, 15.0, 0.1, 0.0]), SEEN)
    with pytest.raises(ShapeError, match="single pose"):
        render(cloud, CAMERA, Rigid3.identity(2))
    with pytest.raises(ShapeError, match="1, 4, 9 or 16"):
        GaussianCloud(
            cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh[:, :5]
        )
