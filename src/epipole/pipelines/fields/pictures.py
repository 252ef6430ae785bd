"""What a field is trained on: pictures without distortion, cameras, and points, from any of the formats here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError, EpipoleError, FileFormatError, NoModelError
from epipole.fields.training_view import TrainingView, shrunk, shrunk_mask
from epipole.geometry import Rigid3
from epipole.image import undistort_image, undistorted_camera
from epipole.io.colmap import find_model, read_colmap_model
from epipole.io.contents_in_words import results_of
from epipole.io.llff import LLFF, read_llff
from epipole.io.names import path_inside
from epipole.io.photographs import mask_of, read_mask, read_rgb
from epipole.io.rgba_pictures import read_rgba
from epipole.io.transforms_json import read_transforms
from epipole.pipelines.fields.config import FieldOptions
from epipole.runs import Progress, ProgressCallback, ignore_progress
from epipole.scene import Reconstruction

SPLITS = ("transforms_train.json", "transforms_test.json")
"""NeRF-synthetic's; a file of validation views is not used."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldPictures:
    """Views to train on, views that are held out, and what is known of the scene."""

    train: list[TrainingView]
    test: list[TrainingView]
    points_in_world: np.ndarray
    rgb: np.ndarray
    has_alpha: bool
    problems: list[str]
    """Pictures that are left out, and why."""


def is_model(source: Path) -> bool:
    """Whether a source tells cameras; else it is photographs."""
    if source.suffix == ".json":
        return True
    if any((source / name).is_file() for name in (SPLITS[0], "transforms.json", LLFF)):
        return True
    try:
        find_model(source)
    except FileFormatError:
        return False
    return True


def gather_field_pictures(
    source: Path,
    options: FieldOptions,
    photographs: Path | None = None,
    progress: ProgressCallback = ignore_progress,
) -> FieldPictures:
    """Read cameras and pictures.

    Args:
        source: an output folder of `reconstruct`, a COLMAP model with `images` beside it, a transforms.json, or a folder of one
            or of LLFF's poses_bounds.npy.
        options: which pictures are held out, and how large they may be.
        photographs: where the pictures are, if not beside the model.
        progress: called after each picture.

    Raises:
        FileFormatError: there is no model, or it is damaged.
        NoModelError: fewer than two pictures can be used.
        ConfigError: a picture that is to be held out has no camera.
    """
    problems: list[str] = []
    if (source / SPLITS[0]).is_file():
        parts = [
            (source / name, read_transforms(source / name, image_folder=""))
            for name in SPLITS
            if (source / name).is_file()
        ]
        model = parts[0][1]
        train = _views(model, source, options, problems, progress)
        test = _views(parts[1][1], source, options, problems, progress) if len(parts) > 1 else []
    else:
        model, folder = _model_of(source, options.max_side_px)
        views = _views(model, photographs or folder, options, problems, progress)
        held = _held_out([view.name for view in views], options)
        test = [view for view in views if view.name in held]
        train = [view for view in views if view.name not in held]
    if len(train) < 2:
        raise NoModelError(
            f"{len(train)} of the pictures can be trained on, two are needed"
            + "".join(f"; {p}" for p in problems[:3])
            + ("; SLAM keeps no images beside its map" if results_of(source) == "slam" else "")
        )
    has_alpha = any(view.picture.shape[2] == 4 for view in train)
    return FieldPictures(train, test, model.points.xyz_in_world, model.points.rgb, has_alpha, problems)


def _held_out(names: list[str], options: FieldOptions) -> set[str]:
    """Names of pictures that are not trained on.

    Raises:
        ConfigError: one that is asked for is not there.
    """
    if options.test is None:
        return set(names[:: options.test_every]) if options.test_every else set()
    wanted = {name.strip() for name in options.test.split(",") if name.strip()}
    missing = sorted(wanted - set(names))
    if missing:
        raise ConfigError(f"test names pictures that have no camera: {', '.join(missing[:4])}")
    return wanted


def _model_of(source: Path, max_side_px: int) -> tuple[Reconstruction, Path]:
    """A model, and the folder that its pictures' names start from."""
    if (source / LLFF).is_file():
        scene = read_llff(source, max_side_px)
        return scene.reconstruction, scene.image_folder
    file = source if source.suffix == ".json" else source / "transforms.json"
    if file.is_file():
        return read_transforms(file, image_folder=""), file.parent
    folder = find_model(source)
    at = folder.resolve()
    places = (source, folder, at.parent, at.parent.parent)
    workspace = next((place for place in places if (place / "images").is_dir()), source)
    return read_colmap_model(folder), workspace / "images"


def _views(
    model: Reconstruction,
    folder: Path,
    options: FieldOptions,
    problems: list[str],
    progress: ProgressCallback,
) -> list[TrainingView]:
    """By their names; a picture that cannot be read is left out.

    Raises:
        ConfigError: there are masks, and of none of the pictures.
    """
    out, cams_from_world = [], model.cams_from_world()
    rows = np.flatnonzero(model.is_registered())
    point = model.tracks.point_of_observation()
    progress(Progress("load", 0, len(rows)))
    for n, row in enumerate(sorted(rows.tolist(), key=lambda k: model.images.name[k]), 1):
        name = model.images.name[row]
        try:
            camera = model.cameras[int(model.camera_of_image[row])]
            mask = (
                None
                if options.masks is None
                else read_mask(options.masks, name, size=(camera.width, camera.height))
            )
            seen = model.points.xyz_in_world[point[model.tracks.image == row]]
            path = path_inside(folder, name)
            view = _view(name, path, camera, cams_from_world[row], mask, seen, options.max_side_px)
            if view.used_mask is None or view.used_mask.any():
                out.append(view)
            else:
                problems.append(f"{name} is left out: its mask leaves nothing of it")
        except EpipoleError as error:
            problems.append(f"{name} is left out: {error}")
        progress(Progress("load", n, len(rows)))
    if options.masks is not None and not any(mask_of(options.masks, name) for name in model.images.name):
        raise ConfigError(f"no picture has a mask in {options.masks} (NAME.png beside the picture's name)")
    return out


def _view(
    name: str,
    path: Path,
    camera: Camera,
    cam_from_world: Rigid3,
    mask: np.ndarray | None,
    points_in_world: np.ndarray,
    max_side_px: int,
) -> TrainingView:
    """A picture and its mask without distortion, in the size that is wanted, and its pinhole camera."""
    picture = _read(path, camera)
    pinhole = undistorted_camera(camera)
    picture = _undistorted(picture, camera, pinhole)
    fitted = _fitted(pinhole, max_side_px)
    size = fitted.width, fitted.height
    if mask is not None:
        full = np.repeat(np.where(mask, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
        mask = shrunk_mask(undistort_image(full, camera, pinhole)[..., 0] == 255, size)
    picture = shrunk(picture, size) if size != (pinhole.width, pinhole.height) else picture
    return TrainingView(name, picture, fitted, cam_from_world, mask, points_in_world)


def _read(path: Path, camera: Camera) -> np.ndarray:
    """RGB, or RGBA where something is transparent.

    Raises:
        FileFormatError: it cannot be read, or is not of its camera's size.
    """
    rgba = read_rgba(path)
    picture = read_rgb(path) if rgba is None else rgba
    if picture.shape[:2] != (camera.height, camera.width):
        h, w = picture.shape[:2]
        raise FileFormatError(path, f"is {w} x {h}, its camera {camera.width} x {camera.height}")
    is_plain = rgba is None or (rgba[..., 3] == 255).all()
    return np.ascontiguousarray(picture[..., :3]) if is_plain else picture


def _undistorted(picture: np.ndarray, camera: Camera, pinhole: Camera) -> np.ndarray:
    rgb = undistort_image(np.ascontiguousarray(picture[..., :3]), camera, pinhole)
    if picture.shape[2] == 3:
        return rgb
    alpha = undistort_image(np.repeat(picture[..., 3:], 3, axis=2), camera, pinhole)
    return np.concatenate([rgb, alpha[..., :1]], axis=2)


def _fitted(camera: Camera, max_side_px: int) -> Camera:
    """The same view with no side longer than that."""
    factor = max(camera.width, camera.height) / max_side_px
    if factor <= 1:
        return camera
    size = max(1, round(camera.width / factor)), max(1, round(camera.height / factor))
    params = camera.params.copy()
    ratio = np.array([size[0] / camera.width, size[1] / camera.height])
    params[:2] *= ratio
    params[2:4] = (params[2:4] + 0.5) * ratio - 0.5
    return Camera(camera.model, *size, params)
