"""Mesh of the keyframes' depth, from a depth sensor or by stereo matching, with the final poses."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.dense.volume_building import ColorImage, DepthImage, build_volume, vertex_colors
from epipole.disparity_search.config import DisparityConfig
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource
from epipole.runs import Run
from epipole.scene import Mesh
from epipole.scene.view_depth import DepthReason, ViewDepth

MESH = "mesh.ply"
SENSOR_SIGMA = 0.0016
"""Standard deviation of a depth sensor's z is this times z^2, in meters (structured light; Khoshelham and Elberink, Sensors 2012)."""
EDGE = 0.05
"""Relative difference to a neighbor from which a sensor's pixel is at an edge, where it may show a mixture of both sides."""
MOST_SIGMA = 0.02
"""Largest standard deviation, relative to the depth."""
NEAREST = 8.0
"""Smallest depth of a stereo pair, in baselines."""
LEAST_COMPONENT = 0.01


def require_depth(source: FrameSource) -> None:
    """Check that a mesh can be made, before frames are tracked.

    Raises:
        ConfigError: the camera does not measure depth, or its frames cannot be read again.
    """
    if source.is_live:
        raise ConfigError("mesh needs frames that can be read again: record the camera first")
    if source.camera.baseline is None and source.camera.depth is None:
        raise ConfigError("mesh needs a depth sensor or a stereo pair; for one camera, use `epipole surface`")


def write_mesh(folder: Path, mesh: Mesh, system: Slam) -> None:
    """Write the mesh with the view of the first keyframe.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    pose = system.maps[0].keyframes[0].cam_from_world
    position, (_, down, ahead) = pose.centers(), pose.rotation
    distance = max(float(np.median((mesh.vertices_in_world - position) @ ahead)), 1e-6)
    view = np.stack([position, position + distance * ahead, -down])
    write_mesh_ply(folder / MESH, mesh.vertices_in_world, mesh.faces, mesh.rgb, view)


def mesh_of_keyframes(source: FrameSource, system: Slam, run: Run) -> tuple[Mesh, float]:
    """The surface that the keyframes of the first map see, and the side of its voxels; vertices are gray, as the images of SLAM.

    Raises:
        DegenerateGeometryError: no keyframe has depth, or there is no surface.
    """
    poses = {key.timestamp_s: key.cam_from_world for key in system.maps[0].keyframes}
    with tempfile.TemporaryDirectory(dir=run.root, prefix="depth_") as folder:
        rows = list(_stored(source, poses, Path(folder), run))
        images = [DepthImage(camera, pose, partial(_read, path)) for camera, pose, path in rows]
        volume = build_volume(images, None, lambda done, total: run.report("mesh", done, total))
        found = volume.mesh().without_small_components(LEAST_COMPONENT)
        gray = (ColorImage(camera, pose, _rgb(path), _read(path).depth) for camera, pose, path in rows)
        rgb = vertex_colors(found.vertices_in_world, gray)
    return replace(found, rgb=rgb), volume.voxel


def _stored(
    source: FrameSource, poses: dict[float, Rigid3], folder: Path, run: Run
) -> Iterator[tuple[Camera, Rigid3, Path]]:
    """Camera and pose of the depth image of each keyframe, and the file of the image."""
    camera, motion = _depth_camera(source.camera)
    frames, num = source.frames(), 0
    try:
        for queued in frames:
            pose = poses.get(queued.timestamp_s)
            if pose is None:
                continue
            path = folder / f"{queued.number:06d}.npz"
            frame = queued.read()
            depth, sigma = _depth_of(frame, source.camera)
            np.savez(path, depth=depth, sigma=sigma, gray=_gray_at(frame, depth.shape))
            yield camera, motion @ pose, path
            num += 1
            run.report("depth", num, len(poses))
    finally:
        frames.close()


def _depth_camera(camera: SlamCamera) -> tuple[Camera, Rigid3]:
    """The pinhole camera of the depth images, and its pose in the tracked camera's frame."""
    if camera.depth is None:
        return camera.camera, Rigid3.identity()
    found = camera.depth.camera
    if found.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
        # Depth images cannot be interpolated across edges; their distortion is small.
        K = found.K
        found = Camera(
            CameraModel.PINHOLE, found.width, found.height, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        )
    return found, camera.depth.depth_from_color


def _depth_of(frame: Frame, camera: SlamCamera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and standard deviation in meters; NaN where unknown."""
    nan = np.float32(np.nan)
    if camera.depth is not None:
        assert frame.depth is not None
        depth = np.where(frame.depth > 0, frame.depth * np.float32(camera.depth.scale), nan)
        sigma = np.float32(SENSOR_SIGMA) * depth * depth
        good = np.isfinite(depth) & ~_is_edge(depth)
    else:
        assert frame.right_gray is not None and camera.baseline is not None
        product = camera.camera.focal_px * camera.baseline
        largest = min(int(camera.camera.focal_px / NEAREST), frame.gray.shape[1] - 1)
        found = match_stereo(frame.gray, frame.right_gray, DisparityConfig(max_disparity_px=largest))
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (product / found.disparity_px).astype(np.float32)
            sigma = depth * found.sigma_px / found.disparity_px
        good = np.isfinite(depth) & (found.disparity_px > 0)
    if frame.ignored_mask is not None and frame.ignored_mask.shape == depth.shape:
        good &= ~frame.ignored_mask
    with np.errstate(invalid="ignore"):
        good &= sigma <= MOST_SIGMA * depth
    return np.where(good, depth, nan), np.where(good, sigma, nan).astype(np.float32)


def _is_edge(depth: np.ndarray) -> np.ndarray:
    window, known = np.ones((3, 3), np.uint8), np.isfinite(depth)
    largest = cv2.dilate(np.where(known, depth, np.float32(0.0)), window)
    smallest = cv2.erode(np.where(known, depth, np.float32(1e9)), window)
    return np.asarray(largest > (1.0 + EDGE) * smallest)


def _gray_at(frame: Frame, shape: tuple[int, ...]) -> np.ndarray:
    """The gray image, resized to that of the depth."""
    if frame.gray.shape == shape:
        return frame.gray
    return np.asarray(cv2.resize(frame.gray, (shape[1], shape[0]), interpolation=cv2.INTER_AREA))


def _read(path: Path) -> ViewDepth:
    with np.load(path) as stored:
        depth, sigma = stored["depth"], stored["sigma"]
    known = np.isfinite(depth)
    reason = np.where(known, np.uint8(DepthReason.OK), np.uint8(DepthReason.UNCERTAIN))
    return ViewDepth(depth, sigma, reason, known.astype(np.uint8))


def _rgb(path: Path) -> np.ndarray:
    with np.load(path) as stored:
        return np.repeat(stored["gray"][..., None], 3, axis=2)
