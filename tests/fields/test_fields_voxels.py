"""A grid of densities and colors: its images and derivatives against the equations, known volumes, and training."""

import numpy as np
import pytest
from fields_scenes import CAMERA, WHITE, scene, views
from plain_voxels import SHIFT, STEP, plain_ray

from epipole import _parallel
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.fields.nerf import _voxel_kernels, voxel_trainer
from epipole.fields.nerf.voxel_field import corners_of, march_work, render_voxels, voxels_on
from epipole.fields.nerf.voxel_trainer import GridAdam, VoxelTrainer
from epipole.fields.photometric import psnr
from epipole.fields.rays import rays_of
from epipole.fields.splat._simd_kernels import ROW
from epipole.fields.splat.starting import may_be_full, silhouettes_of
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import DC
from epipole.synthetic import look_at
from kernel_references import reference_of
from whole import in_whole_run

SEEN = look_at((0.4, -3.0, 0.5), (0, 0, 0))
SMALL = Camera("PINHOLE", 9, 7, [12.0, 12.0, 4.0, 3.0])
LOW, SIZE = np.array([-1.0, -1.0, -1.0]), 2.0 / 12


def grid(rng, shape=(12, 12, 12), holes=0.0):
    """Densities from thin to dense, and colors that depend on the direction."""
    voxels = voxels_on(rng.uniform(size=shape) >= holes, LOW, SIZE, SIZE)
    voxels.values[:, 0] = rng.uniform(0.0, 6.0, len(voxels.values))
    voxels.values[:, 1:4] = rng.uniform(-1.0, 1.5, (len(voxels.values), 3))
    voxels.values[:, 4:13] = rng.normal(0.0, 0.3, (len(voxels.values), 9))
    return voxels


def direction_of(camera, position, column, row):
    at = np.array(
        [(column - camera.params[2]) / camera.params[0], (row - camera.params[3]) / camera.params[1], 1]
    )
    return position.rotation.T @ (at / np.linalg.norm(at))


@reference_of(_voxel_kernels.render_pixels)
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_a_picture_is_that_of_the_equations(rng, holes):
    voxels, background = grid(rng, (12, 10, 14), holes), np.array([0.2, 0.9, 0.4])
    image, depth, _ = render_voxels(voxels, SMALL, SEEN, background)
    center, exact = SEEN.inverse().translation, voxels.values.astype(float)
    off = np.zeros((7, 9))
    for row, column in np.ndindex(7, 9):
        wanted = plain_ray(exact, voxels, center, direction_of(SMALL, SEEN, column, row), 0.5, background)
        off[row, column] = max(
            np.abs(image[row, column] - wanted[0]).max(), abs(depth[row, column] - SIZE * wanted[1])
        )
    # A sample on a cell's face may fall into either cell where one of them is empty.
    assert np.percentile(off, 90) < 2e-4 and off.max() < (2e-3 if holes == 0.0 else 0.2)


def test_light_is_neither_made_nor_lost(rng):
    voxels = grid(rng)
    voxels.values[:, 1:] = 0.0
    voxels.values[:, 1:4] = 0.5 / DC  # white
    image, _, _ = render_voxels(voxels, CAMERA, SEEN, np.ones(3))
    np.testing.assert_allclose(image, 1.0, atol=2e-5)


@pytest.mark.parametrize("raw", [1.0, 2.5, 4.0])
def test_a_uniform_volume_lets_through_what_its_length_says(raw):
    voxels = voxels_on(np.ones((12, 12, 12), bool), LOW, SIZE, SIZE)
    voxels.values[:, 0] = raw
    straight = look_at((0.0, -3.0, 0.0), (0, 0, 0))
    image, _, _ = render_voxels(voxels, Camera("PINHOLE", 1, 1, [10.0, 10.0, 0.0, 0.0]), straight, np.ones(3))
    sigma = np.logaddexp(0, raw + SHIFT)
    through = 2 * (image[0, 0, 0] - 0.5)  # gray before white
    assert np.log(through) == pytest.approx(-sigma * 12, abs=sigma * STEP)


@reference_of(_voxel_kernels.learn_rays, _voxel_kernels.move_planes)
def test_derivatives_are_those_of_differences(rng):
    voxels = grid(rng, (6, 6, 6))
    position = look_at((0.4, -4.0, -0.3), (-0.5, -0.5, -0.5))
    image = rng.integers(0, 256, (7, 9, 4)).astype(np.uint8)
    rays = rays_of([TrainingView("a", image, SMALL, position)])
    background, chosen = np.array([0.3, 0.1, 0.8]), np.arange(20, 44)
    first = rng.random(24, np.float32)
    records, cells = np.empty((4000, _voxel_kernels.RECORD), np.float32), np.empty(4000, np.int64)
    found, error, samples = _voxel_kernels.learn_rays(
        *(rays, chosen, first, voxels, background.astype(np.float32), np.float32(1.0)),
        *(0, 24, records, cells, march_work()),
    )
    assert 0 < found <= samples
    center = position.inverse().translation
    wanted = image.reshape(-1, 4)[chosen] / 255.0
    wanted = wanted[:, :3] * wanted[:, 3:] + (1 - wanted[:, 3:]) * background

    def loss(values):
        total = 0.0
        for n, pixel in enumerate(chosen.tolist()):
            direction = direction_of(SMALL, position, pixel % 9, pixel // 9)
            color = plain_ray(values, voxels, center, direction, float(first[n]), background)[0]
            total += ((color - wanted[n]) ** 2).sum()
        return total

    exact = voxels.values.astype(float)
    assert error == pytest.approx(loss(exact), rel=1e-4)
    adam = GridAdam(
        *(np.zeros(exact.size, np.float32) for _ in range(3)),
        np.zeros(len(exact), np.uint8),
        np.zeros(ROW, np.float32),
    )
    order = np.argsort(cells[:found], kind="stable")
    start = np.searchsorted(cells[order] // 49, np.arange(8))
    rows_at = np.arange(8) * 49
    _voxel_kernels.move_planes(
        *(voxels, records, cells, order, start, rows_at, 0, 7, adam, np.zeros(ROW, np.float32))
    )
    gradient = adam.mean.reshape(-1, ROW).astype(float) / 0.1
    assert not adam.gradient.any() and not adam.touched.any() and not gradient[:, 13:].any()
    scale = np.abs(gradient).max()
    largest = np.argsort(-np.abs(gradient[:, :13]).reshape(-1))[:400]
    for flat in rng.choice(largest, 25, replace=False).tolist():
        row, channel = divmod(flat, 13)
        ends = []
        for step in (1e-5, -1e-5):
            moved = exact.copy()
            moved[row, channel] += step
            ends.append(loss(moved))
        assert gradient[row, channel] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=5e-3, abs=1e-4 * scale)


def test_cells_and_their_corners(rng):
    cells = rng.uniform(size=(5, 6, 7)) < 0.4
    corners = corners_of(cells)
    beside = np.zeros_like(corners)
    for position in np.argwhere(cells):
        beside[tuple(slice(k, k + 2) for k in position)] = True
    np.testing.assert_array_equal(corners, beside)


def test_silhouettes_leave_what_is_in_all_of_them():
    inside = scene().means_in_world[:20].astype(float)
    around = 1.3 * inside / np.linalg.norm(inside, axis=1, keepdims=True)
    assert (
        may_be_full(silhouettes_of(views()), inside, 0.05).all()
        and not may_be_full(silhouettes_of(views()), around, 0.05).any()
    )
    assert may_be_full(silhouettes_of(views(with_alpha=False)), around, 0.05).all()


def trained(steps, threads=None, seed=0):
    _parallel.set_num_threads(threads)
    try:
        trainer = VoxelTrainer(views()[2:], WHITE, seed)
        for step in range(steps):
            trainer.step(step / steps)
    finally:
        _parallel.set_num_threads(None)
    return trainer


@in_whole_run
def test_views_that_were_held_out_are_drawn():
    trainer = trained(60)
    for view in views()[:2]:
        blank = psnr(np.ones_like(view.over(WHITE)), view.over(WHITE))
        assert psnr(trainer.render(view), view.over(WHITE)) > max(23.0, blank + 8.0)
    # Its voxels are narrower than a pixel: finer ones are not made.
    assert max(trainer.field.occupied.shape) == 64 and trainer.num_samples > 1000


def test_finer_voxels_show_the_same(monkeypatch):
    monkeypatch.setattr(voxel_trainer, "SIZES", ((0.0, 32), (0.3, 64), (0.6, 128)))
    trainer = VoxelTrainer(views()[2:], WHITE)
    for step in range(60):
        trainer.step(0.29 * step / 60)
    before, occupied = trainer.render(views()[0]), trainer.field.occupied.mean()
    trainer.step(0.3)
    assert max(trainer.field.occupied.shape) == 64 and trainer.field.occupied.mean() < occupied
    assert np.abs(trainer.render(views()[0]) - before).mean() < 0.02
    trainer.step(0.6)
    assert max(trainer.field.occupied.shape) == 64  # its voxels are narrower than a pixel


def test_any_number_of_threads_gives_the_same():
    one, other = trained(4, 1), trained(4, 3)
    np.testing.assert_array_equal(one.field.values, other.field.values)
    few = trained(4, seed=3)
    assert len(few.field.values) > 0  # too few steps to see anything
    assert not np.array_equal(one.field.values, few.field.values)


def test_what_cannot_be_trained_is_refused():
    with pytest.raises(ConfigError, match="no image"):
        VoxelTrainer([], WHITE)
    away = [TrainingView(v.name, np.zeros_like(v.image), v.camera, v.cam_from_world) for v in views()]
    with pytest.raises(DegenerateGeometryError, match="no common volume"):
        VoxelTrainer(away, WHITE)
    side = Rigid3.identity()
    alone = [
        TrainingView("a", views()[0].image, CAMERA, side),
        TrainingView("b", views()[0].image, CAMERA, side),
    ]
    with pytest.raises(DegenerateGeometryError, match="look in the same direction"):
        VoxelTrainer(alone, WHITE)
