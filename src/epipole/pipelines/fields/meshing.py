"""The `mesh` job: extract a mesh from the depth of a trained field, rendered from its cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.dense.tsdf import DistanceVolume
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.io.files import missing_in_words
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.io.models.losses import losses_in
from epipole.pipelines.fields.cameras import RenderView, render_views_of_model
from epipole.pipelines.fields.config import MeshConfig, RenderConfig
from epipole.pipelines.fields.options import MeshKeywords
from epipole.pipelines.fields.scene import CAMERAS
from epipole.pipelines.fields.surfaces import seen_from
from epipole.runs import Progress, ProgressCallback, ignore_progress, refuse_existing, replacing_file
from epipole.scene import Mesh


def mesh(
    source: str | Path,
    out: str | Path,
    config: MeshConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[MeshKeywords],
) -> Mesh:
    """Extract a mesh from trained Gaussians, a neural field or a grid.

    Renders depth from the training cameras and fuses it into a volume of signed distances (`dense/tsdf.py`).

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
    volume = DistanceVolume(*_box(positions, wanted), wanted.voxels)
    for loss in [] if wanted.cameras is None else losses_in(wanted.cameras):
        progress(Progress("fuse", 0, len(views), loss))
    for n, render_view in enumerate(views):
        volume.add(render_view.camera, render_view.cam_from_world, *see(render_view))
        progress(Progress("fuse", n + 1, len(views)))
    found = volume.mesh().without_small_components(wanted.min_component)
    with replacing_file(out, "mesh", inputs) as aside:
        view = _first_view(views[len(views) // 2], found.vertices_in_world)
        write_mesh_ply(aside, found.vertices_in_world, found.faces, found.rgb, view)
    return found


def _first_view(seen: RenderView, vertices_in_world: np.ndarray) -> np.ndarray:
    """Position of a camera, the point of its axis at the distance of the mesh, and up."""
    position, (_, down, ahead) = seen.cam_from_world.centers(), seen.cam_from_world.rotation
    distance = float(np.median((vertices_in_world - position) @ ahead))
    return np.stack([position, position + max(distance, 1e-6) * ahead, -down])


def _box(positions: np.ndarray, wanted: MeshConfig) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of the volume."""
    if wanted.box is not None:
        return np.array(wanted.box[:3]), np.array(wanted.box[3:])
    low, high = np.quantile(
        positions, (0.5 - 0.5 * wanted.box_fraction, 0.5 + 0.5 * wanted.box_fraction), axis=0
    )
    margin = 0.03 * float(np.max(high - low))
    return low - margin, high + margin


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
