"""Third stage: the mesh of all depths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from epipole.dense.volume import SparseVolume, blocks_of_depth, blocks_of_keys
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.pipelines.surfaces.cloud_stage import confirmed_depth
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.view_files import view_of_file
from epipole.runs import Run, Unit
from epipole.scene import Mesh
from epipole.scene.local_origin import local_origin
from epipole.scene.mesh_holes import close_holes
from epipole.scene.mesh_simplification import simplified_mesh
from epipole.scene.view_depth import ViewDepth

PIXELS_PER_VOXEL = 2.5
"""Side of a voxel, in pixels at the median depth of all views."""
USUAL_BLOCKS = 100_000
"""Blocks of 512 voxels at which the voxels become larger."""
MOST_PIXEL_VOXELS = 4.0
"""Largest pixel, in voxels, that the mesh uses: farther surfaces are only in the cloud."""
SAME_DEPTH, GRAY = 0.01, 160
"""Relative difference up to which a view shows a vertex, and the color of vertices that none shows."""


def mesh_of(
    inputs: SurfaceInputs,
    depths: Mapping[int, Unit],
    clouds: Mapping[int, Unit],
    config: SurfaceConfig,
    run: Run,
) -> tuple[Mesh, dict[str, Any]]:
    """The surface, and its figures.

    Raises:
        DegenerateGeometryError: there is no surface.
        ConfigError: the voxels are too small for the scene.
    """
    views = list(depths)
    voxel = config.voxel or PIXELS_PER_VOXEL * median_pixel(inputs, depths, clouds)
    keys = _blocks(inputs, depths, clouds, voxel)
    while config.voxel is None and len(keys) > USUAL_BLOCKS:
        voxel *= max(1.05, float(np.sqrt(len(keys) / USUAL_BLOCKS)))
        keys = _blocks(inputs, depths, clouds, voxel)
    if not len(keys):
        raise ConfigError("no depth is fine enough for these voxels: pass larger ones (--voxel)")
    volume, about_origin = SparseVolume(blocks_of_keys(keys), voxel), _about_origin(inputs)
    for n, k in enumerate(views):
        run.report("mesh", n, len(views) + 1)
        view = inputs.views[k]
        volume.add(
            view.pinhole, view.cam_from_world @ about_origin, _fine_depth(inputs, depths, clouds, k, voxel)
        )
    run.report("mesh", len(views), len(views) + 1)
    mesh = volume.mesh().without_small_components(config.min_component)
    del volume
    mesh, num_closed = _finished(mesh, config, run)
    vertices = about_origin.apply(mesh.vertices_in_world)
    mesh = replace(mesh, vertices_in_world=vertices, rgb=_colors(vertices, inputs, depths, clouds))
    run.report("mesh", len(views) + 1, len(views) + 1)
    facts = {
        "num_faces": len(mesh),
        "num_vertices": len(vertices),
        "voxel": voxel,
        "num_holes_closed": num_closed,
    }
    return mesh, facts | {"num_parts": mesh.num_components, "num_parts_removed": mesh.num_removed}


def _finished(mesh: Mesh, config: SurfaceConfig, run: Run) -> tuple[Mesh, int]:
    """The mesh with holes closed and simplified, as the options say; number of holes that were closed."""
    num = 0
    if config.close:
        size = float(np.linalg.norm(np.ptp(mesh.vertices_in_world, axis=0)))
        mesh, num = close_holes(mesh, config.close * size)
    if config.faces is not None and len(mesh) > config.faces:
        mesh = simplified_mesh(mesh, config.faces)
        if len(mesh) > config.faces:
            run.warnings.append(
                f"the mesh has {len(mesh):,} triangles, not {config.faces:,}: no other edge can be collapsed without changing its shape"
            )
    return mesh, num


def _colors(
    vertices: np.ndarray, inputs: SurfaceInputs, depths: Mapping[int, Unit], clouds: Mapping[int, Unit]
) -> np.ndarray:
    """(n, 3) mean color of each vertex in the views whose depth it has; gray without any."""
    total, count = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for k in depths:
        view, depth = view_of_file(inputs.views[k]), confirmed_depth(depths[k], clouds[k]).depth
        in_cam = view.cam_from_world.apply(vertices)
        pixels = view.camera.project(in_cam)
        inside = (in_cam[:, 2] > 0) & (pixels > -0.5).all(axis=1)
        inside &= (pixels < [view.camera.width - 0.5, view.camera.height - 0.5]).all(axis=1)
        rows = np.flatnonzero(inside)
        column, row = np.rint(pixels[rows]).astype(np.int64).T
        near = np.abs(depth[row, column] - in_cam[rows, 2]) <= SAME_DEPTH * in_cam[rows, 2]
        rows = rows[near]
        total[rows] += view.rgb[row[near], column[near]]
        count[rows] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.rint(np.where(count[:, None] > 0, mean, GRAY)).astype(np.uint8)


def median_pixel(inputs: SurfaceInputs, depths: Mapping[int, Unit], clouds: Mapping[int, Unit]) -> float:
    """Side of a pixel at the median depth, in units of the model; the median over all views."""
    sides = []
    for k in depths:
        depth = confirmed_depth(depths[k], clouds[k]).depth
        if (depth > 0).any():
            sides.append(float(np.nanmedian(depth)) / inputs.views[k].pinhole.focal_px)
    if not sides:
        raise ConfigError("no pixel has a depth that other images confirm, so there is no surface")
    return float(np.median(sides))


def _fine_depth(
    inputs: SurfaceInputs, depths: Mapping[int, Unit], clouds: Mapping[int, Unit], k: int, voxel: float
) -> ViewDepth:
    """Confirmed depth of a view, without pixels that are larger than the voxels."""
    found = confirmed_depth(depths[k], clouds[k])
    farthest = np.float32(MOST_PIXEL_VOXELS * voxel * inputs.views[k].pinhole.focal_px)
    near = np.where(found.depth <= farthest, found.depth, np.float32(np.nan))
    return ViewDepth(near, found.sigma, found.reason, found.num_agreeing)


def _blocks(
    inputs: SurfaceInputs, depths: Mapping[int, Unit], clouds: Mapping[int, Unit], voxel: float
) -> np.ndarray:
    """Sorted keys of all blocks near the surface."""
    keys, about_origin = np.empty(0, np.int64), _about_origin(inputs)
    for k in depths:
        view, depth = inputs.views[k], _fine_depth(inputs, depths, clouds, k, voxel)
        keys = np.union1d(
            keys, blocks_of_depth(view.pinhole, view.cam_from_world @ about_origin, depth, voxel)
        )
    return keys


def _about_origin(inputs: SurfaceInputs) -> Rigid3:
    """The shift from an origin near the cameras to the world's, which may be far away (UTM)."""
    centers = np.array([view.cam_from_world.inverse().translation for view in inputs.views])
    return Rigid3(np.eye(3), local_origin(centers))


def first_view(inputs: SurfaceInputs, mesh: Mesh) -> np.ndarray:
    """Position of the middle camera, the point of its axis at the distance of the mesh, and up; rows of (3, 3)."""
    view = inputs.views[inputs.usable[len(inputs.usable) // 2]]
    position, (_, down, ahead) = view.cam_from_world.centers(), view.cam_from_world.rotation
    distance = float(np.median((mesh.vertices_in_world - position) @ ahead))
    return np.stack([position, position + max(distance, 1e-6) * ahead, -down])
