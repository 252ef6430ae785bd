"""Scenes of single files that belong to no job: points, triangles with and without textures, and depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.image import color_map
from epipole.io.images.depth_maps import PNG_SCALE, read_pfm, read_png16
from epipole.io.meshes.gltf import read_glb, up_of_glb
from epipole.io.meshes.mesh_ply import first_view_of_mesh, read_mesh_ply
from epipole.io.meshes.ply import CAMERA_RGB, frustum_segments, num_cameras_of_scene
from epipole.pipelines.stereo.scene import points_of_depths, view_of_depths
from epipole.report.markup import plural
from epipole.report.space_scene import CameraLayer, FirstView, MeshLayer, PointLayer, SpaceScene
from epipole.report.textured_layer import textured_layer
from epipole.scene import Curve, extent_of

UNIT, FARTHEST = "units of the file", 1e30
GRAY = 190
WIDTH_DEG = 60.0
"""Assumed horizontal field of view of a depth map, whose intrinsics are unknown."""


def is_ply(path: Path) -> bool:
    """Whether a path is a PLY file."""
    return path.suffix.lower() == ".ply" and path.is_file()


def scene_of_ply(path: Path) -> SpaceScene:
    """A scene with points, or with triangles if the file has faces.

    Raises:
        FileFormatError: the file is damaged, or has no points.
    """
    found = read_mesh_ply(path)
    xyz, n = found.xyz, len(found.xyz)
    rendered = (np.abs(xyz) < FARTHEST).all(axis=1)
    if not rendered.any():
        raise FileFormatError(path, "it has no finite points with coordinates below 1e30")
    if not rendered.all():
        xyz = np.where(rendered[:, None], xyz, np.nan)
    num_cameras = num_cameras_of_scene(path)
    if num_cameras is not None and 5 * num_cameras <= n and found.rgb is not None:
        return _scene_of_model(path, xyz, found.rgb, num_cameras)
    rgb = found.rgb if found.rgb is not None else np.full((n, 3), GRAY, np.uint8)
    if (known := first_view_of_mesh(path)) is not None:
        view = FirstView(*known)
    else:
        extent = extent_of(xyz[:: max(1, n // 200_000)], np.zeros((0, 3)), 95.0)
        # Most such files are in a camera's world, y down; other models may have other axes.
        away = extent.radius * np.array([-0.9, -1.1, -2.2])
        view = FirstView(extent.focus + away, extent.focus, np.array([0.0, -1.0, 0.0]))
    title = path.resolve().name
    if len(found.faces):
        words = f"{plural(len(found.faces), 'triangle')} between {plural(n, 'vertex', 'vertices')}"
        mesh = MeshLayer("Triangles", xyz, found.faces, rgb)
        return SpaceScene(title, words, UNIT, mesh=mesh, view=view)
    return SpaceScene(title, plural(n, "point"), UNIT, (PointLayer("Points", xyz, rgb),), view=view)


def _scene_of_model(path: Path, xyz: np.ndarray, rgb: np.ndarray, num_cameras: int) -> SpaceScene:
    """The scene of a model written as PLY: its cameras are lines, not points; +z is up."""
    n = len(xyz) - 5 * num_cameras
    lines = Curve("Cameras", frustum_segments(xyz[n:].reshape(-1, 5, 3)), CAMERA_RGB)
    words = f"{plural(n, 'point')} and {plural(num_cameras, 'camera')}"
    points = PointLayer("Points", xyz[:n], rgb[:n])
    return SpaceScene(path.resolve().name, words, UNIT, (points,), curves=(lines,) if num_cameras else ())


def is_glb(path: Path) -> bool:
    """Whether a path is a binary glTF file."""
    return path.suffix.lower() == ".glb" and path.is_file()


def scene_of_glb(path: Path) -> SpaceScene:
    """A scene with the textured triangles of a binary glTF file.

    Raises:
        FileFormatError: the file is damaged, or has no textured triangles.
    """
    mesh = read_glb(path)
    upright = Rotation3.from_two_vectors(up_of_glb(path), np.array([0.0, 0.0, 1.0])).matrix
    layer = textured_layer("Textured mesh", mesh)
    words = f"{plural(len(mesh), 'triangle')} with {plural(len(mesh.textures), 'texture')}"
    return SpaceScene(path.resolve().name, words, UNIT, mesh=layer, upright_from_world=upright)


def is_depth_map(path: Path) -> bool:
    """Whether a path is a PFM or PNG file."""
    return path.suffix.lower() in (".pfm", ".png") and path.is_file()


def scene_of_depth_map(path: Path) -> SpaceScene:
    """A depth map's points, colored by depth; the field of view is assumed, since such files have no intrinsics.

    Raises:
        FileFormatError: the file is damaged, or no pixel has a depth.
    """
    if "disparity" in path.stem.lower():
        hint = "`epipole stereo` with --focal-px and --baseline, or --calibration, writes depths"
        raise FileFormatError(path, f"its name says disparity, but depth is needed: {hint}")
    is_png = path.suffix.lower() == ".png"
    depths = (read_png16 if is_png else read_pfm)(path)
    depths = np.where(np.isfinite(depths) & (depths > 0), depths, np.nan)
    if not np.isfinite(depths).any():
        raise FileFormatError(path, "no pixel has a depth")
    height, width = depths.shape
    focal_px = 0.5 * width / np.tan(np.radians(0.5 * WIDTH_DEG))
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    layer = points_of_depths(depths, None, K, color_map(np.log(depths)))
    camera = CameraLayer("Camera", ("camera",), Rigid3.identity(1), K[None], np.array([[width, height]]))
    words = (
        f"{plural(len(layer.xyz_in_world), 'pixel')} of {width} x {height}, its values "
        f"{f'divided by {PNG_SCALE:g}, as in KITTI, ' if is_png else ''}interpreted as depths; "
        f"its intrinsics are unknown, so a horizontal field of view of {WIDTH_DEG:.0f} degrees is assumed"
    )
    return SpaceScene(
        path.resolve().name, words, UNIT, (layer,), camera, view=view_of_depths(layer.xyz_in_world)
    )
