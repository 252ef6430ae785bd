"""Training data of a field: undistorted images, cameras and points, from any supported format."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError, EpipoleError, NoModelError
from epipole.fields.training_view import TrainingView, shrunk, shrunk_mask
from epipole.geometry import Rigid3
from epipole.image import undistort_image, undistorted_camera
from epipole.io.contents_in_words import results_of
from epipole.io.images.photographs import GrayRange, common_range, mask_of, read_mask, read_mask_file
from epipole.io.images.rgba import read_rgba
from epipole.io.models.images import ModelImage, ModelImages
from epipole.io.names import path_inside
from epipole.pipelines.fields.config import FieldOptions
from epipole.runs import Progress, ProgressCallback, ignore_progress
from epipole.runs.model_source import SPLITS, ModelSource, model_source_of, transforms_source
from epipole.scene import Georeference
from epipole.scene.local_origin import local_origin


@dataclass(frozen=True, slots=True, eq=False)
class FieldImages:
    """Training views, held-out views, and known points."""

    train: list[TrainingView]
    test: list[TrainingView]
    points_in_world: np.ndarray
    rgb: np.ndarray
    has_alpha: bool
    problems: list[str]
    """Reasons why images are left out, and other warnings."""
    origin_in_world: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) origin of the coordinates."""
    georeference: Georeference | None = None
    """Position of the world's origin on Earth, if it is known."""

    def about_origin(self) -> FieldImages:
        """Shift the origin near the cameras if they are far from the world's, as Gaussians are single precision."""
        views = [*self.train, *self.test]
        origin = local_origin(np.stack([view.cam_from_world.inverse().translation for view in views]))
        if not origin.any():
            return self
        return replace(
            self,
            train=[_relative_to(view, origin) for view in self.train],
            test=[_relative_to(view, origin) for view in self.test],
            points_in_world=self.points_in_world - origin,
            origin_in_world=self.origin_in_world + origin,
        )


def _relative_to(view: TrainingView, origin_in_world: np.ndarray) -> TrainingView:
    points = view.points_in_world
    return replace(
        view,
        cam_from_world=view.cam_from_world @ Rigid3(np.eye(3), origin_in_world),
        points_in_world=None if points is None else points - origin_in_world,
    )


def gather_field_images(
    source: Path,
    options: FieldOptions,
    photographs: Path | None = None,
    progress: ProgressCallback = ignore_progress,
) -> FieldImages:
    """Read cameras and images.

    Args:
        source: an output folder of `reconstruct`, a COLMAP model with `images` next to it, a transforms.json, or a
            folder with one or with LLFF's poses_bounds.npy.
        options: which images are held out, and their maximum size.
        photographs: folder of the images, if not next to the model.
        progress: called after each image.

    Raises:
        FileFormatError: there is no model, or it is damaged.
        NoModelError: fewer than two images can be used.
        ConfigError: an image to hold out has no camera.
    """
    problems: list[str] = []
    if (source / SPLITS[0]).is_file():
        parts = [transforms_source(source / name) for name in SPLITS if (source / name).is_file()]
        problems += [warning for part in parts for warning in part.warnings]
        model = parts[0].model
        if any(part.splits for part in parts):
            problems.append(
                f"the file's lists of splits are ignored, because {' and '.join(SPLITS)} define the splits"
            )
        train = _views(parts[0], options, problems, progress)
        test = _views(parts[1], options, problems, progress) if len(parts) > 1 else []
    else:
        found = model_source_of(source, options.max_side_px, photographs)
        problems += found.warnings
        model = found.model
        train, test = _split(_views(found, options, problems, progress), found.splits, options, problems)
    if len(train) < 2:
        raise NoModelError(
            f"only {len(train)} images can be used for training, but two are needed"
            + "".join(f"; {p}" for p in problems[:3])
            + ("; SLAM stores no images with its map" if results_of(source) == "slam" else "")
        )
    has_alpha = any(view.image.shape[2] == 4 for view in train)
    points = model.points
    return FieldImages(
        train, test, points.xyz_in_world, points.rgb, has_alpha, problems, georeference=model.georeference
    )


def _split(
    views: list[TrainingView],
    splits: Mapping[str, tuple[str, ...]],
    options: FieldOptions,
    problems: list[str],
) -> tuple[list[TrainingView], list[TrainingView]]:
    """Training and held-out views: as requested, else by the splits of the file, else every n-th.

    Raises:
        ConfigError: a requested view has no camera.
    """
    names = [view.name for view in views]
    if options.test is not None:
        test_names = {name.strip() for name in options.test.split(",") if name.strip()}
        if missing := sorted(test_names - set(names)):
            raise ConfigError(f"test names images that have no camera: {', '.join(missing[:4])}")
        if splits:
            problems.append("the splits of the file are ignored, because test names the held-out images")
    elif splits:
        return _split_of_file(views, splits, problems)
    else:
        test_names = set(names[:: options.test_every]) if options.test_every else set()
    return [view for view in views if view.name not in test_names], [
        view for view in views if view.name in test_names
    ]


def _split_of_file(
    views: list[TrainingView], splits: Mapping[str, tuple[str, ...]], problems: list[str]
) -> tuple[list[TrainingView], list[TrainingView]]:
    """Split by the file's lists; val stands in for a missing test list, and train defaults to all other images."""
    test_names = set(splits.get("test", splits.get("val", ())))
    others = {view.name for view in views} - test_names - set(splits.get("val", ()))
    wanted = set(splits.get("train", others))
    if both := sorted(wanted & test_names):
        problems.append(
            f"{len(both)} images are both in the training and the test split ({both[0]}), so their scores are too high"
        )
    if unused := sorted({view.name for view in views} - wanted - test_names):
        problems.append(f"{len(unused)} images are in neither the training nor the test split ({unused[0]})")
    return [view for view in views if view.name in wanted], [
        view for view in views if view.name in test_names
    ]


def _views(
    source: ModelSource, options: FieldOptions, problems: list[str], progress: ProgressCallback
) -> list[TrainingView]:
    """Views sorted by name; images that cannot be read are left out with a warning.

    Raises:
        ConfigError: there are masks, but none for any image.
    """
    model = source.model
    out, cams_from_world = [], model.cams_from_world()
    if options.masks is not None and source.masks:
        problems.append("the masks in the file are ignored, because masks is given")
    rows = np.flatnonzero(model.is_registered())
    point = model.tracks.point_of_observation()
    files = ModelImages(model, source.folder, is_own=source.is_own)
    progress(Progress("load", 0, len(rows)))
    limits = _gray_range(source.folder, [model.images.name[row] for row in rows.tolist()])
    for n, row in enumerate(sorted(rows.tolist(), key=lambda k: model.images.name[k]), 1):
        name = model.images.name[row]
        try:
            image = files.find(name)
            mask = _mask(source, options, name, (image.camera.width, image.camera.height))
            seen = model.points.xyz_in_world[point[model.tracks.image == row]]
            pixels = _read(image, limits)
            view = _view(name, pixels, image.camera, cams_from_world[row], mask, seen, options.max_side_px)
            if view.used_mask is None or view.used_mask.any():
                out.append(view)
            else:
                problems.append(f"{name} is left out: its mask covers all of it")
        except EpipoleError as error:
            problems.append(f"{name} is left out: {error}")
        progress(Progress("load", n, len(rows)))
    if options.masks is not None and not any(mask_of(options.masks, name) for name in model.images.name):
        raise ConfigError(f"masks {options.masks} has no mask for any image (expected NAME.png)")
    return out


def _mask(source: ModelSource, options: FieldOptions, name: str, size: tuple[int, int]) -> np.ndarray | None:
    """Mask of an image, from the folder of masks if given, else from the file."""
    if options.masks is not None:
        return read_mask(options.masks, name, size=size)
    path = source.masks.get(name)
    return None if path is None else read_mask_file(path, name, size=size)


def _gray_range(folder: Path, names: list[str]) -> GrayRange | None:
    """Common gray range of all images, if they are deep grayscale, so that brightness is consistent across views."""
    paths = []
    for name in names:
        with suppress(EpipoleError):
            paths.append(path_inside(folder, name))
    return common_range(paths)


def _view(
    name: str,
    pixels: np.ndarray,
    camera: Camera,
    cam_from_world: Rigid3,
    mask: np.ndarray | None,
    points_in_world: np.ndarray,
    max_side_px: int,
) -> TrainingView:
    """Undistorted view of the requested size."""
    pinhole = undistorted_camera(camera)
    pixels = _undistorted(pixels, camera, pinhole)
    fitted = _fitted(pinhole, max_side_px)
    size = fitted.width, fitted.height
    if mask is not None:
        full = np.repeat(np.where(mask, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
        mask = shrunk_mask(undistort_image(full, camera, pinhole)[..., 0] == 255, size)
    pixels = shrunk(pixels, size) if size != (pinhole.width, pinhole.height) else pixels
    return TrainingView(name, pixels, fitted, cam_from_world, mask, points_in_world)


def _read(image: ModelImage, limits: GrayRange | None) -> np.ndarray:
    """RGB, or RGBA if the image is partly transparent.

    Raises:
        FileFormatError: the image cannot be read.
    """
    rgba = read_rgba(image.path, orientation=image.orientation)
    pixels = image.read(limits=limits) if rgba is None else rgba
    is_plain = rgba is None or (rgba[..., 3] == 255).all()
    return np.ascontiguousarray(pixels[..., :3]) if is_plain else pixels


def _undistorted(pixels: np.ndarray, camera: Camera, pinhole: Camera) -> np.ndarray:
    rgb = undistort_image(np.ascontiguousarray(pixels[..., :3]), camera, pinhole)
    if pixels.shape[2] == 3:
        return rgb
    alpha = undistort_image(np.repeat(pixels[..., 3:], 3, axis=2), camera, pinhole)
    return np.concatenate([rgb, alpha[..., :1]], axis=2)


def _fitted(camera: Camera, max_side_px: int) -> Camera:
    """Scale a camera so that no side is longer than `max_side_px`."""
    factor = max(camera.width, camera.height) / max_side_px
    if factor <= 1:
        return camera
    return camera.scaled_to(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))
