"""Training: a scene that is known is learned, whatever the number of threads; its parts against their formulas."""

import numpy as np
import pytest
from fields_scenes import CAMERA, WHITE, scene, views

from epipole import _parallel
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.fields import _adam_kernels
from epipole.fields.config import SplatTraining
from epipole.fields.photometric import psnr
from epipole.fields.splat.gaussian_adam import GaussianAdam, Rates
from epipole.fields.splat.growing_cloud import GrowingCloud
from epipole.fields.splat.growth import FAINTER, Growth, split
from epipole.fields.splat.rasterizer import (
    Cloud,
    ImageGradient,
    RenderOptions,
    arrays_of,
    backward,
    render,
    render_view,
    view_of,
)
from epipole.fields.splat.starting import cloud_of_points, points_in_silhouettes
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import DC
from kernel_references import reference_of


def with_harmonics(rng, num_sh):
    """The arrays of the scene, with colors that depend on the direction."""
    cloud = Cloud(*(part.copy() for part in arrays_of(scene())))
    sh = np.concatenate([cloud.sh, 0.1 * rng.normal(size=(len(cloud.sh), num_sh - 1, 3))], axis=1)
    return cloud._replace(sh=sh.astype(np.float32))


@reference_of(_adam_kernels.move_gaussians)
@pytest.mark.parametrize("num_sh", [1, 9])
def test_adam_moves_what_was_seen_as_the_paper_says(rng, num_sh):
    view = view_of(CAMERA, views()[0].cam_from_world, RenderOptions())
    cloud = with_harmonics(rng, num_sh)
    rendered = render_view(cloud, view)
    gradient, is_seen, _ = backward(
        cloud, view, rendered, ImageGradient(rng.normal(size=rendered.color.shape).astype(np.float32))
    )
    adam, moved = GaussianAdam(cloud), Cloud(*(part.copy() for part in cloud))
    for part in adam.mean:
        part[:] = 0.1 * rng.normal(size=part.shape)
    for part in adam.square:
        part[:] = rng.uniform(0.1, 1, part.shape)
    mean, square = (Cloud(*(part.astype(float) for part in one)) for one in (adam.mean, adam.square))
    adam.step(moved, gradient, is_seen, Rates(1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3), 7)
    assert is_seen.sum() > 10
    for name, rate in zip(Cloud._fields, (1e-3, 2e-3, 3e-3, 4e-3, 5e-3)):
        g, start, end = (getattr(one, name).astype(float) for one in (gradient, cloud, moved))
        m, v = 0.9 * getattr(mean, name) + 0.1 * g, 0.99 * getattr(square, name) + 0.01 * g**2
        step = rate * (m / (1 - 0.9**7)) / np.sqrt(v / (1 - 0.99**7))
        if name == "sh":
            step[:, 1:] *= 6 / 5
        np.testing.assert_allclose(end[is_seen], (start - step)[is_seen], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(end[~is_seen], start[~is_seen])
        np.testing.assert_allclose(getattr(adam.mean, name)[is_seen], m[is_seen], rtol=1e-4, atol=1e-6)


def test_a_gaussian_that_is_left_out_is_not_drawn_and_others_make_up_for_it(rng):
    view = view_of(CAMERA, views()[0].cam_from_world, RenderOptions())
    cloud = with_harmonics(rng, 4)
    cloud.logits[:] = rng.uniform(-2, 1, len(cloud.logits))
    shown = np.where(rng.uniform(size=len(cloud.means)) < 0.3, 0.0, 1.25).astype(np.float32)
    found = render_view(cloud, view, shown)
    opacity = 1.25 / (1 + np.exp(-cloud.logits.astype(float)))
    left = Cloud(*(part[shown > 0] for part in cloud))
    logits = np.log(opacity / np.maximum(1 - opacity, 1e-3))[shown > 0].astype(np.float32)
    wanted = render_view(left._replace(logits=logits), view)
    can_tell = opacity[shown > 0].max() < 0.99
    assert can_tell
    np.testing.assert_allclose(found.color, wanted.color, atol=2e-3)
    assert not np.isin(np.flatnonzero(shown == 0), found.record.gaussian).any()


def trained(steps=260, threads=None, **options):
    points, rgb = points_in_silhouettes(views(), 300, seed=1)
    config = SplatTraining(max_gaussians=700, sh_degree=1, **options)
    _parallel.set_num_threads(threads)
    try:
        trainer = SplatTrainer(views()[2:], cloud_of_points(points, rgb), config, WHITE)
        for step in range(steps):
            trainer.step(step / steps)
    finally:
        _parallel.set_num_threads(None)
    return trainer


def likeness_of(cloud, view):
    return psnr(render(cloud, view.camera, view.cam_from_world).over(WHITE), view.over(WHITE))


def test_views_that_were_held_out_are_drawn():
    trainer = trained()
    first = SplatTrainer(
        views(), cloud_of_points(*points_in_silhouettes(views(), 300)), SplatTraining(), WHITE
    )
    for view in views()[:2]:
        assert likeness_of(trainer.cloud, view) > max(27.0, likeness_of(first.cloud, view) + 8.0)
    assert 300 < len(trainer) <= 700 and trainer.cloud.sh_degree == 1 and trainer.num_steps == 260


def test_any_number_of_threads_gives_the_same():
    clouds = [trained(30, threads).cloud for threads in (1, 3)]
    for one, other in zip(arrays_of(clouds[0]), arrays_of(clouds[1])):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(trained(30, seed=5).cloud.means_in_world, clouds[0].means_in_world)


def test_what_pulls_is_split_and_what_is_faint_goes():
    cloud = arrays_of(scene())
    cloud.logits[:5] = -9.0
    growth, count = Growth(len(cloud.means)), len(cloud.means)
    by_center = np.zeros((count, 2), np.float32)
    by_center[[10, 20, 3]] = (3.0, 4.0), (0.0, -1.0), (9.0, 0.0)
    growth.add(by_center, np.ones(count, bool), 64)
    rows, stays = growth.changes(cloud, count)
    assert rows.tolist() == [10, 20] and not stays[:5].any() and stays[5:].all()
    assert growth.changes(cloud, count - 4)[0].tolist() == [10]


def test_halves_lie_side_by_side_along_the_longest_axis():
    cloud = Cloud(
        *(
            np.asarray(array, np.float32)
            for array in (
                np.zeros((1, 3)),
                np.log([[0.1, 0.5, 0.2]]),
                [[1, 0, 0, 0]],
                [0.0],
                np.zeros((1, 1, 3)),
            )
        )
    )
    first, second = split(cloud, np.array([0]))
    np.testing.assert_allclose(first.means, [[0, 0.25, 0]], atol=1e-6)
    np.testing.assert_allclose(second.means, -first.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(first.log_scales), [[0.085, 0.25, 0.17]], rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-first.logits)), [0.5 * FAINTER], rtol=1e-5)


def test_gaussians_at_points_reach_to_their_neighbors(rng):
    points = np.array([[x, y, 0.0] for x in range(4) for y in range(4)], np.float64)
    cloud = cloud_of_points(points, np.full((16, 3), 255, np.uint8))
    np.testing.assert_allclose(np.exp(cloud.log_scales[5]), 1.0, rtol=1e-5)
    np.testing.assert_allclose(0.5 + DC * cloud.sh[:, 0], 1.0, atol=1e-6)
    with pytest.raises(ShapeError, match="4 or more"):
        cloud_of_points(points[:3], np.zeros((3, 3), np.uint8))


def test_points_are_drawn_within_all_silhouettes():
    points, rgb = points_in_silhouettes(views(), 200)
    assert len(points) == 200 and rgb.dtype == np.uint8
    for view in views():
        at = np.rint(view.camera.project(view.cam_from_world.apply(points))).astype(int)
        inside = (at >= 0).all(axis=1) & (at < [CAMERA.width, CAMERA.height]).all(axis=1)
        assert (view.image[at[inside, 1], at[inside, 0], 3] > 0).all()


def test_cameras_that_see_nothing_in_common_are_refused():
    ahead = [TrainingView(v.name, v.image, v.camera, Rigid3.identity()) for v in views()]
    with pytest.raises(DegenerateGeometryError, match="in the same direction"):
        points_in_silhouettes(ahead, 10)
    half = np.diag([-1.0, 1.0, -1.0])
    away = [
        TrainingView(
            v.name,
            v.image,
            v.camera,
            Rigid3(half @ v.cam_from_world.rotation, half @ v.cam_from_world.translation),
        )
        for v in views()
    ]
    with pytest.raises(DegenerateGeometryError, match="axes"):
        points_in_silhouettes(away, 10)


def test_smaller_pictures_are_means_and_their_camera_sees_the_same():
    view = views()[0]
    half = view.smaller(2)
    assert half.image.shape == (24, 32, 4)
    corner = np.array([[0.5, 0.5], [60.5, 40.5]])
    np.testing.assert_allclose(
        half.camera.unproject((corner + 0.5) / 2 - 0.5), view.camera.unproject(corner), atol=1e-9
    )
    whole = view.over(WHITE).reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half.over(WHITE), whole, atol=0.01)


def test_what_does_not_fit_is_refused():
    view, cloud = views()[0], scene()
    with pytest.raises(ConfigError, match="no image"):
        SplatTrainer([], cloud, SplatTraining(), WHITE)
    with pytest.raises(ShapeError, match="at least one Gaussian"):
        SplatTrainer([view], cloud.rows(np.zeros(0, np.int64)), SplatTraining(), WHITE)
    with pytest.raises(ShapeError, match="size"):
        TrainingView("x", view.image, Camera("PINHOLE", 60, 48, CAMERA.params), view.cam_from_world)
    with pytest.raises(ShapeError, match="3 or 4"):
        TrainingView("x", view.image[..., :2], CAMERA, view.cam_from_world)
    for wrong in ({"max_gaussians": 0}, {"sh_degree": 4}, {"ssim_weight": 1.5}, {"seed": -1}):
        with pytest.raises(ConfigError):
            SplatTraining(**wrong)


@pytest.mark.parametrize(("gone", "new"), [(0, 0), (0, 5), (3, 3), (3, 5), (5, 3), (7, 0), (12, 1)])
def test_rows_come_and_go_in_place(rng, gone, new):
    first, more = (arrays_of(scene().rows(rng.choice(60, count, replace=False))) for count in (12, new))
    fixed = GrowingCloud(first, 20)
    room = fixed.cloud.sh.base
    rows = np.sort(rng.choice(12, gone, replace=False))
    fixed.change(rows, more)
    wanted = [np.concatenate([np.delete(part, rows, axis=0), end]) for part, end in zip(first, more)]
    order, found = np.argsort(wanted[0][:, 0]), np.argsort(fixed.cloud.means[:, 0])
    for part, own in zip(fixed.cloud, wanted):
        np.testing.assert_array_equal(part[found], own[order])
    assert fixed.cloud.sh.base is room
    fixed.raise_degree(16)
    assert fixed.cloud.sh.shape[1] == 16
    np.testing.assert_array_equal(fixed.cloud.sh[found][:, : wanted[4].shape[1]], wanted[4][order])
