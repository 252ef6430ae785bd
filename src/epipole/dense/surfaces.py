"""Surfaces from images in memory: one function for each step of `epipole surface`.

Images are undistorted (`epipole.undistort`), their cameras pinholes. `epipole surface` does the same with files, in bounded memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from epipole._checks import Declared, check_count, checked
from epipole.cameras import Camera
from epipole.dense.depth import view_depth
from epipole.dense.frustum_sources import select_by_frusta
from epipole.dense.fusion import DensePoints, fuse_view
from epipole.dense.texturing.texture import texture_mesh
from epipole.dense.texturing.texture_view import TextureView
from epipole.dense.view import DenseView
from epipole.dense.volume_building import DepthImage, build_volume
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Mesh
from epipole.scene.local_origin import local_origin
from epipole.scene.textured_mesh import TexturedMesh
from epipole.scene.view_depth import ViewDepth

Images = Sequence[UInt8[np.ndarray, "h w 3"]]


@dataclass(frozen=True, slots=True, eq=False)
class FusedDepths(Declared):
    """A cloud, and the depth of each view where others confirm it."""

    points: DensePoints
    depths: tuple[ViewDepth, ...]


@checked
def estimate_depth(
    images: Images,
    cameras: Sequence[Camera],
    cams_from_world: Rigid3,
    depths: tuple[float, float] | Float64[np.ndarray, "n 2"],
    *,
    num_sources: int = 5,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> list[ViewDepth]:
    """Depth of each view from the others that see the same part of the scene at the best angles.

    Args:
        images: n RGB images.
        cameras: their n pinhole cameras.
        cams_from_world: their n poses.
        depths: smallest and largest depth of the scene, for all views or for each.
        num_sources: largest number of other views that each is matched with.
        masks: pixels that show the scene.

    Returns:
        The depth of each view; one without overlap has no known pixel.

    Raises:
        ShapeError: the numbers of images, cameras and poses differ, or an image does not have its camera's size.
        ConfigError: a camera has distortion, or a range of depths is not increasing and positive.
    """
    check_count(num_sources, "num_sources")
    views = _views(images, cameras, cams_from_world, masks)
    given = np.asarray(depths, np.float64)
    if given.shape not in ((2,), (len(views), 2)):
        raise ShapeError(
            f"depths must be a pair, or one for each of the {len(views)} images, got {given.shape}"
        )
    ranges = np.broadcast_to(given, (len(views), 2))
    if not ((ranges[:, 0] > 0) & (ranges[:, 0] < ranges[:, 1]) & np.isfinite(ranges[:, 1])).all():
        raise ConfigError("depths must be two increasing positive numbers")
    sources = select_by_frusta(views, ranges, num_sources)
    return [
        view_depth(view, [views[j] for j in row.tolist()], (float(near), float(far)))
        for view, row, (near, far) in zip(views, sources, ranges)
    ]


@checked
def fuse_depths(
    images: Images, cameras: Sequence[Camera], cams_from_world: Rigid3, depths: Sequence[ViewDepth]
) -> FusedDepths:
    """Points that at least two views agree on, each once; see `fuse_view`.

    Raises:
        ShapeError: the numbers of images, cameras, poses and depths differ, or their sizes.
        ConfigError: a camera has distortion.
    """
    views = _views(images, cameras, cams_from_world, None)
    _check_number(depths, "depths", len(views))
    pairs, points, confirmed = list(zip(views, depths)), list[DensePoints](), list[ViewDepth]()
    for k, (view, depth) in enumerate(pairs):
        found = fuse_view(view, depth, pairs[:k] + pairs[k + 1 :])
        nan = np.float32(np.nan)
        points.append(found.points)
        confirmed.append(
            replace(
                depth,
                depth=np.where(found.confirmed, depth.depth, nan),
                sigma=np.where(found.confirmed, depth.sigma, nan),
            )
        )
    return FusedDepths(DensePoints.joined(points), tuple(confirmed))


@checked
def mesh_depths(
    cameras: Sequence[Camera],
    cams_from_world: Rigid3,
    depths: Sequence[ViewDepth],
    voxel: float | None = None,
) -> Mesh:
    """Surface of the depths of all views, which should be confirmed (`fuse_depths`); see `SparseVolume`.

    Args:
        cameras: n pinhole cameras.
        cams_from_world: their poses.
        depths: of each view.
        voxel: side of a voxel in units of the model; None: 2.5 pixels at the median depth.

    Raises:
        ShapeError: the numbers of cameras, poses and depths differ, or their sizes.
        DegenerateGeometryError: no pixel has a depth, or there is no surface.
        ConfigError: the voxels are too small for the scene, or a camera has distortion.
    """
    _check_number(depths, "depths", len(cameras))
    _check_poses(cams_from_world, len(cameras))
    about_origin = Rigid3(np.eye(3), local_origin(cams_from_world.centers()))
    images = [
        DepthImage(camera, cams_from_world[k] @ about_origin, partial(_same, depth))
        for k, (camera, depth) in enumerate(zip(cameras, depths))
    ]
    found = build_volume(images, voxel).mesh()
    return replace(found, vertices_in_world=about_origin.apply(found.vertices_in_world))


def _same(depth: ViewDepth) -> ViewDepth:
    return depth


@checked
def texture_from_images(
    mesh: Mesh,
    images: Images,
    cameras: Sequence[Camera],
    cams_from_world: Rigid3,
    *,
    side_px: int = 4096,
) -> TexturedMesh:
    """Texture of a mesh from images in memory; see `texture_mesh`.

    Raises:
        ShapeError: the numbers of images, cameras and poses differ, or their sizes.
        ConfigError: a camera has distortion; side_px is out of range, or too small for the mesh.
        DegenerateGeometryError: no view shows the mesh.
    """
    views = _views(images, cameras, cams_from_world, None)
    return texture_mesh(mesh, [_in_memory(view) for view in views], side_px)


def _in_memory(view: DenseView) -> TextureView:
    return TextureView(
        view.name, view.camera, view.cam_from_world, view.camera, lambda: view, lambda: view.rgb
    )


def _views(
    images: Images,
    cameras: Sequence[Camera],
    cams_from_world: Rigid3,
    masks: Sequence[np.ndarray] | None,
) -> list[DenseView]:
    _check_number(cameras, "cameras", len(images))
    _check_poses(cams_from_world, len(images))
    if masks is not None:
        _check_number(masks, "masks", len(images))
    return [
        DenseView(f"{k:06d}", image, camera, cams_from_world[k], None if masks is None else masks[k])
        for k, (image, camera) in enumerate(zip(images, cameras))
    ]


def _check_number(values: Sequence[object], name: str, wanted: int) -> None:
    if len(values) != wanted:
        raise ShapeError(f"{name} must have {wanted} entries, one for each image, got {len(values)}")


def _check_poses(cams_from_world: Rigid3, wanted: int) -> None:
    if cams_from_world.batch_shape() != (wanted,):
        raise ShapeError(
            f"cams_from_world must have {wanted} poses, one for each image, got {cams_from_world.batch_shape()}"
        )
