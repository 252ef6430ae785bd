"""What images have of their own while a field is learned: colors, places, masks, and the depths of known points."""

from dataclasses import replace

import numpy as np
import pytest
from fields_scenes import CAMERA, WHITE, scene, views

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.fields import _photometric_kernels
from epipole.fields.config import SplatTraining
from epipole.fields.exposure import IDENTITY, Exposures, color_match
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.photometric import photometric_loss, psnr
from epipole.fields.point_depths import depth_loss, point_depths
from epipole.fields.pose_steps import PoseSteps
from epipole.fields.rays import pixels_to_render, rays_of
from epipole.fields.rows_adam import RowsAdam
from epipole.fields.splat.rasterizer import (
    ImageGradient,
    Rendering,
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
from epipole.pipelines.fields.scores import scores_of
from kernel_references import reference_of


def start():
    return cloud_of_points(*points_in_silhouettes(views(), 300, seed=1))


def trained(of, steps=260, **options):
    trainer = SplatTrainer(of, start(), SplatTraining(max_gaussians=700, sh_degree=0, **options), WHITE)
    for step in range(steps):
        trainer.step(step / steps)
    return trainer


def drawing(rng, shape=(37, 29)):
    """Any colors and coverage."""
    coverage = rng.uniform(size=shape).astype(np.float32)
    color = (rng.uniform(size=(*shape, 3)) * coverage[..., None]).astype(np.float32)
    return Rendering(color, np.zeros(shape, np.float32), coverage, 0, None)


@reference_of(_photometric_kernels.map_colors, _photometric_kernels.map_colors_back)
def test_colors_are_mapped_and_the_way_back_is_the_derivative(rng):
    rendered, behind = drawing(rng), np.array([0.9, 0.2, 0.5], np.float32)
    by_applied = rng.uniform(size=rendered.color.shape).astype(np.float32)
    exposures = Exposures(2)
    exposures.maps[1] = rng.normal(size=(3, 4))
    colors, shown = exposures.maps[1].astype(float), rendered.coverage[..., None].astype(float)
    wanted = rendered.color @ colors[:, :3].T + shown * colors[:, 3] + (1 - shown) * behind
    np.testing.assert_allclose(exposures.applied(1, rendered, behind), wanted, rtol=1e-5, atol=1e-6)
    by_color, by_coverage = exposures.learn(1, rendered, behind, by_applied, 0.0)
    np.testing.assert_allclose(by_color, by_applied @ colors[:, :3], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(by_coverage, by_applied @ (colors[:, 3] - behind), rtol=1e-5, atol=1e-5)
    known = np.concatenate([rendered.color, shown], axis=2).reshape(-1, 4)
    gradient = by_applied.reshape(-1, 3).T.astype(float) @ known
    # Adam's first step has the rate's size against the derivative's sign.
    np.testing.assert_allclose(exposures.maps[1], colors - 1e-2 * np.sign(gradient), atol=1e-6)
    np.testing.assert_array_equal(exposures.maps[0], IDENTITY)


def test_colors_are_matched(rng):
    image, colors = rng.uniform(size=(9, 8, 3)).astype(np.float32), rng.normal(size=(3, 4))
    mapped = (image @ colors[:, :3].T + colors[:, 3]).astype(np.float32)
    np.testing.assert_allclose(color_match(image, mapped), colors, atol=1e-5)


def test_the_mean_of_all_maps_goes_into_the_scene(rng):
    exposures = Exposures(4)
    exposures.maps += 0.1 * rng.normal(size=(4, 3, 4)).astype(np.float32)
    before, rendered = exposures.maps.copy(), drawing(rng)
    seen = [exposures.applied(n, rendered, WHITE) for n in range(4)]
    mean = exposures.taken_mean()
    np.testing.assert_allclose(mean, before.mean(axis=0), atol=1e-6)
    color = rendered.color @ mean[:, :3].T + rendered.coverage[..., None] * mean[:, 3]
    for n in range(4):
        again = exposures.applied(n, replace(rendered, color=color.astype(np.float32)), WHITE)
        np.testing.assert_allclose(again, seen[n], atol=1e-5)


def darkened():
    """Every other image at 60 % and more blue."""
    colors = np.array([[0.6, 0, 0, 0], [0, 0.6, 0, 0], [0, 0, 0.7, 0.1]])
    out = list(views())
    for n in range(0, len(out), 2):
        image = out[n].image.copy()
        mapped = image[..., :3] @ colors[:, :3].T + 255 * colors[:, 3]
        image[..., :3] = np.rint(np.clip(mapped, 0, 255))
        out[n] = replace(out[n], image=image)
    return out


def test_exposures_are_learned():
    of = darkened()
    plain, learned = (trained(of[2:], exposure=requested) for requested in (False, True))
    # Held out: one that is dark and one that is not; neither's exposure is known.
    scores = [
        [scores_of(one.render(view), view, WHITE)["psnr_matched"] for view in of[:2]]
        for one in (plain, learned)
    ]
    assert np.mean(scores[1]) > np.mean(scores[0]) + 1.5 and min(scores[1]) > max(scores[0])


def moved(view, rng, by_rad, by):
    xi = np.concatenate([by * rng.normal(size=3), by_rad * rng.normal(size=3)])
    return replace(view, cam_from_world=Rigid3.exp(xi) @ view.cam_from_world)


def off_px(one, other):
    """Mean distance of where two places see the scene's Gaussians, in pixels."""
    points = scene().means_in_world.astype(float)
    pixels = [CAMERA.project(position.apply(points)) for position in (one, other)]
    return np.linalg.norm(pixels[0] - pixels[1], axis=1).mean()


def test_cameras_find_their_places(rng):
    truth = views()
    disturbed = [moved(view, rng, 0.01, 0.02) for view in truth]
    trainers = [trained(disturbed, 400, refine_poses=requested) for requested in (False, True)]
    before = [off_px(v.cam_from_world, t.cam_from_world) for v, t in zip(disturbed, truth)]
    assert np.mean(before) > 0.7
    scores = [np.mean([psnr(t.render(v), v.over(WHITE)) for v in t.posed_views]) for t in trainers]
    assert scores[1] > scores[0] + 4.0
    for view, seen in zip(disturbed, trainers[0].posed_views):
        assert view.cam_from_world is seen.cam_from_world


@pytest.mark.usefixtures("unchecked")
def test_a_camera_that_is_off_comes_back(rng):
    view = views()[5]
    poses = PoseSteps([moved(view, rng, 0.03, 0.05).cam_from_world], 0.5)
    before = off_px(poses.cams_from_world[0], view.cam_from_world)
    assert before > 0.8
    for step in range(400):
        seen = view_of(CAMERA, poses.cams_from_world[0], RenderOptions())
        rendered = render_view(arrays_of(scene()), seen)
        by_image = photometric_loss(rendered.over(WHITE), view.over(WHITE)).by_image
        found = backward(
            arrays_of(scene()), seen, rendered, ImageGradient(by_image, None, -(by_image @ WHITE))
        )
        poses.move(0, found.by_pose, step / 400)
    assert off_px(poses.cams_from_world[0], view.cam_from_world) < 0.1 * before


def test_a_row_moves_as_adam_says():
    adam, wanted = RowsAdam(3, 2, (0.1, 0.01)), []
    gradients = np.array([[1.0, -2.0], [0.5, 4.0]])
    mean, square = np.zeros(2), np.zeros(2)
    for t, g in enumerate(gradients, 1):
        mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g**2
        wanted.append(-0.1 * (mean / (1 - 0.9**t)) / np.sqrt(square / (1 - 0.99**t)))
        np.testing.assert_allclose(adam.step(1, g, 0.0), wanted[-1], rtol=1e-12)
    assert adam.count.tolist() == [0, 2, 0]
    np.testing.assert_allclose(adam.step(0, gradients[0], 1.0), [-0.01, 0.01], rtol=1e-12)


@pytest.mark.usefixtures("small_hash")
def test_what_is_masked_is_neither_learned_nor_compared(rng):
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    mask[10:30, 20:44] = False
    plain = [replace(view, used_mask=mask) for view in views(with_alpha=False)]
    spoilt = []
    for view in plain:
        image = view.image.copy()
        image[~mask] = rng.integers(0, 256, (int((~mask).sum()), 3))
        spoilt.append(replace(view, image=image))
    clouds = [trained(of, 20).cloud for of in (plain, spoilt)]
    np.testing.assert_array_equal(clouds[0].sh, clouds[1].sh)
    np.testing.assert_array_equal(clouds[0].means_in_world, clouds[1].means_in_world)
    rendered = plain[0].over(WHITE).copy()
    rendered[0, 0] = 0.0
    scores = [scores_of(rendered, view, WHITE) for view in (plain[0], spoilt[0])]
    assert scores[0] == scores[1] and 20 < scores[0]["psnr"] < 60
    chosen = pixels_to_render(rays_of(spoilt[:3]), 5000, np.random.default_rng(1))
    assert mask.reshape(-1)[chosen % mask.size].all() and len(np.unique(chosen // mask.size)) == 3
    fields = [HashTrainer(of, WHITE) for of in (plain, spoilt)]
    assert fields[0].step(0.0) == fields[1].step(0.0)


def test_masks_must_fit_and_leave_something():
    view = views()[0]
    nothing = np.zeros(view.image.shape[:2], bool)
    with pytest.raises(ConfigError, match="exclude all pixels"):
        rays_of([replace(view, used_mask=nothing)])
    assert np.isnan(scores_of(view.over(WHITE), replace(view, used_mask=nothing), WHITE)["psnr"])
    mask = np.ones(view.image.shape[:2], bool)
    mask[5, 7] = False
    smaller = replace(view, used_mask=mask).smaller(2).used_mask
    assert np.argwhere(~smaller).tolist() == [[2, 3]]


def test_depths_of_points_are_told_where_a_picture_shows_them():
    camera = Camera("PINHOLE", 8, 6, [10.0, 10.0, 3.4, 2.4])
    points = np.array(
        [[0, 0, 2.0], [0.001, 0, 3.0], [1, 0, 4.0], [0, 0, -1.0], [9, 0, 1.0], [np.nan, 0, 1.0]]
    )
    view = TrainingView("a", np.zeros((6, 8, 3), np.uint8), camera, Rigid3.identity(), points_in_world=points)
    known = point_depths(view)
    assert known.depth.tolist() == [2.0, 4.0]  # the nearer of two in one pixel
    assert list(zip(known.row, known.column)) == [(2, 3), (2, 6)]
    assert not len(point_depths(replace(view, points_in_world=None)).depth)


def test_the_loss_of_depths_and_its_derivative():
    view = views()[0]
    rendered = render(scene(), CAMERA, view.cam_from_world)
    known = point_depths(replace(view, points_in_world=scene().means_in_world.astype(float)))
    assert len(known.depth) > 20
    found = depth_loss(rendered, known, 0.3)
    step = 1e-3
    for part, by in (("depth", found.by_depth), ("coverage", found.by_coverage)):
        assert (by != 0).any()
        for row, column in np.argwhere(by != 0)[:6]:
            losses = []
            for trajectory in (step, -step):
                other = getattr(rendered, part).copy()
                other[row, column] *= 1 + trajectory
                losses.append(depth_loss(replace(rendered, **{part: other}), known, 0.3).loss)
            numeric = (losses[0] - losses[1]) / (2 * step * getattr(rendered, part)[row, column])
            assert abs(numeric - by[row, column]) < 1e-3 * abs(by[row, column]) + 1e-6
    assert depth_loss(rendered, known, 0.0).loss == 0.0
    nothing = replace(rendered, coverage=np.zeros_like(rendered.coverage))
    assert depth_loss(nothing, known, 1.0).loss == 0.0


def test_depths_hold_gaussians_at_their_points():
    """One image of a plain wall cannot tell how far it is."""
    camera, gray = Camera("PINHOLE", 32, 24, [30.0, 30.0, 15.5, 11.5]), np.full((24, 32, 3), 128, np.uint8)
    grid = np.stack(
        np.meshgrid(np.linspace(-1.6, 1.6, 16), np.linspace(-1.2, 1.2, 12), [3.0]), axis=-1
    ).reshape(-1, 3)
    view = TrainingView("a", gray, camera, Rigid3.identity(), points_in_world=grid)
    first = cloud_of_points(grid * 0.99, np.full(grid.shape, 128, np.uint8))
    depths = []
    for weight in (0.0, 1.0):
        trainer = SplatTrainer(
            [view, view], first, SplatTraining(max_gaussians=300, depth_weight=weight, sh_degree=0), WHITE
        )
        for step in range(300):
            trainer.step(step / 300)
        rendered = render(trainer.cloud, camera, view.cam_from_world)
        shown = rendered.coverage > 0.5
        depths.append(float(np.median(rendered.depth[shown] / rendered.coverage[shown])))
    assert abs(depths[1] - 3.0) < 0.01 < 0.02 < abs(depths[0] - 3.0)


def test_what_views_have_of_their_own_is_in_the_state():
    of, options = darkened()[:6], SplatTraining(max_gaussians=500, exposure=True, refine_poses=True)
    whole, first, second = (SplatTrainer(of, start(), options, WHITE) for _ in range(3))
    for step in range(40):
        whole.step(step / 40)
    for step in range(23):
        first.step(step / 40)
    second.restore({name: part.copy() for name, part in first.state().items()})
    for step in range(23, 40):
        second.step(step / 40)
    for name, part in whole.state().items():
        np.testing.assert_array_equal(part, second.state()[name], err_msg=name)
    assert isinstance(second._poses, PoseSteps) and not np.array_equal(second._exposures.maps[0], IDENTITY)
