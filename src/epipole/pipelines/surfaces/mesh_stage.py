"""Third stage: the mesh of all depths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from epipole.dense.volume_building import ColorImage, DepthImage, build_volume, vertex_colors
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
    about_origin = _about_origin(inputs)
    images = depth_images(inputs, depths, clouds, about_origin)
    volume = build_volume(images, config.voxel, lambda done, total: run.report("mesh", done, total + 1))
    voxel = volume.voxel
    mesh = volume.mesh().without_small_components(config.min_component)
    del volume
    mesh, num_closed = _finished(mesh, config, run)
    vertices = about_origin.apply(mesh.vertices_in_world)
    mesh = replace(mesh, vertices_in_world=vertices, rgb=_colors(vertices, inputs, depths, clouds))
    run.report("mesh", len(images) + 1, len(images) + 1)
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
    views = ((view_of_file(inputs.views[k]), confirmed_depth(depths[k], clouds[k]).depth) for k in depths)
    return vertex_colors(
        vertices, (ColorImage(view.camera, view.cam_from_world, view.rgb, depth) for view, depth in views)
    )


def depth_images(
    inputs: SurfaceInputs,
    depths: Mapping[int, Unit],
    clouds: Mapping[int, Unit],
    world_from_origin: Rigid3 | None = None,
) -> list[DepthImage]:
    """Confirmed depth of each view, with poses relative to an origin (None: the world's)."""
    moved = Rigid3.identity() if world_from_origin is None else world_from_origin
    return [
        DepthImage(
            inputs.views[k].pinhole,
            inputs.views[k].cam_from_world @ moved,
            partial(confirmed_depth, depths[k], clouds[k]),
        )
        for k in depths
    ]


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
