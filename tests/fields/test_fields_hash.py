"""A neural field: its images and derivatives against the equations, known volumes, and training."""

import numpy as np
import pytest
from fields_scenes import WHITE, views
from plain_hash import OVER, SHIFT, STEP, color_of, density_of, features_of, plain_ray
from plain_rasterizer import basis
from test_fields_voxels import direction_of

from epipole import _parallel
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.fields import _adam_kernels
from epipole.fields.nerf import _hash_kernels, hash_trainer
from epipole.fields.nerf.hash_field import HashField, Room, new_weights, query_density, render_hash, voxels_of
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.nerf.voxel_field import render_voxels
from epipole.fields.photometric import psnr
from epipole.fields.rays import blocks_of
from epipole.fields.splat import _projection_kernels
from epipole.fields.training_view import TrainingView
from epipole.synthetic import look_at
from kernel_references import reference_of

SEEN = look_at((0.4, -3.0, 0.5), (0, 0, 0))
SMALL = Camera("PINHOLE", 9, 7, [12.0, 12.0, 4.0, 3.0])
CELLS = np.array([4, 7, 13])

pytestmark = pytest.mark.usefixtures("small_hash", "unchecked_module")


def field_of(rng, holes=0.0, shape=(12, 10, 14)):
    """Three levels, the first read directly, the others hashed."""
    occupied = rng.uniform(size=shape) >= holes
    room = Room(occupied.astype(np.uint8), blocks_of(occupied), np.array([-1.0, -0.9, -1.1]), 2.0 / 12)
    tables = rng.normal(0.0, 1.0, (3, 128, 4)).astype(np.float32)
    weights = new_weights(rng, 3, 24)
    weights[1][:, 0] += 0.5
    return HashField(room, CELLS, tables, weights)


def exact_of(field):
    return field.tables.astype(float), [one.astype(float) for one in field.weights]


@reference_of(_projection_kernels.harmonics)
@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_harmonics_are_those_of_the_equations(rng, count):
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    found = np.zeros(16)
    _projection_kernels.harmonics(*direction, count, found)
    np.testing.assert_allclose(found[:count], basis(direction[None], 16)[0][:count], atol=1e-12)
    assert not found[count:].any()


@reference_of(_hash_kernels.encode)
def test_features_are_those_of_the_equations(rng):
    field = field_of(rng)
    tables, weights = exact_of(field)
    positions = np.concatenate([rng.random((50, 4)), [[0.0, 0.0, 0.0, 0.0]]]).astype(np.float32)
    features, _, said = query_density(field, positions)
    for n, position in enumerate(positions[:, :3].astype(float)):
        np.testing.assert_allclose(features[n], features_of(tables, CELLS, position), atol=2e-5)
        np.testing.assert_allclose(said[n], density_of(tables, CELLS, weights, position), atol=1e-4)


@reference_of(_hash_kernels.sample_rays, _hash_kernels.weigh, _hash_kernels.join, _hash_kernels.compose)
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_a_picture_is_that_of_the_equations(rng, holes):
    field, background = field_of(rng, holes), np.array([0.2, 0.9, 0.4])
    image, depth, asked_at = render_hash(field, SMALL, SEEN, background)
    center, off = SEEN.inverse().translation, np.zeros((7, 9))
    for row, column in np.ndindex(7, 9):
        direction = direction_of(SMALL, SEEN, column, row)
        wanted = plain_ray(*exact_of(field), field, center, direction, 0.5, background)
        away = abs(depth[row, column] - field.room.size * wanted[1])
        off[row, column] = max(np.abs(image[row, column] - wanted[0]).max(), away)
    # A sample on a cell's face may fall into either cell where one of them is empty.
    assert np.percentile(off, 90) < 5e-4 and off.max() < (3 * OVER if holes == 0.0 else 0.2)
    assert asked_at > 7 * 9


def test_a_uniform_volume_lets_through_what_its_length_says(rng):
    field = field_of(rng, shape=(12, 12, 12))
    field.weights[0][:], field.weights[1][:] = 0.0, 0.0
    straight = look_at((0.0, -3.0, 0.0), (0, 0, 0))
    one = Camera("PINHOLE", 1, 1, [10.0, 10.0, 0.0, 0.0])
    black, white = (render_hash(field, one, straight, np.full(3, k))[0][0, 0] for k in (0.0, 1.0))
    np.testing.assert_allclose(np.log(white - black), -np.exp(SHIFT) * 12, atol=np.exp(SHIFT) * STEP)


@reference_of(_hash_kernels.compose_back, _hash_kernels.limit_change, _hash_kernels.spread)
def test_derivatives_are_those_of_differences(rng):
    background, position = np.array([0.3, 0.1, 0.8]), look_at((0.4, -3.0, -0.3), (0, 0, 0))
    image = rng.integers(0, 256, (7, 9, 4)).astype(np.uint8)
    trainer = HashTrainer([TrainingView("a", image, SMALL, position), *views()[:4]], background)
    field = trainer.field = field_of(rng, 0.4, (12, 12, 12))
    chosen, first = np.arange(26, 38), rng.random(12, np.float32)
    part = trainer._marched(chosen, first - np.float32(1.0), 12)
    by_tables = np.zeros_like(field.tables)
    for level in range(len(CELLS)):
        _hash_kernels.spread(part.positions, CELLS, level, part.by_features, by_tables[level])
    wanted = image.reshape(-1, 4)[chosen] / 255.0
    wanted = wanted[:, :3] * wanted[:, 3:] + (1 - wanted[:, 3:]) * background
    tables, weights = exact_of(field)
    center = position.inverse().translation

    def loss():
        total = 0.0
        for n, pixel in enumerate(chosen.tolist()):
            direction = direction_of(SMALL, position, pixel % 9, pixel // 9)
            seen = plain_ray(tables, weights, field, center, direction, float(first[n]), background)[0]
            total += ((seen - wanted[n]) ** 2).sum()
        return total

    assert part.error == pytest.approx(loss(), rel=1e-3) and part.samples > 100
    for gradient, exact in zip([by_tables, *part.by_weights], [tables, *weights]):
        scale = float(np.abs(gradient).max())
        largest = np.argsort(-np.abs(gradient).reshape(-1))[: max(20, gradient.size // 10)]
        for at in rng.choice(largest, 2, replace=False).tolist():
            where, ends = np.unravel_index(at, exact.shape), []
            before = exact[where]
            for step in (1e-5, -1e-5):
                exact[where] = before + step
                ends.append(loss() / 36)
            exact[where] = before
            slope = (ends[0] - ends[1]) / 2e-5
            assert gradient[where] == pytest.approx(slope, rel=2e-2, abs=3e-3 * scale)


@reference_of(_adam_kernels.move_touched)
def test_steps_are_adams(rng):
    values, gradient = rng.normal(size=(2, 20)).astype(np.float32)
    gradient[3] = 0.0
    mean, square = np.zeros(20, np.float32), np.zeros(20, np.float32)
    moved, by = values.copy(), gradient.copy()
    rates = np.float32(0.01), np.ones(2, np.float32)
    _adam_kernels.move_touched(moved, by, mean, square, *rates)
    np.testing.assert_allclose(values - moved, 0.01 * np.sign(gradient), atol=1e-6)
    _adam_kernels.move_touched(moved, 2 * gradient, mean, square, *rates)
    first, second = 0.9 * 0.1 * gradient + 0.1 * 2 * gradient, (0.99 + 4) * 0.01 * gradient**2
    wanted = np.divide(first, np.sqrt(second), out=np.zeros(20), where=second > 0)
    np.testing.assert_allclose(values - moved, 0.01 * (np.sign(gradient) + wanted), atol=1e-6)
    assert not by.any()


def trained(steps, threads=None, seed=0):
    _parallel.set_num_threads(threads)
    try:
        trainer = HashTrainer(views()[2:], WHITE, seed)
        for step in range(steps):
            trainer.step(step / steps)
    finally:
        _parallel.set_num_threads(None)
    return trainer


@pytest.fixture(scope="module")
def learned():
    return trained(100)


def test_views_that_were_held_out_are_drawn(learned):
    for view in views()[:2]:
        blank = psnr(np.ones_like(view.over(WHITE)), view.over(WHITE))
        assert psnr(learned.render(view), view.over(WHITE)) > max(23.0, blank + 8.0)
    assert learned.num_samples > 1000 and len(learned) > learned.field.tables.size


def test_what_is_empty_is_left_out(learned):
    before = HashTrainer(views()[2:], WHITE).field.room.occupied
    assert learned.field.room.occupied.sum() < 0.8 * before.sum()
    assert not (learned.field.room.occupied & ~before.astype(bool)).any()


def test_a_grid_made_of_it_looks_like_it(learned):
    view = views()[0]
    grid = voxels_of(learned.field)
    rendered, _, _ = render_voxels(grid, view.camera, view.cam_from_world, WHITE)
    assert psnr(rendered, learned.render(view)) > 26.0


def test_a_color_without_direction_is_kept_in_a_grid(rng):
    field = field_of(rng)
    field.weights[2][16:] = 0.0
    field.weights[1][:, 0] = 0.0
    grid = voxels_of(field)
    said = query_density(field, np.full((1, 4), 0.5, np.float32))[2][0]
    row = grid.values[grid.row_of[14, 14, 14]]
    wanted = color_of(exact_of(field)[1], said.astype(float), np.array([0.0, 0.6, 0.8]))
    np.testing.assert_allclose(0.5 + 0.28209479 * row[1:4], wanted, atol=1e-4)
    np.testing.assert_allclose(row[4:13], 0.0, atol=1e-5)


def test_any_number_of_threads_gives_the_same():
    one, other = trained(6, 1), trained(6, 3)
    np.testing.assert_array_equal(one.field.tables, other.field.tables)
    for a, b in zip(one.field.weights, other.field.weights):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.field.tables, trained(6, seed=3).field.tables)


def test_rays_without_room_are_left_out(monkeypatch):
    monkeypatch.setattr(hash_trainer, "SAMPLES", 8)
    trainer = HashTrainer(views()[2:], WHITE)
    assert np.isfinite(trainer.step(0.0)) and trainer.num_samples <= 8 * 4 * 8


def test_what_cannot_be_trained_is_refused():
    with pytest.raises(ConfigError, match="no image"):
        HashTrainer([], WHITE)
    away = [TrainingView(v.name, np.zeros_like(v.image), v.camera, v.cam_from_world) for v in views()]
    with pytest.raises(DegenerateGeometryError, match="no common volume"):
        HashTrainer(away, WHITE)
