"""Mesh of the keyframes' depth, from a depth sensor or by stereo matching, with the final poses."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.dense.volume_building import ColorImage, DepthImage, build_volume, vertex_colors
from epipole.errors import ConfigError, DegenerateGeometryError, EpipoleError
from epipole.geometry import Rigid3
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.output.keyframe_depth import PairReader, SensorReader, depth_reader
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource
from epipole.runs import Run
from epipole.scene import Mesh
from epipole.scene.view_depth import DepthReason, ViewDepth

MESH = "mesh.ply"
NEAREST, MARGIN = 8.0, 1.3
"""Stereo finds surfaces from this number of baselines on, and nearer ones if the map has points there; factor beyond its disparities."""
LEAST_COMPONENT = 0.01
"""Parts of the mesh with fewer triangles, relative to the largest, are removed."""


def check_mesh(source: FrameSource, job: JobOptions) -> None:
    """Check that a mesh can be made, before frames are tracked.

    Raises:
        ConfigError: the camera does not measure depth, its frames cannot be read again, or there are no new keyframes.
    """
    if not job.mesh:
        return
    if job.localize:
        raise ConfigError("mesh needs new keyframes, and localize makes none: pass one of them")
    if source.is_live:
        raise ConfigError("mesh needs frames that can be read again: record the camera first")
    if source.camera.baseline is None and source.camera.depth is None:
        raise ConfigError("mesh needs a depth sensor or a stereo pair; for one camera, use `epipole surface`")


def publish_mesh(source: FrameSource, system: Slam, run: Run, *, is_wanted: bool) -> dict[str, Any] | None:
    """Write the mesh if it is wanted, in any case remove that of an earlier run, and return its figures.

    Without a mesh, a warning says why: the trajectory must not depend on it.
    """
    if not (is_wanted or (run.root / MESH).is_file()) or not len(system.trajectory()):
        return None
    with run.folder.publish("mesh") as aside:
        if not is_wanted:
            return None
        with run.stage("mesh"):
            try:
                found, voxel = _mesh_of_keyframes(source, system, aside, run)
                _write(aside, found, system)
            except (EpipoleError, OSError) as error:
                run.warnings.append(f"there is no mesh: {error}")
                (aside / MESH).unlink(missing_ok=True)
                return None
            return {"num_faces": len(found), "num_vertices": len(found.vertices_in_world), "voxel": voxel}


def _write(folder: Path, mesh: Mesh, system: Slam) -> None:
    """Write the mesh with the view of the first keyframe."""
    pose = system.maps[0].keyframes[0].cam_from_world
    position, (_, down, ahead) = pose.centers(), pose.rotation
    distance = max(float(np.median((mesh.vertices_in_world - position) @ ahead)), 1e-6)
    view = np.stack([position, position + distance * ahead, -down])
    write_mesh_ply(folder / MESH, mesh.vertices_in_world, mesh.faces, mesh.rgb, view)


def _mesh_of_keyframes(source: FrameSource, system: Slam, aside: Path, run: Run) -> tuple[Mesh, float]:
    """The surface that the new keyframes of the first map see, and the side of its voxels; vertices have the colors of the frames.

    Raises:
        DegenerateGeometryError: no keyframe has depth, or there is no surface.
        FileFormatError: frames cannot be read again.
    """
    model = system.maps[0]
    new = [key for key in model.keyframes if key.number >= system.first_number]
    if not new:
        raise DegenerateGeometryError("there is no new keyframe")
    disparity = max((float(np.nanmax(key.disparity_px, initial=0.0)) for key in new), default=0.0)
    largest = max(source.camera.camera.focal_px / NEAREST, MARGIN * disparity)
    reader = depth_reader(source.camera, largest, model.right_shift_px)
    poses = {key.timestamp_s: key.cam_from_world for key in new}
    with tempfile.TemporaryDirectory(dir=aside, prefix="depth_") as folder:
        rows = list(_stored(source, reader, poses, Path(folder), run))
        images = [DepthImage(camera, pose, partial(_read, path)) for camera, pose, path in rows]
        volume = build_volume(images, None, lambda done, total: run.report("mesh", done, total))
        found = volume.mesh().without_small_components(LEAST_COMPONENT)
        colors = (ColorImage(camera, pose, _rgb(path), _read(path).depth) for camera, pose, path in rows)
        rgb = vertex_colors(found.vertices_in_world, colors)
    return replace(found, rgb=rgb), volume.voxel


def _stored(
    source: FrameSource, reader: SensorReader | PairReader, poses: dict[float, Rigid3], folder: Path, run: Run
) -> Iterator[tuple[Camera, Rigid3, Path]]:
    """Camera and pose of the depth image of each keyframe, and the file of the image."""
    num = 0
    with closing(source.frames()) as frames:
        for queued in frames:
            pose = poses.get(queued.timestamp_s)
            if pose is None:
                continue
            path = folder / f"{queued.number:06d}.npz"
            frame = queued.read()
            gray = partial(np.repeat, frame.gray[..., None], 3, axis=2)
            np.savez(path, **reader.read(frame, (queued.read_rgb or gray)())._asdict())
            yield reader.camera, reader.depth_from_cam @ pose, path
            num += 1
            run.report("depth", num, len(poses))
            if num == len(poses):
                return


def _read(path: Path) -> ViewDepth:
    with np.load(path) as stored:
        depth, sigma = stored["depth"], stored["sigma"]
    known = np.isfinite(depth)
    reason = np.where(known, np.uint8(DepthReason.OK), np.uint8(DepthReason.UNCERTAIN))
    return ViewDepth(depth, sigma, reason, known.astype(np.uint8))


def _rgb(path: Path) -> np.ndarray:
    with np.load(path) as stored:
        return np.asarray(stored["rgb"])
