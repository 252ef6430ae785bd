"""The job: a mesh from a trained field, by its depth as the cameras see it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.fields.rasterizer import render as draw
from epipole.fields.tsdf import DistanceVolume, Mesh
from epipole.io.gaussian_files import read_gaussians
from epipole.io.mesh_ply import write_mesh_ply
from epipole.pipelines.fields.cameras import Shot, shots_of_model
from epipole.pipelines.fields.config import MeshJob, RenderJob
from epipole.pipelines.fields.kinds import Kind, kind_in
from epipole.pipelines.fields.scene import CAMERAS, SPLAT
from epipole.runs import Progress, ProgressCallback, ignore_progress

LEAST_OPACITY = 0.1
"""Of Gaussians that tell how large the scene is."""

Seen = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Depth along the optical axis times coverage, coverage, and colour times coverage."""


def mesh(
    source: str | Path,
    out: str | Path,
    job: MeshJob | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> Mesh:
    """Cut a mesh out of trained Gaussians, a neural field or a grid.

    Depth is drawn from the cameras that the field was trained on, and fused into a volume of signed distances (`fields/tsdf.py`).

    Args:
        source: an output folder of `splat` or `nerf`, or a file of Gaussians (with `cameras`).
        out: the mesh, a PLY file with colours.
        job: from where, and how fine; None for the defaults.
        progress: called with the progress.
        **options: single options by name, which override `job`.

    Raises:
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: no surface is seen.
        FileFormatError: the source, or the cameras, cannot be read.
        NoModelError: there is no camera.
        WorkspaceError: the file cannot be written.
    """
    source, out, wanted = as_path(source), as_path(out), options_of(MeshJob, job, options)
    if not source.exists():
        raise FileFormatError(source, "there is no such file or folder")
    if out.suffix.lower() != ".ply" or out.is_dir():
        raise ConfigError(f"a mesh is written to a file that ends in .ply, not to {out}")
    shots = _shots(source, wanted)
    see, places = _field_of(source)
    low, high = np.quantile(places, (0.5 - 0.5 * wanted.around, 0.5 + 0.5 * wanted.around), axis=0)
    margin = 0.03 * float(np.max(high - low))
    volume = DistanceVolume(low - margin, high + margin, wanted.voxels)
    for n, shot in enumerate(shots):
        volume.add(shot.camera, shot.cam_from_world, *see(shot))
        progress(Progress("fuse", n + 1, len(shots)))
    found = volume.mesh()
    write_mesh_ply(out, found.vertices_in_world, found.faces, found.rgb)
    return found


def _shots(source: Path, wanted: MeshJob) -> list[Shot]:
    """Cameras that were asked for, or those of the training; spread over all where there are many."""
    cameras = wanted.cameras or (source if source.is_dir() else source.parent) / CAMERAS
    if not cameras.exists():
        raise NoModelError(f"{cameras} is not there: give the cameras that look at the scene (cameras)")
    shots = shots_of_model(cameras, RenderJob(width=wanted.width))
    rows = np.linspace(0, len(shots) - 1, min(len(shots), wanted.most_views)).astype(np.int64)
    return [shots[row] for row in rows.tolist()]


def _field_of(source: Path) -> tuple[Callable[[Shot], Seen], np.ndarray]:
    """What draws a shot, and places (n, 3) that say where the scene is."""
    found = kind_in(source)
    if found is not None:
        kind, file = found
        field = kind.read(file)
        return lambda shot: _marched(kind, field, shot), kind.places(field)
    cloud = read_gaussians(source / SPLAT if source.is_dir() else source)
    opacity = 1.0 / (1.0 + np.exp(-cloud.opacity_logits))
    places = cloud.means_in_world[opacity >= LEAST_OPACITY].astype(np.float64)

    def splatted(shot: Shot) -> Seen:
        drawn = draw(cloud, shot.camera, shot.cam_from_world)
        return drawn.depth, drawn.coverage, drawn.colour

    return splatted, places if len(places) else cloud.means_in_world.astype(np.float64)


def _marched(kind: Kind, field: Any, shot: Shot) -> Seen:
    """What is seen before white but not before black is background; depth along rays becomes that along the axis."""
    black, depth, _ = kind.draw(field, shot.camera, shot.cam_from_world, np.zeros(3, np.float32))
    white = kind.draw(field, shot.camera, shot.cam_from_world, np.ones(3, np.float32))[0]
    return depth * _along_axis(shot.camera), 1.0 - (white - black).mean(axis=2), black


def _along_axis(camera: Camera) -> np.ndarray:
    """(h, w) the share of a length along each pixel's ray that lies along the optical axis."""
    matrix = camera.K
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]
    return np.asarray(1.0 / np.sqrt(x * x + y * y + 1.0), np.float32)
