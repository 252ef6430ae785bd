"""One valid call of every function of `epipole.fields` that takes arrays, images, cameras or views."""

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.dense import volume
from epipole.fields import exposure, normals, photometric, point_depths, rays
from epipole.fields.config import NerfTraining, SplatTraining
from epipole.fields.nerf import hash_field, voxel_field
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.splat import rasterizer, starting
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.training_view import TrainingView
from epipole.scene import Mesh
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.view_depth import ViewDepth
from epipole.synthetic import look_at

Row = tuple[str, Callable[..., Any], dict[str, Any]]
LENS = Camera(CameraModel.PINHOLE, 32, 24, np.array([30.0, 30.0, 15.5, 11.5]))
BLACK = np.zeros(3, np.float32)


def _row(function: Callable[..., Any], /, **arguments: Any) -> Row:
    return function.__qualname__, function, arguments


@cache
def cloud() -> GaussianCloud:
    """A few Gaussians in the unit ball."""
    rng = np.random.default_rng(7)
    means, n = 0.4 * rng.normal(size=(30, 3)), 30
    arrays = (means, np.full((n, 3), -2.0), rng.normal(size=(n, 4)), np.full(n, 1.5), 2.0 * means[:, None])
    return GaussianCloud(*(np.asarray(array, np.float32) for array in arrays))


@cache
def views() -> tuple[TrainingView, ...]:
    """Small images of them, from all around."""
    out = []
    for n in range(4):
        position = look_at(2.6 * np.array([np.cos(1.6 * n), np.sin(1.6 * n), 0.3 * n - 0.4]), (0, 0, 0))
        rendered = rasterizer.render(cloud(), LENS, position)
        rgba = np.concatenate([np.clip(rendered.color, 0, 1), rendered.coverage[..., None]], axis=2)
        points = cloud().means_in_world.astype(np.float64)
        image = np.rint(255 * rgba).astype(np.uint8)
        out.append(TrainingView(f"{n}.png", image, LENS, position, np.ones((24, 32), bool), points))
    return tuple(out)


@cache
def rendering() -> rasterizer.Rendering:
    """Of the first view."""
    return rasterizer.render(cloud(), LENS, views()[0].cam_from_world)


@cache
def voxels() -> voxel_field.Voxels:
    """A block of cells."""
    cells = np.zeros((6, 5, 4), bool)
    cells[1:4, 1:3, 1:3] = True
    values = np.full((int(voxel_field.corners_of(cells).sum()), 13), 8.0, np.float32)
    return voxel_field.voxels_on(cells, np.full(3, -1.0), 0.4, 0.4, values)


@cache
def neural() -> hash_field.HashField:
    """As training begins."""
    rng, occupied = np.random.default_rng(0), np.ones((4, 4, 4), np.uint8)
    room = hash_field.Room(occupied, rays.blocks_of(occupied), np.full(3, -1.0), 0.5)
    tables = rng.uniform(-1, 1, (2, 64, 4)).astype(np.float32)
    return hash_field.HashField(room, np.array([2, 4]), tables, hash_field.new_weights(rng, 2, 8))


def calls() -> Iterator[Row]:
    """Of functions, classes and their methods."""
    for rows in (_images, _starts, _trainers, _volumes):
        yield from rows()


def _images() -> Iterator[Row]:
    rng = np.random.default_rng(1)
    both = {"image": rng.uniform(size=(9, 8, 3)).astype(np.float32)}
    both["truth"] = rng.uniform(size=(9, 8, 3)).astype(np.float32)
    view = views()[0]
    pose = {"camera": LENS, "cam_from_world": view.cam_from_world}
    yield _row(exposure.color_match, **both)
    yield _row(photometric.psnr, **both)
    yield _row(photometric.photometric_loss, **both, ssim_weight=0.3)
    yield _row(normals.normals_of, depth=np.ones((24, 32)), camera=LENS)
    yield _row(rasterizer.render, cloud=cloud(), **pose, options=rasterizer.RenderOptions())
    yield _row(rasterizer.RenderOptions, antialiased=True)
    yield _row(rasterizer.view_of, **pose, options=rasterizer.RenderOptions())
    yield _row(rendering().over, background=BLACK)
    fields = {name: getattr(view, name) for name in view.__dataclass_fields__}
    yield _row(TrainingView, **fields)
    yield _row(view.smaller, factor=2)
    yield _row(view.over, background=BLACK)
    yield _row(point_depths.point_depths, view=view)
    yield _row(exposure.Exposures, num_views=3)
    yield "Exposures.applied", lambda **given: exposure.Exposures(3).applied(**given), {
        "view": 1, "rendered": rendering(), "background": BLACK,
    }  # fmt: skip
    yield "Exposures.learn", lambda **given: exposure.Exposures(3).learn(**given), {
        "view": 1, "rendered": rendering(), "background": BLACK, "by_applied": np.ones((24, 32, 3), np.float32), "progress": 0.5,
    }  # fmt: skip
    yield _row(voxel_field.render_voxels, voxels=voxels(), **pose, background=BLACK)
    yield _row(voxel_field.gaussians_of, voxels=voxels(), most=50)
    yield _row(hash_field.render_hash, field=neural(), **pose, background=BLACK)
    yield _row(hash_field.voxels_of, field=neural(), finer=1)


def _starts() -> Iterator[Row]:
    points = np.random.default_rng(2).normal(size=(9, 3))
    given = {"views": list(views())}
    yield _row(starting.cloud_of_points, points_in_world=points, rgb=np.full((9, 3), 99, np.uint8))
    yield _row(starting.points_in_frusta, **given, count=20, seed=1)
    yield _row(starting.points_in_empty_parts, **given, points_in_world=points)
    yield _row(starting.points_in_silhouettes, **given, count=20, seed=1)
    yield _row(starting.fraction_in_view, **given, points_in_world=points)
    yield _row(starting.silhouettes_of, **given)
    silhouettes = starting.silhouettes_of(views())
    yield _row(starting.may_be_full, silhouettes=silhouettes, centers_in_world=points, radius=0.1)
    yield _row(starting.have_one_direction, **given)
    yield _row(starting.common_ball, **given)
    yield _row(starting.first_cells, **given, side=16)
    yield _row(rays.rays_of, **given)
    yield _row(rays.rays_of_camera, camera=LENS, cam_from_world=views()[0].cam_from_world)


def _trainers() -> Iterator[Row]:
    for kind in (SplatTraining, NerfTraining):
        yield _row(kind, **{name: getattr(kind(), name) for name in kind.__dataclass_fields__})
    start = {"start": cloud(), "config": SplatTraining(max_gaussians=40, sh_degree=1)}
    for trainer, more in ((SplatTrainer, start), (HashTrainer, {"seed": 1}), (VoxelTrainer, {"seed": 1})):
        made = trainer(views(), background=BLACK, **more)
        if trainer is SplatTrainer:  # the others take half a second
            yield _row(trainer, views=list(views()), background=BLACK, **more)
        yield _row(made.render, view=views()[0])
        yield _row(made.step, progress=0.1)


def _volumes() -> Iterator[Row]:
    shape, block = (24, 32), {"blocks": np.zeros((1, 3), np.int64), "voxel": 0.1}
    yield _row(volume.SparseVolume, **block)
    none = np.zeros(shape, np.uint8)
    depth = ViewDepth(np.full(shape, 2.0, np.float32), np.zeros(shape, np.float32), none, none)
    seen = {"camera": LENS, "cam_from_world": views()[0].cam_from_world, "depth": depth}
    yield "SparseVolume.add", lambda **given: volume.SparseVolume(**block).add(**given), seen
    yield _row(volume.blocks_of_depth, **seen, voxel=0.1)
    yield _row(volume.keys_within, keys=np.zeros(1, np.int64), voxel=0.1, low=np.zeros(3), high=np.ones(3))
    corners = {
        "vertices_in_world": np.eye(3),
        "faces": np.array([[0, 1, 2]]),
        "rgb": np.zeros((3, 3), np.uint8),
    }
    yield _row(Mesh, **corners)
