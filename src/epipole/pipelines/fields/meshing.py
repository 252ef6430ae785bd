"""The `mesh` job: extract a mesh from the depth of a trained field, rendered from its cameras."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.dense.volume import BAND
from epipole.dense.volume_building import (
    GRAY,
    MOST_PIXEL_VOXELS,
    ColorImage,
    DepthImage,
    build_volume,
    vertex_colors,
)
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError, NoModelError
from epipole.geometry import Rigid3
from epipole.io.files import missing_in_words
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.io.models.losses import losses_in
from epipole.pipelines.fields.cameras import RenderView, render_views_of_model, sized
from epipole.pipelines.fields.config import MeshConfig, RenderConfig
from epipole.pipelines.fields.options import MeshKeywords
from epipole.pipelines.fields.scene import CAMERAS
from epipole.pipelines.fields.surfaces import LEAST_COVERAGE, Seen, seen_from
from epipole.runs import Progress, ProgressCallback, ignore_progress, refuse_existing, replacing_file
from epipole.scene import Mesh
from epipole.scene.view_depth import ViewDepth

MOST_ENLARGED = 8.0
"""Largest factor by which depth images are larger than the images of the cameras, for voxels that are finer than pixels."""


def mesh(
    source: str | Path,
    out: str | Path,
    config: MeshConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[MeshKeywords],
) -> Mesh:
    """Extract a mesh from trained Gaussians, a neural field or a grid.

    Renders depth from the training cameras and fuses it into a volume of signed distances (`dense/volume.py`).

    Args:
        source: an output folder of `splat` or `nerf`, or a file of Gaussians (with `cameras`).
        out: the mesh, a PLY file with colors.
        config: cameras and resolution; None for the defaults.
        progress: called with the progress.
        **options: single options by name, which override `config`.

    Raises:
        ConfigError: an option is unknown or invalid.
        DegenerateGeometryError: no surface is visible.
        FileFormatError: the source or the cameras cannot be read.
        NoModelError: there is no camera.
        WorkspaceError: the file exists and no earlier call wrote it, or it cannot be written.
    """
    source, out = as_path(source), as_path(out)
    wanted = options_of(MeshConfig, config, options, ["config", "progress"])
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    if out.suffix.lower() != ".ply" or out.is_dir():
        raise ConfigError(f"a mesh is written to a file that ends in .ply, got {out}")
    inputs = (source,) if wanted.cameras is None else (source, wanted.cameras)
    refuse_existing([out], "mesh", inputs)
    see, positions = seen_from(source)
    views = _views(source, wanted)
    for loss in [] if wanted.cameras is None else losses_in(wanted.cameras):
        progress(Progress("fuse", 0, len(views), loss))
    with (
        replacing_file(out, "mesh", inputs) as aside,
        tempfile.TemporaryDirectory(prefix="epipole-") as depths,
    ):
        found = _surface(views, see, _box(positions, wanted), wanted, Path(depths), progress)
        view = _first_view(views[len(views) // 2], found.vertices_in_world)
        write_mesh_ply(aside, found.vertices_in_world, found.faces, found.rgb, view)
    return found


def _surface(
    views: Sequence[RenderView],
    see: Callable[[RenderView], Seen],
    box: tuple[np.ndarray, np.ndarray],
    wanted: MeshConfig,
    folder: Path,
    progress: ProgressCallback,
) -> Mesh:
    """The surface within the box that the views see; their renders are stored in a folder, as they are needed several times.

    Raises:
        DegenerateGeometryError: no surface is visible in the box.
        ConfigError: there are too many voxels.
    """
    low, high = box
    about_low, size = Rigid3(np.eye(3), low), high - low
    voxel, rendered = float(size.max()) / wanted.voxels, list[tuple[RenderView, Path]]()
    for n, view in enumerate(views):
        near = replace(view, cam_from_world=view.cam_from_world @ about_low)
        farthest = _farthest(near, size)
        camera = _fine_enough(view.camera, farthest, voxel)
        rendered.append((replace(near, camera=camera), folder / f"{n:06d}.npz"))
        _store(rendered[-1][1], see(replace(view, camera=camera)), farthest)
        progress(Progress("fuse", n + 1, len(views) + 1))
    images = [
        DepthImage(view.camera, view.cam_from_world, partial(_depth_in, path)) for view, path in rendered
    ]
    volume = build_volume(images, voxel, box=(np.zeros(3), size))
    found = _inside(volume.mesh(), size).without_small_components(wanted.min_component)
    rgb = _colors(found.vertices_in_world, rendered, volume.voxel)
    progress(Progress("fuse", len(views) + 1, len(views) + 1))
    return replace(found, vertices_in_world=found.vertices_in_world + low, rgb=rgb)


def _colors(vertices: np.ndarray, rendered: Sequence[tuple[RenderView, Path]], voxel: float) -> np.ndarray:
    """Colors of vertices from the views that show them; of those that none shows, from views of the surface within the band."""
    rgb = np.full((len(vertices), 3), GRAY, np.uint8)
    for tolerance in (voxel, BAND * voxel):
        rest = np.flatnonzero((rgb == GRAY).all(axis=1))
        images = (
            ColorImage(view.camera, view.cam_from_world, _rgb_in(path), _depth_in(path).depth)
            for view, path in rendered
        )
        rgb[rest] = vertex_colors(vertices[rest], images, tolerance)
    return rgb


def _farthest(view: RenderView, size: np.ndarray) -> float:
    """Largest depth of a box, whose lowest corner is the origin."""
    corners = size * np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return float(view.cam_from_world.apply(corners)[:, 2].max())


def _fine_enough(camera: Camera, farthest: float, voxel: float) -> Camera:
    """The camera, with more pixels if they would be too large for the voxels at the largest depth of the box."""
    factor = min(1.01 * farthest / (MOST_PIXEL_VOXELS * voxel * camera.focal_px), MOST_ENLARGED)
    return camera if factor <= 1.0 else sized(camera, round(factor * camera.width))


def _store(path: Path, seen: Seen, farthest: float) -> None:
    """Store depth and color; where there is no surface, or only behind the box, the space is free: an infinite depth."""
    depth = seen.surface().astype(np.float32)
    depth[~(depth <= farthest)] = np.inf
    color = seen.color / np.maximum(seen.coverage, LEAST_COVERAGE)[..., None]
    np.savez(path, depth=depth, rgb=np.rint(255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8))


def _depth_in(path: Path) -> ViewDepth:
    with np.load(path) as stored:
        depth = stored["depth"]
    none = np.zeros(depth.shape, np.uint8)
    return ViewDepth(depth, np.zeros_like(depth), none, none)


def _rgb_in(path: Path) -> np.ndarray:
    with np.load(path) as stored:
        return np.asarray(stored["rgb"])


def _inside(mesh: Mesh, size: np.ndarray) -> Mesh:
    """The triangles within a box, whose lowest corner is the origin.

    Raises:
        DegenerateGeometryError: there is none.
    """
    inside = np.asarray(((mesh.vertices_in_world >= 0) & (mesh.vertices_in_world <= size)).all(axis=1))
    kept = inside[mesh.faces].all(axis=1)
    if not kept.any():
        raise DegenerateGeometryError("no surface was seen within the box of the mesh")
    return replace(mesh, faces=mesh.faces[kept])


def _first_view(seen: RenderView, vertices_in_world: np.ndarray) -> np.ndarray:
    """Position of a camera, the point of its axis at the distance of the mesh, and up."""
    position, (_, down, ahead) = seen.cam_from_world.centers(), seen.cam_from_world.rotation
    distance = float(np.median((vertices_in_world - position) @ ahead))
    return np.stack([position, position + max(distance, 1e-6) * ahead, -down])


def _box(positions: np.ndarray, wanted: MeshConfig) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of the volume.

    Raises:
        DegenerateGeometryError: the field has no extent.
    """
    if wanted.box is not None:
        low, high = np.array(wanted.box[:3], np.float64), np.array(wanted.box[3:], np.float64)
    else:
        outside = 0.5 - 0.5 * wanted.box_fraction
        low, high = np.quantile(positions.astype(np.float64), (outside, 1.0 - outside), axis=0)
        margin = 0.03 * float(np.max(high - low))
        low, high = low - margin, high + margin
    if not (np.isfinite(high - low).all() and (high - low > 0).all()):
        raise DegenerateGeometryError(
            "the box of the mesh is empty or too large: pass another one (option box)"
        )
    return low, high


def _views(source: Path, wanted: MeshConfig) -> list[RenderView]:
    """The given cameras, or those of the training; an evenly spaced subset if there are too many."""
    cameras = wanted.cameras or (source if source.is_dir() else source.parent) / CAMERAS
    if wanted.cameras is None and not cameras.exists():
        raise NoModelError(
            f"the camera poses of {source} are unknown, because {cameras} does not exist: pass a transforms.json or a"
            " COLMAP model whose cameras look at the scene (option cameras)"
        )
    views = render_views_of_model(cameras, RenderConfig(width=wanted.width))
    rows = np.linspace(0, len(views) - 1, min(len(views), wanted.max_views)).astype(np.int64)
    return [views[row] for row in rows.tolist()]
