"""Reading and writing nerfstudio's transforms.json (reading also instant-ngp's and NeRF-synthetic's).

A frame's matrix is world_from_cam with OpenGL camera axes: x right, y up, looking down -z. The principal point is
relative to the image corner, half a pixel before the center of the first pixel. If the file has `origin_in_world`, its
coordinates, and those of its points, are relative to that origin. `georeference` is the position of the world on Earth.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Similarity3
from epipole.io._named_numbers import numbers_of
from epipole.io.atomic import atomic_write
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.io.files import problem_of_name, read_json, require_file
from epipole.io.georeference import georeference_fields, georeference_of_fields
from epipole.io.json_files import json_text
from epipole.io.meshes.ply import read_points_ply, write_points_ply
from epipole.io.models._transforms_cameras import (
    FISHEYE_KEYS,
    OPENGL_AXES,
    PERSPECTIVE_KEYS,
    camera_of_frame,
    world_from_camera,
)
from epipole.io.models._transforms_keys import SPLIT_KEYS, key_warnings, require_known_keys
from epipole.io.names import path_inside
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks
from epipole.scene.local_origin import ORIGIN

POINTS_FILE = "sparse_pc.ply"
GEOREFERENCE_KEY = "georeference"
"""Name of the point file, written beside the cameras."""


@checked
def write_transforms(
    reconstruction: Reconstruction,
    path: str | Path,
    image_folder: str = "images",
    origin_in_world: Float64[np.ndarray, " 3"] | None = None,
) -> None:
    """Write the registered cameras, and the points (if any) to a PLY file beside them.

    Intrinsics are written once if all images share them, otherwise in each frame.

    Args:
        reconstruction: the model to write.
        path: the JSON file.
        image_folder: folder of the images, relative to the JSON file's folder.
        origin_in_world: written as `origin_in_world`, with all coordinates relative to it; None: omitted.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    path, georeference = Path(path), reconstruction.georeference
    if origin_in_world is not None:
        reconstruction = reconstruction.transformed(_translation(-np.asarray(origin_in_world)))
    cams_from_world, camera_of_image = reconstruction.cams_from_world(), reconstruction.camera_of_image
    registered = np.flatnonzero(np.isfinite(cams_from_world.translation).all(axis=1)).tolist()
    used = sorted({int(camera_of_image[image]) for image in registered})
    intrinsics = {row: _intrinsics(reconstruction.cameras[row]) for row in used}
    content: dict[str, Any] = dict(intrinsics[used[0]]) if len(used) == 1 else {}
    if georeference is not None:
        content[GEOREFERENCE_KEY] = georeference_fields(georeference)
    if origin_in_world is not None:
        content[ORIGIN] = np.asarray(origin_in_world, np.float64).tolist()
    if len(reconstruction.points):
        content["ply_file_path"] = POINTS_FILE
        points = reconstruction.points
        write_points_ply(path.with_name(POINTS_FILE), points.xyz_in_world, points.rgb)
    frames = []
    for image in registered:
        name = reconstruction.images.name[image]
        frame: dict[str, Any] = {"file_path": str(PurePosixPath(image_folder) / name)}
        if len(used) > 1:
            frame |= intrinsics[int(camera_of_image[image])]
        matrix = cams_from_world[image].inverse().as_matrix() @ OPENGL_AXES
        frame["transform_matrix"] = matrix.tolist()
        frames.append(frame)
    content["frames"] = frames
    with atomic_write(path) as part:
        part.write_text(json_text(content), encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    K, is_fisheye = camera.K, camera.model == CameraModel.OPENCV_FISHEYE
    distortion = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    distortion[: len(values)] = values
    if distortion[5:].any():
        raise ConfigError(
            "transforms.json cannot represent a rational camera model: undistort the images first"
        )
    return {
        "camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2] + HALF_PIXEL),
        "cy": float(K[1, 2] + HALF_PIXEL),
        **dict(zip(FISHEYE_KEYS if is_fisheye else PERSPECTIVE_KEYS, distortion.tolist())),
        **({"k3": float(distortion[4])} if distortion[4] else {}),
    }


@dataclass(frozen=True, slots=True, eq=False)
class TransformsScene:
    """The content of a transforms.json file."""

    reconstruction: Reconstruction
    masks: Mapping[str, str]
    """Mask path by image name, relative to the JSON file's folder. Black pixels are not used."""
    splits: Mapping[str, tuple[str, ...]]
    """Image names of the splits train, val and test that the file defines."""
    warnings: tuple[str, ...]
    """Skipped frames, ignored keys, and corrected values."""

    def __repr__(self) -> str:
        splits = "".join(f", {len(names)} {split}" for split, names in self.splits.items())
        return f"TransformsScene({len(self.reconstruction.images)} images, {len(self.masks)} masks{splits})"


@checked
def read_transforms(path: str | Path, image_folder: str = "images") -> Reconstruction:
    """Read cameras, and the points if the file refers to any; the format has no keypoints and no tracks.

    Issues a Python warning for everything in `TransformsScene.warnings`.

    Args:
        path: the JSON file.
        image_folder: prefix removed from the image names, as added by `write_transforms`.

    Raises:
        FileFormatError: not such a file, a frame has invalid values, or a key or camera model is not supported.
    """
    scene = read_transforms_scene(path, image_folder)
    for warning in scene.warnings:
        warnings.warn(f"epipole: {path}: {warning}", RuntimeWarning, stacklevel=3)
    return scene.reconstruction


@checked
def read_transforms_scene(path: str | Path, image_folder: str = "images") -> TransformsScene:
    """Read cameras and points, and the masks and splits that the file defines.

    Args:
        path: the JSON file.
        image_folder: as in `read_transforms`.

    Raises:
        FileFormatError: as in `read_transforms`.
    """
    path = Path(path)
    content = _object_in(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise FileFormatError(
            path,
            "the list of frames is missing, so this is not a transforms.json; pass the file that lists the images",
        )
    try:
        require_known_keys(content)
        _require_affine(content)
    except (ConfigError, TypeError, ValueError) as error:
        raise FileFormatError(path, str(error)) from error
    found = _Frames(path, content, image_folder)
    for number, frame in enumerate(frames):
        found.add(number, frame)
    if frames and not found.names:
        raise FileFormatError(path, f"none of its {len(frames)} frames can be used; {found.left_out[0]}")
    points, point_warnings = _points(path, content)
    notes = (*key_warnings(content, frames), *point_warnings, *found.warnings())
    splits = {
        split: found.names_of_split(key, content[key]) for split, key in SPLIT_KEYS.items() if key in content
    }
    return TransformsScene(found.reconstruction(points), found.masks, splits, notes)


def _require_affine(content: dict[str, Any]) -> None:
    """Check the transform and scale that were applied to the file's poses and points, which are read unchanged.

    Raises:
        ConfigError: the transform or the scale is not valid.
    """
    transform = np.array(content.get("applied_transform", np.eye(4)), np.float64)
    scale = float(content.get("applied_scale", 1.0))
    if transform.shape not in ((3, 4), (4, 4)) or not np.isfinite(transform).all():
        raise ConfigError("applied_transform is not 3x4 finite numbers")
    if not (math.isfinite(scale) and scale > 0):
        raise ConfigError(f"applied_scale must be positive, got {scale:g}")


class _Frames:
    """The frames read so far."""

    def __init__(self, path: Path, content: dict[str, Any], image_folder: str) -> None:
        self._path, self._content = path, content
        self._prefix = f"{image_folder.rstrip('/')}/" if image_folder else ""
        self.names: list[str] = []
        self.masks: dict[str, str] = {}
        self.left_out: list[str] = []
        self._names_left_out: set[str] = set()
        self._oddities: dict[str, None] = {}
        self._corrections: list[tuple[float, str]] = []
        self._cameras: list[Camera] = []
        self._camera_rows: list[int] = []
        self._row_of_camera: dict[tuple, int] = {}
        self._worlds_from_cams: list[np.ndarray] = []

    def add(self, number: int, frame: dict[str, Any]) -> None:
        """Read one frame.

        Raises:
            FileFormatError: the frame cannot be read; the message has its number and image.
        """
        try:
            self._add(number, frame)
        except (ConfigError, KeyError, TypeError, ValueError, ArithmeticError, OSError) as error:
            problem = f"the key {error} is missing" if isinstance(error, KeyError) else str(error)
            name = frame.get("file_path")
            of_image = f" (image {name[:80]})" if isinstance(name, str) else ""
            raise FileFormatError(self._path, f"frame {number}: {problem}{of_image}") from error

    def _add(self, number: int, frame: dict[str, Any]) -> None:
        path_in_file = _image_name(self._path, frame["file_path"])
        name = path_in_file.removeprefix(self._prefix)
        require_known_keys(frame)
        if frame.get("is_bad"):
            self._leave_out(f"skipped frame {number} ({name}): it is marked as bad", name)
            return
        camera, oddities = camera_of_frame(self._path, self._content, frame, path_in_file)
        world_from_cam, correction = world_from_camera(frame)
        if world_from_cam is None:
            self._leave_out(f"skipped frame {number} ({name}): its transform_matrix is not finite", name)
            return
        mask = frame.get("mask_path", self._content.get("mask_path"))
        if mask is not None:
            self.masks[name] = _image_name(self._path, mask)
        if correction:
            self._corrections.append((correction, name))
        self._oddities |= dict.fromkeys(oddities)
        key = (int(camera.model), camera.width, camera.height, camera.params.tobytes())
        if key not in self._row_of_camera:
            self._row_of_camera[key] = len(self._cameras)
            self._cameras.append(camera)
        self._camera_rows.append(self._row_of_camera[key])
        self._worlds_from_cams.append(world_from_cam)
        self.names.append(name)

    def _leave_out(self, why: str, name: str) -> None:
        self.left_out.append(why)
        self._names_left_out.add(name)

    def warnings(self) -> list[str]:
        """Warnings about skipped frames, unusual values and corrections."""
        out = [*self.left_out, *self._oddities]
        if self._corrections:
            most, name = max(self._corrections, key=lambda item: item[0])
            count = len(self._corrections)
            out.append(
                f"{count} of {len(self.names)} rotations are scaled or sheared, by at most {100 * most:.2g} % ({name}):"
                " they were replaced with the nearest rotations"
            )
        return out

    def names_of_split(self, key: str, listed: Any) -> tuple[str, ...]:
        """The images in one of the file's lists, without those whose frames are skipped.

        Raises:
            FileFormatError: not a list of names, or it has an image that no frame has.
        """
        if not isinstance(listed, list) or not all(isinstance(item, str) for item in listed):
            raise FileFormatError(self._path, f"{key} is not a list of names")
        try:
            names = [_image_name(self._path, item).removeprefix(self._prefix) for item in listed]
        except ConfigError as error:
            raise FileFormatError(self._path, f"{key}: {error}") from error
        known = set(self.names)
        missing = [name for name in names if name not in known and name not in self._names_left_out]
        if missing:
            few = ", ".join(missing[:3])
            raise FileFormatError(self._path, f"{key} has {len(missing)} images that no frame has ({few})")
        return tuple(name for name in names if name in known)

    def reconstruction(self, points: Points) -> Reconstruction:
        """The cameras, together with these points."""
        matrices = np.array(self._worlds_from_cams).reshape(-1, 4, 4)[:, :3]
        cams_from_world = Rigid3.from_matrix(matrices).inverse()
        model = model_of_cameras(self.names, self._cameras, self._camera_rows, cams_from_world, points)
        if ORIGIN in self._content:
            model = model.transformed(_translation(numbers_of(self._path, self._content, ORIGIN, 3)))
        if GEOREFERENCE_KEY not in self._content:
            return model
        return replace(
            model, georeference=georeference_of_fields(self._path, self._content[GEOREFERENCE_KEY])
        )


def _translation(offset: np.ndarray) -> Similarity3:
    return Similarity3(np.array(1.0), np.eye(3), offset)


def _object_in(path: Path) -> dict[str, Any]:
    content = read_json(path, allow_nan=True)  # a pose that is not finite does not affect the others
    if not isinstance(content, dict):
        raise FileFormatError(path, "not a transforms file (no JSON object)")
    return content


def _image_name(path: Path, given: Any) -> str:
    """An image's path as in the file; NeRF-synthetic omits '.png'."""
    if (problem := problem_of_name(given)) is not None:
        raise ConfigError(problem)
    name = str(given).replace("\\", "/").removeprefix("./")
    if not Path(name).suffix and (path.parent / f"{name}.png").is_file():
        return f"{name}.png"
    return name


def _points(path: Path, content: dict[str, Any]) -> tuple[Points, list[str]]:
    """The points in the file given by ply_file_path, and a warning if it is missing."""
    name = content.get("ply_file_path")
    if isinstance(name, str) and (problem := problem_of_name(name)) is not None:
        raise FileFormatError(path, f"ply_file_path: {problem}")
    try:
        file = path_inside(path.parent, name) if isinstance(name, str) and name else None
        is_there = file is not None and file.exists()
        if file is not None and is_there:
            require_file(file)
    except OSError as error:
        raise FileFormatError(path, f"ply_file_path: {error.strerror}") from error
    except FileFormatError as error:
        raise FileFormatError(path, f"ply_file_path: {error}") from error
    if file is None or not is_there:
        missing = [] if file is None else [f"the file {str(name)[:80]} given by ply_file_path does not exist"]
        return Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0)), missing
    cloud = read_points_ply(file)
    rgb = cloud.rgb if cloud.rgb is not None else np.full((len(cloud), 3), 128, np.uint8)
    return Points(cloud.xyz, rgb, np.full(len(cloud), np.nan)), []


@checked
def model_of_cameras(
    names: list[str], cameras: list[Camera], camera_rows: list[int], cams_from_world: Rigid3, points: Points
) -> Reconstruction:
    """A model with cameras and poses, without keypoints and tracks."""
    n, rows = len(names), np.array(camera_rows, np.int32)
    no_keypoints = np.zeros(n + 1, np.int64)
    images = Images(tuple(names), np.arange(n, dtype=np.int32), rows, no_keypoints, np.empty((0, 2)))
    return Reconstruction(
        Cameras.from_list(cameras),
        Rigs.of_single_cameras(len(cameras)),
        Frames(rows.copy(), cams_from_world, np.full(n, np.nan)),
        images,
        points,
        Tracks(np.zeros(len(points) + 1, np.int64), np.empty(0, np.int32), np.empty(0, np.int32)),
    )
