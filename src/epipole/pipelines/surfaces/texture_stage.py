"""Fourth stage: the texture of the mesh, and files that other programs open."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from epipole.dense.texturing.texture import texture_mesh
from epipole.dense.texturing.texture_view import TextureView
from epipole.image import undistorted_camera
from epipole.io.meshes.gltf import write_glb
from epipole.io.meshes.obj import write_obj
from epipole.io.meshes.textured_ply import write_textured_ply
from epipole.io.meshes.usd import write_usd
from epipole.pipelines.surfaces.cloud_stage import confirmed_depth
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.view_files import ViewFile, full_image, view_of_file
from epipole.runs import Run, Unit
from epipole.scene import Mesh
from epipole.scene.textured_mesh import TexturedMesh

NAME = "textured"
"""Of the files."""
COARSE_TEXELS = 2.0
"""Side of a texel, in pixels at the median depth, above which the texture is said to be coarse."""


def texture_of(
    mesh: Mesh,
    inputs: SurfaceInputs,
    depths: Mapping[int, Unit],
    clouds: Mapping[int, Unit],
    config: SurfaceConfig,
    run: Run,
) -> TexturedMesh:
    """The mesh with a texture from all views that have a depth.

    Raises:
        ConfigError: the texture is too small for the mesh.
        DegenerateGeometryError: no view shows the mesh.
    """
    views = [_texture_view(inputs.views[k], depths[k], clouds[k]) for k in depths]
    return texture_mesh(
        mesh, views, config.texture_px, lambda done, total: run.report("texture", done, total)
    )


def texel_side(mesh: TexturedMesh) -> float:
    """Side of a texel on the surface, in units of the model; the mean over the area."""
    a, b, c = (mesh.vertices_in_world[mesh.faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    (p, q, r), texels = (mesh.uv[:, k] for k in range(3)), 0.0
    part = 0.5 * np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    for k, texture in enumerate(mesh.textures):
        texels += float(part[mesh.texture_of_face == k].sum()) * texture.shape[0] * texture.shape[1]
    return float(np.sqrt(area / max(texels, 1.0)))


def write_textured(folder: Path, mesh: TexturedMesh, up: np.ndarray, config: SurfaceConfig) -> None:
    """Write the files of the requested formats.

    Raises:
        WorkspaceError: a file cannot be written.
    """
    if "glb" in config.formats:
        write_glb(folder / f"{NAME}.glb", mesh, up=up)
    if "obj" in config.formats:
        write_obj(folder / f"{NAME}.obj", mesh)
    if "ply" in config.formats:
        write_textured_ply(folder / f"{NAME}.ply", mesh)
    if "usdz" in config.formats:
        write_usd(folder / f"{NAME}.usdz", mesh, up=up)


def _texture_view(view: ViewFile, depth: Unit, cloud: Unit) -> TextureView:
    return TextureView(
        view.name,
        view.pinhole,
        view.cam_from_world,
        undistorted_camera(view.image.camera),
        partial(view_of_file, view),
        partial(full_image, view),
        lambda: confirmed_depth(depth, cloud).depth,
    )
